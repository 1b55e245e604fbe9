"""How a run starts and ends around its processes: whose folder, whose children, who is told."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from typing import Any, cast
from unittest import mock

import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy import go2
from deploy.buttons import Port
from deploy.codec import encode_state
from deploy.dds import Link, Subscriber
from deploy.log import STATE, Recorder, pipe, read, write
from deploy.loop import Refusal, preflight
from deploy.process import Ended, Job, end, ready, spawn
from deploy.safety import Phase
from deploy.settings import DeployCfg
from deploy.slots import Board
from tests import wire
from tests.test_deploy_control import Met, met
from tests.test_deploy_loop import Turns

__all__ = ["met"]  # a fixture


def test_the_view_hears_of_damping_without_states(met: Met):
    """No state, no tick; who looks at the view must not believe that all is well."""
    turns = Turns(met, Phase.HYBRID)
    for _ in range(20):
        turns.turn()
    assert turns.told(turns.board.status)["phase"] == Phase.HYBRID
    until = time.monotonic() + 1.0
    while turns.control.phase != Phase.DAMPING and time.monotonic() < until:
        turns.turn(0)
    assert turns.told(turns.board.status)["phase"] == Phase.DAMPING
    turns.board.close()


def test_a_dry_run_looks_on_beside_another_program(met: Met):
    for dry_run, phase in ((True, Phase.HYBRID), (False, Phase.DAMPING)):
        turns = Turns(met, Phase.HYBRID, dry_run)
        turns.wire.others = ["the robot's own"]
        for _ in range(30):
            turns.turn()
            time.sleep(0.003)
        assert turns.control.phase == phase, turns.control.machine.reason
        turns.board.close()


class Spoken:
    """A subscriber whose frames come one at a time."""

    peers = 1

    def __init__(self, frames: list[bytes]):
        self.frames = frames

    def take(self, timeout: float = 0.0) -> list[bytes]:
        return [self.frames.pop(0)] if self.frames else []


def test_one_damaged_frame_keeps_no_robot_from_starting(monkeypatch):
    monkeypatch.setattr("deploy.loop.HEARD", 0.2)
    good = encode_state(wire.state()._replace(charge=1))
    damaged = bytearray(good)
    damaged[500] ^= 1

    def said(*frames: bytes) -> str:
        with pytest.raises(Refusal) as refused:
            preflight(cast(Link, Nobody()), cast(Subscriber, Spoken(list(frames))), DeployCfg(), False)
        return str(refused.value)

    assert "no state frame has a right checksum" in said(bytes(damaged), good[:100])
    assert "the battery has 1 %" in said(bytes(damaged), good[:100], good)
    assert "no state frame within" in said()


class Nobody:
    """A link on which nobody else commands."""

    def rivals(self, topic: str) -> list[str]:
        return []


def test_a_folder_is_one_run_s(tmp_path):
    folder = tmp_path / "new" / "run"
    with go2.reserved(folder):
        (folder / "run.mcap").write_bytes(b"mine")
        with pytest.raises(ValueError, match=r"another run writes to .*run: end it, or take another --out"):
            go2.reserved(folder).__enter__()
        assert (folder / "run.mcap").read_bytes() == b"mine"
    with go2.reserved(folder):
        assert (folder / "run.mcap").read_bytes() == b""


def test_a_signal_waits_until_what_is_started_is_known():
    known = []

    def start(number: int) -> None:
        with go2.undisturbed():
            os.kill(os.getpid(), number)
            known.append(number)

    before = {number: signal.getsignal(number) for number in go2.ENDING}
    for number in go2.ENDING:
        with pytest.raises(KeyboardInterrupt):
            start(number)
    assert known == list(go2.ENDING)
    assert {number: signal.getsignal(number) for number in go2.ENDING} == before


def test_a_key_that_is_pressed_again_cuts_no_end_short():
    with contextlib.ExitStack() as stack:
        for number in go2.ENDING:
            stack.callback(signal.signal, number, signal.getsignal(number))
        with pytest.raises(KeyboardInterrupt), go2.once():
            os.kill(os.getpid(), signal.SIGINT)
        for number in go2.ENDING:
            os.kill(os.getpid(), number)


def speaking(code: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def test_who_is_not_ready_in_time_is_ended(monkeypatch):
    """A library may say something first; who says nothing, or ends, is named."""
    with speaking(
        "print('a banner'); print('ready: so', flush=True); import time; time.sleep(60)"
    ) as process:
        assert ready(process, "it") == "ready: so\n"
        end(process)
    with (
        speaking("import sys; print('ended'); sys.exit(3)") as process,
        pytest.raises(Ended, match=r"it ended with status 3$"),
    ):
        ready(process, "it")
    monkeypatch.setattr("deploy.process.START_UP", 0.5)
    with (
        speaking("print('a banner', flush=True); import time; time.sleep(60)") as process,
        pytest.raises(Ended, match=r"it ended with status -9: a signal, no answer for 0.5 s"),
    ):
        ready(process, "it")


def test_a_watchdog_that_cannot_start_ends_the_program():
    """Nothing is ever commanded without it: who waits for that waits for ever."""
    board, mocked = Board(), cast(Any, mock.Mock())
    board.status.write(board.status.blank())
    process = spawn("watchdog", Job(board=board.descriptor, interface="none0"), [board.descriptor])
    with speaking("import time; time.sleep(60)") as other:
        with pytest.raises(Ended, match="the watchdog") as ended:
            go2.follow(board, [other], other, [process], None, mocked, mocked)
        other.kill()
    assert ended.value.status == 2
    board.close()


def test_what_the_system_refuses_is_one_line(monkeypatch, capsys):
    """No process, no memory: nothing was started, or all of it has been ended."""
    monkeypatch.setattr(go2, "ENDING", ())
    monkeypatch.setattr(go2, "run", mock.Mock(side_effect=BlockingIOError(11, "no more processes")))
    assert go2.perform(go2.Args(interface="eth7")) == 2
    assert capsys.readouterr().err == "error: [Errno 11] no more processes\n"


def test_a_summary_is_shown_where_it_cannot_be_written(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(go2, "ENDING", ())
    monkeypatch.setattr(go2, "run", lambda *_: None)
    monkeypatch.setattr("deploy.summary.summarise", lambda *_: {"stages": None})
    with pytest.raises(SystemExit, match="2"):
        go2.perform(go2.Args(interface="eth7", out=tmp_path / "none"))
    told = capsys.readouterr()
    assert '"stages": null' in told.out
    assert told.err.count("\n") == 1


def test_an_event_that_is_too_long_costs_no_other(tmp_path):
    """A name that another program gives itself may be of any length."""
    source, sink = pipe()
    recorder = Recorder(sink)
    for reason in ("first", 5000 * "x", "last"):
        recorder.event("phase", reason=reason)
    os.close(sink)
    with os.fdopen(source, "rb") as stream:
        write(stream, tmp_path / "run.mcap", {})
    assert [event["reason"] for _, _, event in read(tmp_path / "run.mcap")] == ["first", "last"]
    assert recorder.lost == 1


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is full")
def test_a_log_on_a_full_disk_says_so_in_one_line():
    source, sink = pipe()
    process = spawn("log", Job(log=source, path="/dev/full"), [source], stderr=subprocess.PIPE)
    os.close(source)
    recorder = Recorder(sink)
    recorder.add(STATE, bytes(1180))
    os.close(sink)
    _, wrong = process.communicate(timeout=60)
    assert process.returncode == 2
    assert wrong == "log: nothing more is written: [Errno 28] No space left on device\n"


def test_nobody_hears_a_button_once_the_stand_in_is_gone():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    port = Port(number)
    for _ in range(3):
        port.press("START")
        port.push(10.0, 0.0, 0.1)
    port.close()


@pytest.mark.parametrize(("parent", "told"), [("os.getppid()", False), ("1", True), ("0", False)])
def test_a_process_ends_with_the_one_that_started_it(parent, told):
    """Also where that is process 1, as in a container."""
    code = f"import os; from deploy.process import until_told; print(until_told({parent})())"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=go2.ROOT)
    assert ran.stdout.strip() == str(told), ran.stderr


@pytest.mark.parametrize(("asked", "status"), [({}, 0), ({"search": ("search.samples=0",)}, 2)])
def test_the_planner_says_what_is_wrong_before_it_says_that_it_is_ready(asked: dict[str, Any], status):
    """Who releases a robot from its own controller waits for that."""
    board = Board()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = spawn("planner", Job(board=board.descriptor, **asked), [board.descriptor], **pipes)
    assert process.stdout is not None
    first = process.stdout.readline()
    process.terminate()
    rest, wrong = process.communicate(timeout=30)
    board.close()
    assert (first, rest, process.returncode) == ("" if status else "ready\n", "", status)
    assert wrong.count("\n") == (1 if status else 0), wrong
