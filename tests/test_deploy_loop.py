"""The control process's loop without its process: what leaves, when, and who is told of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from deploy.codec import decode_command, decode_state, encode_state
from deploy.control import TICK
from deploy.log import Recorder
from deploy.loop import Loop
from deploy.process import ROOT, share_cores
from deploy.remote import Button, Remote, pack
from deploy.safety import Phase
from deploy.settings import WatchdogCfg
from deploy.slots import Board, Slot, text
from deploy.watchdog import Process, Watchdog
from tests.test_deploy_control import Met, duplicate, met

__all__ = ["met"]  # a fixture


class Wire:
    """Frames in, commands out: a link and a subscriber at once."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.sent: list[bytes] = []
        self.others: list[str] = []

    def take(self, timeout: float = 0.0) -> list[bytes]:
        taken, self.frames = self.frames, []
        return taken

    def write(self, command: bytes) -> None:
        self.sent.append(command)

    def publisher(self, topic: str, kind: type) -> Wire:
        return self

    def rivals(self, topic: str, ours: tuple[int, ...] = (), most: int = 0) -> list[str]:
        return self.others


class Turns:
    """A loop in a phase, its watchdog and its robot."""

    def __init__(self, met: Met, phase: Phase, dry_run: bool = False):
        self.control, self.frames = duplicate(met[phase][0]), list(met[phase][1])
        self.wire, self.board = Wire(), Board()
        self.loop = Loop(self.wire, self.wire, self.board, self.control, Recorder(-1), dry_run)

    def guard(self, reason: str = "") -> None:
        """The watchdog says that it lives, and why it damps."""
        beat = self.board.guard.blank()
        beat["t"], beat["latched"], beat["reason"] = time.monotonic(), bool(reason), text(reason)
        self.board.guard.write(beat)

    def turn(self, frames: int = 1, guarded: bool = True) -> list[bytes]:
        """The loop's turn with so many of the next frames; what was sent."""
        if guarded:
            self.guard()
        before = len(self.wire.sent)
        self.wire.frames, self.frames = self.frames[:frames], self.frames[frames:]
        self.loop.turn()
        return self.wire.sent[before:]

    def told(self, slot: Slot) -> np.ndarray:
        """The value of one of the board's slots."""
        value = slot.read()
        assert value is not None
        return value

    def until_tick(self, other: int = 0) -> None:
        """Go on until the next frame but `other` makes a tick."""
        while (decode_state(self.frames[other]).tick - self.control._first) % TICK:
            assert self.turn()


@pytest.fixture
def hybrid(met: Met) -> Iterator[Turns]:
    turns = Turns(met, Phase.HYBRID)
    yield turns
    assert not turns.wire.frames
    turns.board.close()


def damps(command: bytes) -> bool:
    return not decode_command(command).motors.kp.any()


def test_what_the_estimator_finds_out_is_sent_at_once(hybrid: Turns):
    """The command of a tick is on its way by then; the damping follows it without another frame."""
    control, wire = hybrid.control, hybrid.wire
    for _ in range(40):
        assert len(hybrid.turn()) == 1
        assert control.phase == Phase.HYBRID, control.machine.reason
    order: list[str] = []
    settle, write = control.settle, wire.write

    def settling() -> None:
        order.append("settle")
        settle()

    def writing(command: bytes) -> None:
        order.append("write")
        write(command)

    with (
        mock.patch.object(control, "settle", settling),
        mock.patch.object(wire, "write", writing),
        mock.patch.object(control, "_outside", return_value="too far over"),
    ):
        sent = hybrid.turn()
    assert order == ["settle", "write", "settle", "write"]
    assert control.phase == Phase.DAMPING
    assert [damps(command) for command in sent] == [False, True]


@pytest.mark.parametrize("what", ["emergency", "hot", "restarted"])
def test_what_needs_no_estimator_damps_before_a_tick_is_commanded(hybrid: Turns, what: str):
    hybrid.until_tick()
    state = decode_state(hybrid.frames[0])
    state = {
        "emergency": state._replace(remote=pack(Remote(Button.L2 | Button.B))),
        "hot": state._replace(temperature=np.full(12, 95)),
        "restarted": state,
    }[what]
    hybrid.frames[0] = encode_state(state)
    if what == "restarted":
        hybrid.frames.insert(0, encode_state(state._replace(tick=2)))
    sent = hybrid.turn(2 if what == "restarted" else 1)
    assert hybrid.control.phase == Phase.DAMPING
    assert sent
    assert all(map(damps, sent))


@pytest.mark.parametrize("after", range(0, 5, 2))
def test_the_planner_is_told_of_the_ticks_state_whatever_came_after_it(met: Met, after: int):
    """Frames that come in one turn change neither what is commanded nor what the planner starts from."""
    one, other = Turns(met, Phase.HYBRID), Turns(met, Phase.HYBRID)
    one.until_tick(1)
    other.until_tick(1)
    for _ in range(2 + after):
        one.turn()
    sent = other.turn(2 + after)
    assert one.wire.sent[-1] == sent[-1]
    told, expected = other.told(other.board.state), one.told(one.board.state)
    for name in ("k", "x", "u", "mode", "entered", "anchor", "plan", "running"):
        np.testing.assert_array_equal(told[name], expected[name], err_msg=name)
    assert told["k"] == other.control.k
    for turns in (one, other):
        turns.board.close()


def test_the_watchdog_knows_before_the_robot_is_commanded(met: Met):
    """One that dies right after its first command is damped."""
    turns = Turns(met, Phase.LIE)
    known: list[bool] = []

    def writing(command: bytes) -> None:
        heart = turns.board.heart.read()
        known.append(heart is not None and bool(heart["commanding"]))

    with mock.patch.object(turns.wire, "write", writing):
        turns.turn()
    assert known == [True]
    turns.board.close()


def test_who_stood_still_asks_the_watchdog_again_before_it_commands(hybrid: Turns):
    """It latches while this process sleeps between reading its slot and sending."""
    hybrid.until_tick()
    react = hybrid.control.react

    def slowly(frame: bytes, now: float) -> bool:
        ticked = react(frame, now)
        time.sleep(0.03)
        hybrid.guard("the control process hung")
        return ticked

    with mock.patch.object(hybrid.control, "react", slowly):
        assert hybrid.turn() == []
    assert hybrid.control.phase == Phase.DAMPING
    assert hybrid.turn() == [], "the watchdog damps now, and two must not command"


@pytest.mark.clock
def test_a_watchdog_that_is_silent_is_found_within_100_ms(hybrid: Turns):
    hybrid.turn()
    began = time.monotonic()
    while hybrid.control.phase == Phase.HYBRID and time.monotonic() < began + 1.0:
        time.sleep(0.002)
        sent = hybrid.turn(guarded=False)
    assert hybrid.control.machine.reason == "the watchdog does not live any more"
    assert 0.05 < time.monotonic() - began < 0.1
    assert damps(sent[-1])


@pytest.mark.clock
def test_another_program_that_commands_is_found_within_100_ms(hybrid: Turns):
    for _ in range(5):
        hybrid.turn()
        time.sleep(0.002)
    hybrid.wire.others = ["another (process 7 on a host)"]
    began = time.monotonic()
    while hybrid.control.phase == Phase.HYBRID and time.monotonic() < began + 1.0:
        time.sleep(0.002)
        hybrid.turn()
    assert hybrid.control.machine.reason.startswith("another program commands the motors: another")
    assert time.monotonic() - began < 0.1


def test_a_watchdog_that_is_starting_is_no_other_program(met: Met):
    """Others see its publisher before it looks for the first time."""
    turns = Turns(met, Phase.PASSIVE)
    ours: list[int] = []
    Watchdog(turns.board, WatchdogCfg())

    def rivals(topic: str, known: tuple[int, ...] = (), most: int = 0) -> list[str]:
        ours.extend(known)
        return []

    with mock.patch.object(turns.wire, "rivals", rivals):
        time.sleep(0.1)
        for _ in range(20):
            turns.turn(guarded=False)
    assert os.getpid() in ours
    assert turns.control.wait == "the watchdog has not started yet"
    assert turns.control.checks.fault(time.monotonic()) == turns.control._fault == ""
    turns.turn()
    assert turns.control.wait == ""
    turns.board.close()


def test_a_planner_that_is_silent_is_told_of_and_the_stance_goes_on(hybrid: Turns):
    hybrid.until_tick()
    with mock.patch("deploy.loop._SILENT", 1e9):
        hybrid.turn()
    assert hybrid.told(hybrid.board.status)["reason"] == b""
    hybrid.until_tick()
    hybrid.turn()  # nobody has ever planned
    assert b"the planner is silent" in hybrid.told(hybrid.board.status)["reason"]
    assert hybrid.control.phase == Phase.HYBRID


def test_a_dry_run_sends_nothing_and_the_watchdog_has_nothing_to_damp(met: Met):
    turns = Turns(met, Phase.HYBRID, dry_run=True)
    for _ in range(30):
        assert turns.turn() == []
    assert turns.control.phase == Phase.HYBRID
    assert not turns.told(turns.board.heart)["commanding"]
    turns.board.close()


def test_control_shares_its_core_with_nobody(monkeypatch):
    def shared(cores: set[int]) -> tuple[int | None, set[int]]:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(cores))
        return share_cores()

    assert shared({0, 1}) == (1, {0})
    assert shared({2, 5, 7}) == (7, {2, 5})
    assert shared({3}) == (None, {3})


def test_what_keeps_a_core_awake_gives_way_and_ends_with_its_parent():
    core = max(os.sched_getaffinity(0))
    code = (
        "import time; from deploy.process import Job, spawn\n"
        f"print(spawn('awake', Job(core={core}), []).pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        it = int(parent.stdout.readline())
        until = time.monotonic() + 10.0
        while os.sched_getscheduler(it) != os.SCHED_IDLE and time.monotonic() < until:
            time.sleep(0.01)
        assert os.sched_getscheduler(it) == os.SCHED_IDLE
        assert os.sched_getaffinity(it) == {core}
        os.kill(it, signal.SIGINT)  # the terminal's are its parent's business
        os.kill(it, signal.SIGHUP)
        time.sleep(0.2)
        assert Path(f"/proc/{it}/stat").read_text().rsplit(")", 1)[1].split()[0] == "R"
        process = Process(it)
        assert not process.ends
        parent.kill()
    until = time.monotonic() + 5.0
    while not process.ends and time.monotonic() < until:
        time.sleep(0.01)
    assert process.ends
    process.close()
