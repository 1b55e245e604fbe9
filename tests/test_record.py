"""A schedule of constant inputs on a cheap simulator, recorded without a look on the way: the same trace."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hmc import ConstantInput, Evaluator, Schedule, make_start
from hmc.cost import Cost
from hmc.trace import SITUATION
from tests.toy import COST, toy_task

FIRST, SECOND = Schedule((0, 0, 2, 2, 1, 1)), Schedule((0, 0, 2, 1, 1, 0))
LATE = {**COST.stage, "late": lambda x, u, u_prev, k: torch.where(k > 12, math.nan, 0.0)}


@pytest.mark.parametrize("cost", [COST, replace(COST, stage=LATE)])
@pytest.mark.parametrize("worlds", [1, 3, 20])
@pytest.mark.parametrize("blow_up", [math.inf, 1.0, 2.0, 4.0, 6.5])
def test_as_if_looked_at(blow_up: float, worlds: int, cost: Cost) -> None:
    found = []
    for cheap in (False, True):
        modes = [ConstantInput(str(value), value) for value in (1.0, -1.0, 2.0)]
        task = toy_task(6, modes, cost, hidden=0.3, blow_up=blow_up, cheap=cheap)
        sim = task.make_sim(worlds)
        start = make_start(task, sim, [0.3, 0.2], [0.5], mode=1, k=9, ran=4)
        evaluator = Evaluator(task, sim, start)
        found += [
            (evaluator.follow(schedule), evaluator.trunk, evaluator.control_steps)
            for schedule in (FIRST, SECOND)
        ]
    for one, other in zip(found[:2], found[2:], strict=True):
        assert one[0] == other[0]
        assert one[2] == other[2]
        for name in (*SITUATION, "stage", "terminal"):
            torch.testing.assert_close(
                getattr(one[1], name), getattr(other[1], name), rtol=0, atol=0, equal_nan=True
            )
        for name in ("modes", "k", "ran", "barred"):
            assert getattr(one[1], name) == getattr(other[1], name)
