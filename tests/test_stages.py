"""The stages of the flip on made-up runs, at the edges of their definitions."""

from __future__ import annotations

import math

import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.stages import Stages, judge
from hmc.go2.stances import FOOTSTAND, HANDSTAND

DT = 0.02
HAND = 2


def pitched(degrees: float, height: float = 1.0) -> torch.Tensor:
    """In the air at a pitch; +90 is nose down. (37,)"""
    x = torch.zeros(37, dtype=torch.float64)
    half = math.radians(degrees) / 2
    x[2], x[3], x[5], x[7:19] = height, math.cos(half), math.sin(half), go2.HOME
    return x


def states(*pieces: tuple[torch.Tensor, int]) -> torch.Tensor:
    """Each state so many times, in this order."""
    return torch.stack([x for x, times in pieces for _ in range(times)])


def judged(x: torch.Tensor, modes: list[int] | None = None) -> Stages:
    return judge(x, torch.tensor(modes or [0] * (len(x) - 1)), DT, HAND)


FOOT, UPSIDE, AIR = FOOTSTAND.state(), HANDSTAND.state(), pitched(0)


@pytest.mark.parametrize(("steps", "expected"), [(50, True), (49, False)])
def test_foot_stand_for_one_second(steps, expected):
    """n steps are n + 1 states."""
    assert judged(states((AIR, 10), (FOOT, steps + 1), (AIR, 10))).foot_stand is expected


def test_foot_stand_without_a_break():
    assert not judged(states((FOOT, 40), (AIR, 1), (FOOT, 40))).foot_stand
    assert judged(states((FOOT, 40), (AIR, 1), (FOOT, 51))).foot_stand
    assert not judged(states((UPSIDE, 100))).foot_stand


def sweep(*degrees: float, height: float = 1.0) -> Stages:
    return judged(torch.stack([pitched(d, height) for d in degrees]))


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ((-60.1, -20, 20, 60.1), True),
        ((-59, -20, 20, 60.1), False),  # began too late
        ((-60.1, -20, 20, 59), False),  # did not get there
        ((-90, 0, -90, 0, 90), True),  # went back once
        ((-90, -120, -170, 170, 120, 90), False),  # over backwards
        ((-90, -170, 170, 90, 0, -90, 0, 90), True),  # that, and then once more as it should be
        ((90, 60, 0, -60, -90), False),  # the other way
    ],
)
def test_flip_by_pitch(degrees, expected):
    assert sweep(*degrees).jump_flip is expected


def test_flip_without_trunk_thigh_or_shin_on_the_ground():
    x = torch.stack([pitched(d) for d in (-90, -45, 0, 45, 90)])
    assert judged(x).jump_flip
    for link in ("trunk", "thigh", "calf"):
        low = x.clone()
        gap = go2.clearances(low[2:3])[link]
        low[2, 2] -= gap.min() + 1e-6
        assert not judged(low).jump_flip, link
    feet = x.clone()
    feet[2, 2] -= go2.clearances(x[2:3])["foot"].min() + 1e-3
    assert judged(feet).jump_flip, "feet may touch"


def caught(entry: int, wait: int, hold: int, leave: int = 0) -> bool:
    """Hand mode entered at step `entry`; the handstand `wait` steps later, for `hold` steps."""
    x = states((AIR, entry + wait), (UPSIDE, hold + 1), (AIR, leave + 5))
    modes = [1] * entry + [HAND] * (len(x) - 1 - entry)
    return judged(x, modes).handstand


def test_handstand_within_three_seconds_for_three_seconds():
    assert caught(20, 150, 150)
    assert not caught(20, 151, 150)
    assert not caught(20, 150, 149)
    assert caught(0, 0, 150)


def test_handstand_may_wobble_before_it_is_held():
    x = states((AIR, 10), (UPSIDE, 60), (AIR, 20), (UPSIDE, 151))
    assert judged(x, [HAND] * (len(x) - 1)).handstand
    x = states((AIR, 10), (UPSIDE, 130), (AIR, 20), (UPSIDE, 151))
    assert not judged(x, [HAND] * (len(x) - 1)).handstand, "3.2 s after the switch"


def test_handstand_counts_from_the_last_switch_that_led_to_it():
    x = states((AIR, 300), (UPSIDE, 151))
    late = [HAND] * 5 + [1] * 245 + [HAND] * 200
    assert judged(x, late).handstand
    assert not judged(x, [1] * 450).handstand, "in another mode"


def test_success_is_all_three():
    turn = torch.stack([pitched(float(d)) for d in range(-90, 91, 10)])
    x = torch.cat([states((FOOT, 60)), turn, states((UPSIDE, 160))])
    stages = judged(x, [0] * 60 + [1] * len(turn) + [HAND] * 159)
    assert stages == Stages(foot_stand=True, jump_flip=True, handstand=True)
    assert stages.success
    assert not Stages(foot_stand=True, jump_flip=False, handstand=True).success
