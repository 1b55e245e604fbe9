"""DDS between processes on the loopback interface, with our own peer and with Unitree's C++ SDK."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import decode_command, decode_state, encode_command, encode_state
from deploy.dds import Link, LinkError
from deploy.messages import LowCmd_, LowState_
from deploy.motion_switcher import MotionSwitcher, MotionSwitcherError, MotionSwitcherService
from tests import wire

PEERS = Path(__file__).parent / "dds_peers.py"
DOMAIN = 20 + os.getpid() % 100  # test runs side by side do not hear each other
OTHER = 2 + os.getpid() % 18
ROBOT_ORDER = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]  # the SDK counts as the robot does

sdk = pytest.mark.skipif(
    importlib.util.find_spec("unitree_interface") is None,
    reason="needs the sdk extra, whose wheels are for Python 3.11 and 3.12: pip install -e .[sdk]",
)


@contextmanager
def peer(part: str, domain: int) -> Iterator[subprocess.Popen[str]]:
    """Another process, ended with the test."""
    command = [sys.executable, str(PEERS), part, str(domain)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def listening(process: subprocess.Popen[str]) -> tuple[list[str], threading.Thread]:
    """The lines that a process has printed so far, and the thread that adds to them until it ends."""
    assert process.stdout is not None
    lines: list[str] = []
    thread = threading.Thread(target=lines.extend, args=(process.stdout,))
    thread.start()
    return lines, thread


def test_two_processes_exchange_both_topics() -> None:
    link = Link(DOMAIN)
    commands, states = link.publisher("rt/lowcmd", LowCmd_), link.subscriber("rt/lowstate", LowState_)
    with peer("robot", DOMAIN) as process:
        until = time.monotonic() + 20
        while not (commands.peers and states.peers):
            assert time.monotonic() < until, "the peer was not found"
            time.sleep(0.01)
        assert [name for name in link.rivals("rt/lowstate") if str(process.pid) in name]
        heard = []
        for serial in [*range(200, 0, -1), 0]:
            command = wire.command()
            command.q[0] = serial
            commands.write(encode_command(command))
            heard += states.take(5)
        assert process.wait(5) == 0
    found = [decode_state(frame) for frame in heard]
    assert all(it.crc_ok for it in found)
    assert [it.tick for it in found] == [*range(200, 0, -1), 0]  # none lost, none twice, in order
    assert np.array_equal(found[0].q, wire.state().q)
    assert states.take(0.05) == []


def test_a_second_publisher_is_found_and_forgotten() -> None:
    mine, theirs = Link(DOMAIN), Link(DOMAIN)
    own = mine.publisher("rt/lowcmd", LowCmd_)
    assert mine.rivals("rt/lowcmd") == []  # does not take itself for one
    other = theirs.publisher("rt/lowcmd", LowCmd_)
    assert [f"process {os.getpid()} on {socket.gethostname()}" in name for name in wait(mine)] == [True]
    assert mine.rivals("rt/lowstate") == []
    del other, theirs
    assert wait(mine, count=0) == []
    assert own.peers == 0


def test_new_publishers_are_looked_at_a_few_at_a_time() -> None:
    """In a domain with hundreds of them, each look would take longer than a control step."""
    mine, theirs = Link(DOMAIN), Link(DOMAIN)
    many = [theirs.publisher(f"rt/topic{i}", LowCmd_) for i in range(40)]
    rival = theirs.publisher("rt/lowcmd", LowCmd_)
    reader, until = theirs._publications, time.monotonic() + 5  # of the same process: it sees them at once
    assert len(reader.read(1000)) > 40
    looks = 0
    while not mine.rivals("rt/lowcmd", most=16) and time.monotonic() < until:
        looks += 1
    assert looks >= 2, "41 publishers are no less than three looks"
    assert len(mine.rivals("rt/lowcmd", ours=[os.getpid()])) == 0
    del many, rival


def wait(link: Link, count: int = 1) -> list[str]:
    """The rivals on rt/lowcmd, once there are so many, or after two seconds."""
    until = time.monotonic() + 2
    while len(rivals := link.rivals("rt/lowcmd")) != count and time.monotonic() < until:
        time.sleep(0.01)
    return rivals


def test_a_program_whose_name_is_no_text_is_another_like_any() -> None:
    """Its name is what it was started by, in whatever encoding; to read it ended the control process."""
    code = (
        f"import sys, time; sys.path[:0] = {[str(PEERS.parents[1]), *sys.path]!r}\n"
        "from deploy.dds import Link; from deploy.messages import LowCmd_\n"
        f"publisher = Link({OTHER}).publisher('rt/lowcmd', LowCmd_); time.sleep(20)"
    )
    link, python = Link(OTHER), os.path.realpath(sys.executable)
    with subprocess.Popen([b"\xff\xfe", b"-c", code.encode()], executable=python) as process:
        until, found = time.monotonic() + 10.0, list[str]()
        while not found and time.monotonic() < until:
            found = wait(link)
        process.kill()
    assert [name.split()[0] for name in found] == ["participant"]


def test_a_reader_keeps_what_it_has_not_taken() -> None:
    """The newest frames up to its depth: a stall of the reader costs none of the last ones."""
    link = Link(DOMAIN)
    reader = link.subscriber("rt/lowstate", LowState_, depth=8)
    writer = Link(DOMAIN).publisher("rt/lowstate", LowState_)
    while not (writer.peers and reader.peers):
        time.sleep(0.01)
    for tick in range(20):
        writer.write(encode_state(wire.state()._replace(tick=tick)))
        time.sleep(0.002)
    time.sleep(0.1)
    assert [decode_state(frame).tick for frame in reader.take()] == list(range(12, 20))
    assert reader.take() == []


def test_half_a_frame_is_not_sent() -> None:
    writer = Link(DOMAIN).publisher("rt/lowcmd", LowCmd_)
    with pytest.raises(LinkError, match="cannot send 406 octets on rt/lowcmd"):
        writer.write(encode_command(wire.command())[:406])


def test_wrong_links() -> None:
    with pytest.raises(LinkError, match=r"'eth77': this machine has .*\blo\b"):
        Link(OTHER, "eth77")
    with pytest.raises(ValueError, match="0 to 232, got 233"):
        Link(233)


@pytest.mark.skipif(len(socket.if_nameindex()) < 2, reason="this machine has one network interface")
def test_one_domain_on_two_interfaces() -> None:
    kept = Link(OTHER)
    second = next(name for _, name in socket.if_nameindex() if name != "lo")
    with pytest.raises(LinkError, match=f"{second!r} in domain {OTHER}"):
        Link(OTHER, second)
    del kept


@contextmanager
def serving(service: MotionSwitcherService) -> Iterator[None]:
    """A thread that answers."""
    stop = threading.Event()

    def run() -> None:
        while not stop.is_set():
            service.serve(0.05)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_motion_switcher() -> None:
    service = MotionSwitcherService(Link(DOMAIN), "mcf")
    switcher = MotionSwitcher(Link(DOMAIN))
    with serving(service):
        assert switcher.active() == "mcf"
        switcher.release()
        assert (switcher.active(), service.name) == ("", "")
        switcher.select("ai")
        assert (switcher.active(), service.name) == ("ai", "ai")
        with pytest.raises(MotionSwitcherError, match=r"refused Stand .* code 3203"):
            switcher._call(1004, "Stand", {})
        with pytest.raises(MotionSwitcherError, match=r"refused SelectMode .* code 3204"):
            switcher._call(1002, "SelectMode", {})


class Stubborn(MotionSwitcherService):
    """Says yes to a release and goes on."""

    def _answer(self, function: int, parameter: str) -> tuple[int, str]:
        code, data = super()._answer(function, parameter)
        self.name = "mcf"
        return code, data


def test_release_that_does_not_happen() -> None:
    service = Stubborn(Link(DOMAIN))
    switcher = MotionSwitcher(Link(DOMAIN))
    with serving(service), pytest.raises(MotionSwitcherError, match="'mcf' still runs after 2 requests"):
        switcher.release(attempts=2, pause=0.05)


def test_silent_motion_switcher() -> None:
    service = MotionSwitcherService(Link(DOMAIN))
    with pytest.raises(MotionSwitcherError, match="did not answer CheckMode"):
        MotionSwitcher(Link(DOMAIN), timeout=0.3).active()
    del service


def test_no_motion_switcher() -> None:
    with pytest.raises(MotionSwitcherError, match="found no motion switcher"):
        MotionSwitcher(Link(OTHER), timeout=0.2).active()


@sdk
def test_unitree_sdk_reads_states_and_its_commands_are_read() -> None:
    """A process of DDS 0.10.2, the robot's version, survives our types, and every checksum is good."""
    link = Link(0)
    commands, states = link.subscriber("rt/lowcmd", LowCmd_), link.publisher("rt/lowstate", LowState_)
    state, heard = wire.state(), []
    with peer("sdk_controller", 0) as process:
        while process.poll() is None:
            states.write(encode_state(state))
            heard += commands.take(0.002)
        out, _ = process.communicate()
    assert process.returncode == 0, "the SDK's process died: see deploy/messages.py on uint8"
    order = ROBOT_ORDER
    read = [float(word) for word in out.splitlines()[-1].split()]
    assert read == [*state.q[order], *state.quat, *state.temperature[order]]

    found = [decode_command(frame) for frame in heard]
    assert len(found) > 50
    assert all(it.crc_ok for it in found)
    assert np.array_equal(found[-1].motors.q, state.q)
    assert np.array_equal(found[-1].motors.kp[order], np.arange(12))


@sdk
def test_unitree_sdk_reads_commands_and_its_states_are_read() -> None:
    """As on the robot: the SDK's process of DDS 0.10.2 believes our commands, but for one whose checksum is
    wrong by a bit; and the checksum of its states is ours."""
    link, order = Link(0), ROBOT_ORDER
    commands, states = link.publisher("rt/lowcmd", LowCmd_), link.subscriber("rt/lowstate", LowState_)
    first, damaged, last = (wire.command(seed) for seed in (1, 2, 3))
    last.q[order[0]] = 0.0  # of the robot's first motor: the peer ends
    wrong = bytearray(encode_command(damaged))
    wrong[-1] ^= 1
    heard: list[bytes] = []
    with peer("sdk_robot", 0) as process:
        said, listener = listening(process)

        def numbers() -> list[list[float]]:
            return [[float(word) for word in line.split()] for line in said if line.count(" ") == 59]

        def send(frame: bytes, until: Callable[[], object]) -> None:
            while process.poll() is None and not until():
                commands.write(frame)
                heard.extend(states.take(0.005))

        send(encode_command(first), numbers)
        send(bytes(wrong), lambda: any("CRC Error" in line for line in said))
        send(encode_command(last), lambda: False)
        listener.join()
        assert process.wait() == 0, "the SDK's process died: see deploy/messages.py on uint8"
    assert any("CRC Error" in line for line in said)
    assert numbers() == [np.concatenate([it[order] for it in each[:5]]).tolist() for each in (first, last)]

    found, told = [decode_state(frame) for frame in heard], wire.state()
    assert found
    assert all(it.crc_ok for it in found)
    for name in ("quat", "gyro", "acc", "q", "dq", "tau", "temperature"):
        assert np.array_equal(getattr(found[-1], name), getattr(told, name))


@sdk
def test_unitree_sdk_answers_the_motion_switcher() -> None:
    with peer("sdk_switcher", 0) as process:
        switcher = MotionSwitcher(Link(0), timeout=10)
        switcher.release()
        assert switcher.active() == ""
        assert process.poll() is None, "the SDK's process died"
