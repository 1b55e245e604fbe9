"""The receding-horizon loop: what is kept from tick to tick."""

from __future__ import annotations

import math
import re

import pytest
import torch

from hmc import Budget, Evaluator, Receding, Schedule, make_start
from hmc.receding import SearchCfg
from tests.toy import Damp, Push, Ramp, ToySim, toy_task

X = [1.5, 1.0]
LONG = [2, 2, 0, 2, 2, 2, 1, 1]


def follow(loop: Receding, sim: ToySim, ticks: int, exact: bool = True):
    """Drive world 0 of `sim` with the loop; yields each tick with the state before and after it."""
    sim.reset(torch.tensor([X]), torch.zeros(1, 1))
    for _ in range(ticks):
        before = sim.x()[0]
        tick = loop.tick(before, snapshot=sim.save()[0] if exact else None)
        sim.step(tick.u[None])
        yield tick, before, sim.x()[0]


def test_the_prediction_comes_true_bit_for_bit():
    """With no search, each tick's trajectory is the tail of the one before: schedule, memory and all."""
    task = toy_task(8, hidden=0.4)
    loop = Receding(task, schedule=LONG, iterations=0)
    first = Evaluator(task, task.make_sim(1), make_start(task, task.make_sim(1), X)).trace(Schedule(LONG))
    for i, (tick, before, after) in enumerate(follow(loop, task.make_sim(1), 8)):
        assert torch.equal(before, first.x[i])
        assert torch.equal(tick.u, first.u[i + 1])
        assert torch.equal(after, first.x[i + 1])
        assert tick.mode == LONG[i]
        assert tick.plan.schedule.modes == (*LONG[i:], *[1] * i)
        assert loop.k == i + 1


@pytest.mark.parametrize("exact", [True, False])
def test_a_shifted_plan_predicts_the_tail_of_the_last_one(exact):
    """Bit for bit from an engine's snapshot, and from x and u alone if nothing else decides."""
    task = toy_task(8, hidden=0.4 if exact else 0.0)
    loop, sim = Receding(task, samples=20, budget=Budget(draws=40), seed=3), task.make_sim(1)
    predicted = None
    for tick, before, _ in follow(loop, sim, 6, exact):
        start = predicted.start(1, exact=exact) if predicted is not None else make_start(task, sim, X)
        assert torch.equal(before, start.x)
        evaluator = Evaluator(task, task.make_sim(1), start)
        if predicted is not None:
            shifted = evaluator.trace(tick.plan.incumbent)
            assert tick.plan.incumbent == predicted.schedule.shift()
            assert tick.plan.incumbent_cost == shifted.cost
            assert torch.equal(shifted.x[:-1], predicted.x[1:])
            assert torch.equal(shifted.u[:-1], predicted.u[1:])
        predicted = evaluator.trace(tick.plan.schedule)


def test_what_came_true_is_not_rolled_out_again():
    """From the engine's own snapshot a tick rolls out one step of its incumbent, and plans the same."""
    task = toy_task(8, hidden=0.4)

    def run(forgetful):
        loop, sim = (
            Receding(task, schedule=LONG, samples=6, budget=Budget(draws=12), seed=3),
            task.make_sim(1),
        )
        plans = []
        for tick, _, _ in follow(loop, sim, 12):
            plans.append(tick.plan)
            if forgetful:
                loop._known = None
        return plans

    told, fresh = run(False), run(True)
    assert told == fresh
    assert sum(p.control_steps for p in told) < sum(p.control_steps for p in fresh)
    loop, sim = Receding(task, schedule=LONG, iterations=0), task.make_sim(1)
    assert [tick.plan.control_steps for tick, _, _ in follow(loop, sim, 6)] == [8, 1, 1, 1, 1, 1]
    loop = Receding(task, schedule=LONG, iterations=0)
    assert [tick.plan.control_steps for tick, _, _ in follow(loop, sim, 3, exact=False)] == [8, 8, 8]


def test_memory_is_kept_while_the_mode_runs_and_made_anew_on_return():
    ramp = Ramp()
    task = toy_task(8, [Push(1.0), Damp(), ramp])
    loop = Receding(task, schedule=LONG, iterations=0)
    counts = []
    for tick, _, _ in follow(loop, task.make_sim(1), 6):
        assert loop.running.memory is not None
        counts.append(int(loop.running.memory[0]) if tick.mode == 2 else None)
    assert counts == [1, 2, None, 1, 2, 3]


def test_ticks_draw_differently_and_repeatably():
    def run(seed):
        loop = Receding(toy_task(8), samples=8, iterations=1, seed=seed)
        return [loop.tick(X, u=[0.0]).plan for _ in range(4)]

    assert run(1) == run(1)
    assert [p.switches for p in run(1)] != [p.switches for p in run(2)]
    # same state, same incumbent, other step: other draws
    loops = [Receding(toy_task(8), samples=1, k=k, budget=Budget(draws=3)) for k in range(8)]
    assert len({loop.tick(X).plan.switches for loop in loops}) > 1


def test_each_tick_is_no_worse_than_the_shifted_plan():
    task = toy_task(8)
    loop = Receding(task, samples=16, budget=Budget(draws=32))
    for tick, _, _ in follow(loop, task.make_sim(1), 5):
        assert tick.plan.cost <= tick.plan.incumbent_cost
        assert tick.mode == tick.plan.schedule[0]
        assert loop.schedule == tick.plan.schedule.shift()


def test_the_input_applied_last_is_remembered_or_told():
    task = toy_task(8)
    told, kept, wrong = (Receding(task, schedule=[0] * 8, iterations=0) for _ in range(3))
    for loop in (told, kept, wrong):
        loop.tick(X)
    costs = [kept.tick(X), told.tick(X, u=[1.0]), wrong.tick(X, u=[0.2])]
    assert costs[0].plan.cost == costs[1].plan.cost != costs[2].plan.cost


def test_a_bad_state_stops_the_tick_and_leaves_the_loop_as_it_was():
    loop = Receding(toy_task(8), iterations=0)
    loop.tick(X)
    kept = (loop.k, loop.schedule, loop.running.mode)
    with pytest.raises(ValueError, match="got nan at index 1"):
        loop.tick([0.0, float("nan")])
    assert (loop.k, loop.schedule, loop.running.mode) == kept


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("order", "foo", "order must be one of uniform, tails, got 'foo'"),
        ("samples", 0, "samples must be at least 1, got 0"),
        ("draws", 0, "draws must be at least 1, got 0"),
        ("control_steps", -1, "control_steps must be at least 1, got -1"),
        ("pairs", -1, "pairs must be at least 0, got -1"),
        ("moves", -2, "moves must be at least 0, got -2"),
        ("seconds", -0.1, "seconds must be a time, or 0 for any, got -0.1"),
        ("seconds", math.inf, "seconds must be a time, or 0 for any, got inf"),
    ],
)
def test_a_search_that_cannot_be_is_refused(key, value, told):
    with pytest.raises(ValueError, match=re.escape(told)):
        SearchCfg(**{key: value})
