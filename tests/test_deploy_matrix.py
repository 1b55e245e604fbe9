"""Each fault in each phase, the loop closed over the stand-in: what must damp does, the rest goes on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from deploy.remote import Button
from deploy.safety import Phase
from tests.mishaps import (
    DAMPING,
    DAMPS,
    FALLS,
    FAULTS,
    GOES_ON,
    HYBRID,
    LIE,
    LIES,
    PASSIVE,
    READY,
    STAND,
    Outcome,
)
from tests.rig import Rig
from tools.robot.faults import Faults
from tools.robot.standin import PERIOD

SOON = 0.1  # s
LONG, LONGER = 1.0, 1.5  # s that a robot that goes on is looked at, and one that may fall
# s that the robot has been in a phase: on its way down, on its way up, on four feet, on two
INTO = {LIE: 0.2, STAND: 0.4, READY: 0.3, HYBRID: 3.2}
UNDAMPED = (PASSIVE, *INTO)
TEST_ALSO = {  # with `make test`
    (PASSIVE, "rates not numbers"),
    (LIE, "no states"),
    (LIE, "L2 and B"),
    (STAND, "the control process ends"),
    (READY, "states corrupt"),
    (READY, "a motor hot"),
    (READY, "SELECT"),
    (HYBRID, "the clock restarts"),
    (HYBRID, "targets not numbers"),
    (HYBRID, "30 % of the states lost"),
    (HYBRID, "a strong push"),
    (DAMPING, "states twice"),
}
LATE = {
    (HYBRID, "gyroscope off by 1 rad/s"): "nothing but the height contradicts a gyroscope that drifts",
}


def cases() -> Iterator[Any]:
    """Each fault in each phase."""
    for phase in Phase:
        for fault in FAULTS:
            marks = [pytest.mark.matrix if (phase, fault) in TEST_ALSO else pytest.mark.deploy]
            if why := LATE.get((phase, fault)):
                marks.append(pytest.mark.xfail(reason=why))
            yield pytest.param(phase, fault, marks=marks, id=f"{phase.name.lower()}-{fault}")


@pytest.fixture(scope="module")
def met() -> Iterator[dict[Phase, Rig]]:
    """A rig in each phase; to be copied."""
    rig = Rig.lying()
    rig.run(0.1)
    found = {PASSIVE: rig.fork()}
    for phase, seconds in INTO.items():
        rig.reach(phase, seconds)
        assert rig.phase == phase, rig.control.machine.reason
        found[phase] = rig.fork()
    assert rig.upright
    rig.control.fail("a test")
    rig.run(0.02)
    found[DAMPING] = rig
    yield found
    for made in found.values():
        made.board.close()


@pytest.fixture
def rig(met: dict[Phase, Rig], phase: Phase) -> Iterator[Rig]:
    """One in a phase, after a moment without faults."""
    made = met[phase].fork()
    made.run(0.04)
    assert made.phase == phase
    yield made
    made.board.close()


@pytest.mark.parametrize(("phase", "fault"), cases())
def test_fault(rig: Rig, phase: Phase, fault: str) -> None:
    it = FAULTS[fault]
    it.strike(rig)
    if phase in (PASSIVE, DAMPING) and phase not in it.but:
        stays(rig, phase, it.starts)
        return
    outcome = it.but.get(phase, it.outcome)
    if outcome == DAMPS:
        damps(rig)
    elif outcome == LIES:
        rig.run(LONGER)
        assert rig.phase == LIE
        assert rig.upright
    else:
        goes_on_or_falls(rig, outcome)


def stays(rig: Rig, phase: Phase, starts: bool) -> None:
    """A robot that is passive is not commanded, nor one that is damped anything else."""
    rig.run(SOON)
    if not starts:
        rig.press(Button.START)
    count = rig.wire.count
    for _ in range(round(SOON / PERIOD)):
        rig.step()
        assert rig.phase == phase
        if phase == PASSIVE:
            assert rig.wire.count == 0
    if phase == DAMPING:
        assert rig.wire.count > count or not rig.turning
        assert rig.damped or rig.robot.commands.faults != Faults()


def damps(rig: Rig) -> None:
    """The motors only resist motion within 100 ms, and for good."""
    last = 0  # step in which they did not
    for step in range(1, round(3 * SOON / PERIOD) + 1):
        rig.step()
        if not rig.damped:
            last = step
    assert last * PERIOD < SOON, f"{1e3 * last * PERIOD:.0f} ms"


def goes_on_or_falls(rig: Rig, outcome: Outcome) -> None:
    """The robot is never outside of its envelope for longer than 100 ms; if it goes on, it is upright."""
    phase = rig.phase
    since = None
    for _ in range(round((LONG if outcome == GOES_ON else LONGER) / PERIOD)):
        rig.step()
        if rig.phase == DAMPING:
            break
        assert rig.phase in ((STAND, READY) if phase == STAND else (phase,))
        since = (since or rig.now) if rig.outside else None
        assert since is None or rig.now - since < SOON, "it is outside of its envelope"
    fell = rig.phase == DAMPING
    if outcome == GOES_ON:
        assert not fell, rig.control.machine.reason
        assert rig.upright
    elif outcome == FALLS:
        assert fell


@pytest.mark.deploy
def test_without_a_planner_no_mode_starts(met: dict[Phase, Rig]) -> None:
    rig = met[READY].fork()
    rig.planning = False
    rig.run(1.1)
    rig.press(Button.START)
    rig.run(0.1)
    assert rig.phase == READY
    assert "planner" in rig.control.machine.hint
    rig.board.close()
