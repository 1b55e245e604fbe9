"""Frames of the Go2's wire: byte for byte what DDS serialises, checksums, damage, the remote's octets."""

from __future__ import annotations

import ctypes as ct
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import uint8

from deploy import codec
from deploy.codec import FrameError, decode_command, decode_state, encode_command, encode_state
from deploy.crc import crc32
from deploy.messages import LowCmd_, LowState_, Request_, Response_
from deploy.remote import ABSENT, Button, Remote, pack, unpack
from tests import wire

ROOT = Path(__file__).parent.parent
SEEDS = range(20)
# joint 0 of the robot is its front right hip, joint 3 its front left one, and so on
ROBOT = ["FR", "FL", "RR", "RL"]
MODEL = ["FL", "FR", "RL", "RR"]


def same(a: Any, b: Any) -> bool:
    """Whether two records hold equal values."""
    return len(a) == len(b) and all(
        np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_crc_is_the_bitwise_one(seed: int) -> None:
    octets = np.random.default_rng(seed).bytes(4 * (seed + 1))
    assert crc32(octets) == wire.checksum(octets)


def test_crc_of_known_words() -> None:
    """One zero word: the remainder of 32 ones moved through the polynomial, as in CRC-32/MPEG-2."""
    assert crc32(bytes(4)) == 0xC704DD7B
    assert crc32(b"4321" + b"8765") == wire.checksum(b"43218765")


def test_c_structs_have_the_firmwares_sizes() -> None:
    assert (ct.sizeof(wire.LowCmd), ct.sizeof(wire.LowState)) == (812, 1180)


@pytest.mark.parametrize("seed", SEEDS)
def test_command_frame_is_what_dds_serialises(seed: int) -> None:
    command = wire.command(seed)
    frame = encode_command(command)
    message = LowCmd_.deserialize(frame)
    assert message.serialize(use_version_2=False) == frame
    assert (message.head, message.level_flag) == (b"\xfe\xef", 0xFF)
    for leg, name in enumerate(MODEL):
        for joint in range(3):
            motor = message.motor_cmd[3 * ROBOT.index(name) + joint]
            i = 3 * leg + joint
            assert [motor.q, motor.dq, motor.tau, motor.kp, motor.kd, motor.mode] == [x[i] for x in command]
    assert bytes(wire.to_struct(message, wire.LowCmd()))[-4:] == frame[-4:]
    assert message.crc == wire.checksum(bytes(wire.to_struct(message, wire.LowCmd()))[:-4])


@pytest.mark.parametrize("seed", SEEDS)
def test_state_frame_is_what_dds_serialises(seed: int) -> None:
    state = wire.state(seed)
    frame = encode_state(state)
    message = LowState_.deserialize(frame)
    assert message.serialize(use_version_2=False) == frame
    imu = message.imu_state
    told = [*imu.quaternion, *imu.gyroscope, *imu.accelerometer, *imu.rpy]
    assert told == [*state.quat, *state.gyro, *state.acc, *state.rpy]
    for leg, name in enumerate(MODEL):
        assert message.foot_force[ROBOT.index(name)] == state.foot_force[leg]
        for joint in range(3):
            motor, i = message.motor_state[3 * ROBOT.index(name) + joint], 3 * leg + joint
            assert [motor.q, motor.dq, motor.tau_est] == [state.q[i], state.dq[i], state.tau[i]]
            assert [motor.mode, motor.temperature] == [state.mode[i], state.temperature[i]]
    battery = message.bms_state
    assert (battery.soc, battery.current, message.power_v) == (state.charge, state.current, state.voltage)
    assert (message.tick, message.wireless_remote) == (state.tick, state.remote)
    assert message.crc == wire.checksum(bytes(wire.to_struct(message, wire.LowState()))[:-4])


@pytest.mark.parametrize("seed", SEEDS)
def test_round_trip(seed: int) -> None:
    command, state = wire.command(seed), wire.state(seed)
    there = decode_command(encode_command(command, level_flag=seed))
    assert same(there.motors, command)
    assert (there.head, there.level_flag, there.crc_ok) == (codec.HEAD, seed, True)
    assert same(decode_state(encode_state(state)), state)


def test_reads_what_dds_serialises() -> None:
    """Fields that the codec does not fill count in the checksum all the same."""
    message = LowState_.deserialize(encode_state(wire.state()))
    message.sn, message.bandwidth, message.bit_flag, message.adc_reel = [7, 8], 9, 5, 1.5
    message.imu_state.temperature, message.fan_frequency, message.power_a = 80, [1, 2, 3, 4], -2.0
    message.motor_state[0].lost, message.motor_state[19].temperature = 3, 90
    message.crc = wire.checksum(bytes(wire.to_struct(message, wire.LowState()))[:-4])
    assert decode_state(message.serialize(use_version_2=False)).crc_ok

    command = LowCmd_.deserialize(encode_command(wire.command()))
    command.led, command.fan, command.gpio, command.bms_cmd.off = bytes(range(12)), b"\1\2", 3, 4
    command.motor_cmd[15].q = 0.5
    command.crc = wire.checksum(bytes(wire.to_struct(command, wire.LowCmd()))[:-4])
    assert decode_command(command.serialize(use_version_2=False)).crc_ok


TK_BYTE, TK_UINT8 = 2, 13  # kinds of XTypes; Cyclone DDS 0.10 dies of the second


@pytest.mark.parametrize("message", [LowCmd_, LowState_, Request_, Response_], ids=lambda it: it.__name__)
def test_octets_are_announced_as_bytes(message: Any) -> None:
    announced = str(message.__idl__.get_type_mapping())
    assert f"TypeIdentifier[Union]({TK_BYTE}, None)" in announced
    assert f"TypeIdentifier[Union]({TK_UINT8}, None)" not in announced


def test_that_would_show_the_fatal_type() -> None:
    fatal = make_idl_struct("Fatal", "Fatal", {"octet": uint8})
    assert f"TypeIdentifier[Union]({TK_UINT8}, None)" in str(fatal.__idl__.get_type_mapping())


def test_sentinels_survive() -> None:
    command = wire.command()._replace(q=np.full(12, codec.POSITION_STOP), dq=np.full(12, codec.VELOCITY_STOP))
    there = decode_command(encode_command(command)).motors
    assert (there.q == codec.POSITION_STOP).all()
    assert (there.dq == codec.VELOCITY_STOP).all()


CODECS: list[tuple[Callable[[bytes], Any], bytes, set[int]]] = [
    # octets outside the checksum: the header, and what pads the first motor's mode to a word
    (decode_command, encode_command(wire.command()), {2, 3, 27}),
    (decode_state, encode_state(wire.state()), {2, 3, 82, 83}),
]


@pytest.mark.parametrize(("decode", "frame", "outside"), CODECS, ids=["command", "state"])
def test_any_damaged_octet_is_found(decode: Callable[[bytes], Any], frame: bytes, outside: set[int]) -> None:
    for at in range(len(frame)):
        damaged = bytearray(frame)
        damaged[at] ^= 0x10
        if at < 2:
            with pytest.raises(FrameError, match="CDR"):
                decode(bytes(damaged))
        else:
            assert decode(bytes(damaged)).crc_ok == (at in outside), f"octet {at}"


@pytest.mark.parametrize(("decode", "frame", "outside"), CODECS, ids=["command", "state"])
def test_garbage_never_crashes(decode: Callable[[bytes], Any], frame: bytes, outside: set[int]) -> None:
    """Either it is no frame, or its values come with the checksum's verdict; NaNs raise no warning."""
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(2000):
        octets = bytearray(frame)
        start = int(rng.integers(len(octets)))
        octets[start : start + int(rng.integers(1, 200))] = rng.bytes(int(rng.integers(200)))
        if rng.random() < 0.5:  # of the right length, so that it is read
            octets = bytearray(bytes(octets)[: len(frame)].ljust(len(frame), b"\xff"))
        try:
            found = decode(bytes(octets))
        except FrameError:
            refused += 1
        else:
            assert not found.crc_ok or octets[4:] == frame[4:]
    assert 500 < refused < 1500


def test_remote_by_hand() -> None:
    """Buttons from octet 2, sticks from 4, 8, 12 and 20; L2 is bit 5 and B bit 9."""
    octets = bytearray(40)
    octets[2:4] = (1 << 5 | 1 << 9).to_bytes(2, "little")
    for at, value in ((4, 0.25), (8, -0.5), (12, 1.0), (20, -0.75)):
        struct.pack_into("<f", octets, at, value)
    remote = Remote(Button.L2 | Button.B, lx=0.25, ly=-0.75, rx=-0.5, ry=1.0)
    assert unpack(bytes(octets)) == remote
    assert pack(remote)[2:] == bytes(octets)[2:]
    assert any(pack(Remote())), "one that is near and untouched is not none"
    assert unpack(ABSENT) == Remote()
    assert unpack(bytes(40)) == Remote()


@pytest.mark.parametrize("button", Button)
def test_every_button(button: Button) -> None:
    assert unpack(pack(Remote(button))).buttons == button


def test_remote_of_another_size() -> None:
    with pytest.raises(ValueError, match="40 octets, got 39"):
        unpack(bytes(39))


def test_wire_needs_no_engine() -> None:
    """A controller's real-time process pays for neither."""
    code = (
        "import sys, deploy.codec, deploy.dds, deploy.motion_switcher, deploy.remote\n"
        "print(*[name for name in ('torch', 'mujoco', 'warp', 'hmc') if name in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []
