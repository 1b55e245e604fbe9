"""Who acts in which world, and what comes of it."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch

from hmc import ConstantInput, Evaluator, Mode, Motion, Schedule, make_start
from tests.toy import Push, Ramp, all_schedules, toy_task


def evaluator(modes: list[Mode]) -> Evaluator:
    task = toy_task(6, modes)
    sim = task.make_sim(16)
    return Evaluator(task, sim, make_start(task, sim, [0.4, -0.2]))


def test_constant_inputs_are_looked_up():
    """As if each acted by itself: beside a mode that is none, they do."""
    values, rows = (1.0, -0.5, 0.0), all_schedules(3, 6)
    constants: list[Mode] = [ConstantInput(str(value), value) for value in values]
    assert evaluator(constants).task.modes.constants is not None
    assert evaluator([*constants, Ramp()]).task.modes.constants is None
    costs = evaluator(constants).costs(rows)
    assert torch.equal(costs, evaluator([Push(value) for value in values]).costs(rows))
    assert torch.equal(costs, evaluator([*constants, Ramp()]).costs(rows))


@pytest.mark.parametrize("part", ["actions", "memory"])
def test_a_mode_of_the_wrong_shape_is_named(part):
    class Wrong(Ramp):
        name = "wrong"

        def act(self, x, u, memory, k):
            return (u[:, [0, 0]], memory) if part == "actions" else (u, memory[:, :1])

    with pytest.raises(ValueError, match=rf"mode 'wrong': act\(\) {part} have shape .*expected \(1, "):
        evaluator([Wrong()]).cost(Schedule((0,) * 6))


def test_a_constant_input_stays_what_it_was_when_it_was_looked_up():
    mode = ConstantInput("one", 1.0)
    with pytest.raises(AttributeError, match="value"):
        mode.value = 2.0  # type: ignore[misc]


def test_motions_that_are_gone_are_not_kept():
    """What is copied to a device once is kept for the next call, but not of every motion that ever was."""
    gone = []
    for i in range(100):
        mode = Motion("motion", torch.full((3, 1), float(i)))
        evaluator([mode]).cost(Schedule((0,) * 6))
        gone.append(weakref.ref(mode.inputs))
    del mode
    gc.collect()
    assert sum(each() is not None for each in gone) < 80
