"""The live view: what of the status is shown, in place on a terminal, as lines elsewhere."""

from __future__ import annotations

import io
import re
import time

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.log import Recorder
from deploy.loop import Loop
from deploy.modes import JUMP, NONE
from deploy.safety import Phase
from deploy.slots import BINS, COUNTS, STATUS, Board, said, tally, text
from deploy.view import View, picture
from tests.test_deploy_control import Rig
from tests.test_deploy_loop import Wire

COUNTED = {"gap": 12, "checksum": 3, "range of the gyroscope": 0, "not a number": 7}


def status(**fields: object) -> np.ndarray:
    """In the jump, some ticks late."""
    found = np.zeros((), STATUS)
    found["k"], found["phase"], found["mode"] = 250, Phase.HYBRID, JUMP
    found["plan_age"], found["plans"], found["late_plans"] = 9, 41, 2
    found["ticks"], found["missed"], found["late"][:3] = 249, 4, (60, 30, 1)
    found["late"][-1] = 5
    found["faults"], found["charge"], found["pitch"], found["height"] = tally(COUNTED), 77, -88.4, 0.57
    for name, value in fields.items():
        found[name] = value
    return found


def shown(value: np.ndarray, width: int = 100) -> str:
    """The picture as plain text."""
    console = Console(file=io.StringIO(), width=width)
    console.print(picture(value))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def row(text: str, name: str) -> str:
    """What stands behind a name at the begin of a line."""
    (found,) = re.findall(rf"^ {name} +(.*?) *$", text, re.MULTILINE)
    return str(found)


def test_a_status_is_shown() -> None:
    text = shown(status())
    assert row(text, "phase") == "hybrid"
    assert row(text, "mode") == "jump"
    assert row(text, "body") == "pitch -88 deg, height 0.57 m"
    assert row(text, "battery") == "77 %"
    assert row(text, "plan") == "age 180 ms, 41 taken over, 2 too late"
    assert row(text, "ticks") == "249, 4 missed"
    assert row(text, "faults") == "gap 12, not a number 7, checksum 3"


def test_what_there_is_not() -> None:
    text = shown(status(phase=Phase.READY, mode=NONE, plan_age=-1, faults=tally({})))
    assert (row(text, "phase"), row(text, "mode"), row(text, "faults")) == ("ready", "-", "none")
    assert row(text, "plan").startswith("age -, ")


@pytest.mark.parametrize("phase", Phase)
def test_every_phase_and_its_reason(phase: Phase) -> None:
    """Brackets of a reason are no markup."""
    text_ = shown(status(phase=phase, reason=text("a program [/usr/bin/x] commands")))
    assert row(text_, "phase") == f"{phase.name.lower()} a program [/usr/bin/x] commands"


def test_the_histogram_of_lateness() -> None:
    """A bar a bin, the longest 30 long, the others in proportion."""
    lines = shown(status()).splitlines()
    bins = [line.split() for line in lines[lines.index("late by") + 1 :] if line.strip()]
    assert len(bins) == BINS
    counts = [int(line[-1]) for line in bins]
    assert counts == [60, 30, 1, *[0] * 8, 5]
    assert [line.count("#") for line in lines if line.endswith((" 60", " 30"))] == [30, 15]
    assert bins[0][:3] == ["<", "0.1", "ms"]
    assert bins[-1][0] == "more"


def test_faults_by_kind_come_from_the_loop() -> None:
    """A frame under a wrong checksum, and one that is none, are in the status of the next tick."""
    rig, wire, board = Rig(), Wire(), Board()
    loop = Loop(wire, wire, board, rig.control, Recorder(-1), dry_run=True)
    for i in range(30):
        (frame,) = rig.robot.step([])
        wire.frames = [{3: frame[:-1] + bytes([frame[-1] ^ 1]), 4: b"", 5: b""}.get(i, frame)]
        loop.turn()
    found = board.status.read()
    assert found is not None
    told = said(found["faults"].item())
    assert set(told.split(", ")) == {"checksum 1", "no LowState frame 2", "gap 3"}
    assert row(shown(found), "faults") == told
    board.close()


def test_counts_fit_into_the_slot() -> None:
    """The most frequent are kept."""
    told = tally({f"kind number {i}": i for i in range(1000)})
    assert len(told) == COUNTS
    assert told.startswith(b"kind number 999 999, kind number 998 998, ")


def test_elsewhere_than_on_a_terminal_changes_are_lines() -> None:
    console = Console(file=io.StringIO(), width=100)
    with View(console) as view:
        for value in (
            status(k=50, phase=Phase.LIE, mode=NONE),
            status(k=51, phase=Phase.LIE, mode=NONE, ticks=1),  # no change that is told
            status(k=100),
            status(k=150, phase=Phase.DAMPING, reason=text("in jump: too low")),
        ):
            view.show(value)
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().splitlines() == [
        "  1.00 s  lie",
        "  2.00 s  hybrid jump",
        "  3.00 s  damping in jump: too low",
    ]


def test_on_a_terminal_the_newest_status_is_shown_in_place() -> None:
    console = Console(file=io.StringIO(), width=100, height=40, force_terminal=True)
    with View(console) as view:
        view.show(status(ticks=1234))
        view.show(status(ticks=1235))
        until = time.monotonic() + 5.0
        assert isinstance(console.file, io.StringIO)
        while "1235, 4 missed" not in console.file.getvalue() and time.monotonic() < until:
            time.sleep(0.01)
    told = console.file.getvalue()
    assert "1235, 4 missed" in told
    assert told.rstrip().endswith("\x1b[2K") or "\x1b[1A" in told, "what was shown is wiped at the end"
