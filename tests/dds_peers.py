"""The other processes of the DDS tests: `python dds_peers.py PART DOMAIN`; SDK parts need domain 0."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deploy.codec import decode_command, encode_state
from deploy.dds import Link
from deploy.messages import LowCmd_, LowState_
from tests.wire import state

SECONDS = 20.0  # at most


def robot(domain: int) -> None:
    """Answers each command with a state whose tick is the command's serial of one motor, until told 0."""
    link = Link(domain)
    commands, states = link.subscriber("rt/lowcmd", LowCmd_), link.publisher("rt/lowstate", LowState_)
    while True:
        for frame in commands.take(SECONDS):
            command = decode_command(frame)
            serial = int(command.motors.q[0])
            states.write(encode_state(state()._replace(tick=serial)))
            if serial == 0:
                time.sleep(0.2)  # for the answer to leave
                return


def sdk_controller(domain: int) -> None:
    """Unitree's SDK as the controller: commands what it reads, and prints the last of it."""
    import unitree_interface

    assert domain == 0, "the SDK's domain"
    peer = unitree_interface.UnitreeInterface.create_go2("lo")
    read: list[float] = []
    until = time.monotonic() + SECONDS
    while time.monotonic() < until and not read:
        now = peer.read_low_state()
        if any(now.motor.q):
            read = [*now.motor.q, *now.imu.quat, *now.motor.temperature]
        time.sleep(0.01)
    command = peer.create_zero_command()
    command.q_target, command.kp = read[:12], [float(i) for i in range(12)]
    for _ in range(50):
        peer.write_low_command(command)
        time.sleep(0.01)
    print(*read, flush=True)
    # The SDK's own tear-down aborts now and then when a state arrives during it (an assertion in
    # prevent_callbacks of Cyclone DDS C++ 0.10.2): what was exchanged until here is the test.
    os._exit(0)


def sdk_robot(domain: int) -> None:
    """Unitree's SDK as the robot: publishes a state, and prints the commands that it reads, each once."""
    import unitree_interface

    assert domain == 0, "the SDK's domain"
    peer: Any = unitree_interface.UnitreeInterface.create_go2("lo")  # its stubs leave the robot's side out
    now, told = unitree_interface.LowState(12), state()
    motor, imu = now.motor, now.imu
    order = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]  # the SDK counts as the robot does
    motor.q, motor.dq, motor.tau_est = (each[order].tolist() for each in (told.q, told.dq, told.tau))
    motor.temperature = told.temperature[order].tolist()
    imu.quat, imu.omega, imu.accel = told.quat.tolist(), told.gyro.tolist(), told.acc.tolist()
    now.motor, now.imu = motor, imu
    last: list[float] = []
    until = time.monotonic() + SECONDS
    while time.monotonic() < until and last[:1] != [0.0]:
        peer.publish_low_state(now)
        it = peer.read_incoming_command()
        read = [*it.q_target, *it.dq_target, *it.tau_ff, *it.kp, *it.kd]
        if read != last and (last or any(read)):
            print(*read, flush=True)
            last = read
        ctypes.CDLL(None).fflush(None)  # what the SDK itself prints
        time.sleep(0.002)
    os._exit(0)  # as above


def sdk_switcher(domain: int) -> None:
    """Unitree's SDK as the robot's motion switcher, until killed."""
    import unitree_interface

    assert domain == 0, "the SDK's domain"
    peer = unitree_interface.UnitreeInterface.create_go2("lo")
    peer.enable_motion_switcher_responder()
    time.sleep(SECONDS)


PARTS: dict[str, Callable[[int], None]] = {
    "robot": robot,
    "sdk_controller": sdk_controller,
    "sdk_robot": sdk_robot,
    "sdk_switcher": sdk_switcher,
}

if __name__ == "__main__":
    PARTS[sys.argv[1]](int(sys.argv[2]))
