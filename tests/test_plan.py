"""`plan`: solvers, budgets, certificates, interruption and refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import hmc
from hmc import Budget, Plan, PlanInterrupted, Schedule, plan
from tests.toy import Bad, Damp, Push, Ramp, ToySim, slow_cost, toy_task

X = [0.4, -0.2]
FAR = [1.5, 1.0]


@given(
    x=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    incumbent=st.lists(st.integers(0, 2), min_size=5, max_size=5),
    solver=st.sampled_from(["sample", "exhaustive"]),
    samples=st.integers(4, 60),
    draws=st.none() | st.integers(1, 80),
    seed=st.integers(0, 9),
    order=st.sampled_from(["uniform", "tails"]),
    pairs=st.sampled_from([0, 1, 20]),
    moves=st.sampled_from([0, 3]),
)
@settings(max_examples=40)
def test_what_a_plan_says_is_true(x, incumbent, solver, samples, draws, seed, order, pairs, moves):
    task = toy_task(5)
    options = {
        "solver": solver,
        "samples": samples,
        "seed": seed,
        "order": order,
        "pairs": pairs,
        "moves": moves,
    }
    result = plan(task, x, schedule=incumbent, budget=Budget(draws=draws), **options)
    assert result.incumbent.modes == tuple(incumbent)
    assert result.incumbent_cost == slow_cost(task, incumbent, x)
    assert result.cost == slow_cost(task, result.schedule, x)
    assert sum(result.terms.values()) == pytest.approx(result.cost, rel=1e-12)
    assert tuple(result.terms) == task.cost.names
    assert sum(result.incumbent_terms.values()) == pytest.approx(result.incumbent_cost, rel=1e-12)
    assert sum(result.gains.values()) == pytest.approx(result.cost - result.incumbent_cost, abs=1e-9)
    assert list(result.gains.values()) == sorted(result.gains.values())
    stitched = result.incumbent
    for switch in result.switches:
        stitched = stitched.stitch(switch)
    assert stitched == result.schedule
    step = result.incumbent
    assert result.schedules[0] == result.incumbent
    assert result.schedules[-1] == result.schedule
    for (switches, terms), cost, made in zip(
        result.steps, result.costs[1:], result.schedules[1:], strict=True
    ):
        for switch in switches:
            step = step.stitch(switch)
        assert made == step
        assert slow_cost(task, step, x) == cost
        assert sum(terms.values()) == pytest.approx(cost, rel=1e-12)
    assert [switch for switches, _ in result.steps for switch in switches] == list(result.switches)
    accepted = len(result.costs) - 1
    assert accepted <= len(result.switches) <= (2 if pairs or moves else 1) * accepted
    assert all(b < a for a, b in pairwise(result.costs))
    assert result.space_size == 45
    assert result.draws >= result.rollouts - 1
    assert result.stopped_by == ("converged" if result.locally_optimal else "draws")
    assert not result.machine_dependent
    assert result.draws <= (draws or math.inf)
    assert result.coverage == result.seen / 45


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
@pytest.mark.parametrize("num_worlds", [1, 3, 200])
def test_same_seed_same_plan_at_any_chunk_size(solver, num_worlds):
    task = toy_task(8)
    options = {"solver": solver, "samples": 32, "seed": 5, "budget": Budget(control_steps=2500)}
    assert plan(task, FAR, sim=task.make_sim(num_worlds), **options) == plan(task, FAR, **options)


def test_seeds_draw_differently():
    plans = [plan(toy_task(8), FAR, samples=4, iterations=1, seed=seed) for seed in range(4)]
    assert len({p.switches for p in plans}) > 1


def test_sample_takes_the_best_of_the_first_improving_batch():
    """With all of Omega in one batch that is the best switch; with one draw a batch, the first."""
    for seed in range(5):
        whole = plan(toy_task(6), FAR, samples=63, iterations=1, seed=seed)
        single = plan(toy_task(6), FAR, samples=1, iterations=1, seed=seed)
        exact = plan(toy_task(6), FAR, solver="exhaustive", iterations=1)
        assert whole.switches == exact.switches
        assert exact.cost <= single.cost < single.incumbent_cost


def test_exhaustive_takes_the_best_of_all():
    task = toy_task(5)
    base = Schedule.constant(0, 5)
    space = hmc.SwitchSpace(3, 5)
    costs = [slow_cost(task, base.stitch(space[i]), FAR) for i in range(len(space))]
    result = plan(task, FAR, solver="exhaustive", iterations=1, samples=7)
    assert result.cost == min(costs)
    assert result.switches == (space[costs.index(min(costs))],)
    assert result.draws == len(space)


def test_repeats_are_drawn_but_not_rolled_out():
    result = plan(toy_task(6, [Push(1.0)]), X, solver="exhaustive")
    assert (result.draws, result.rollouts, result.control_steps) == (21, 1, 6)
    assert result.locally_optimal


def test_a_no_op_switch_is_never_accepted():
    result = plan(toy_task(6), FAR, tolerance=0.0)
    assert result.locally_optimal
    assert all(after < before for before, after in pairwise(result.costs))


def test_tolerance_is_relative():
    result = plan(toy_task(6), FAR, tolerance=0.2)
    steps = list(pairwise(result.costs))
    assert steps
    assert all(after < 0.8 * before for before, after in steps)
    assert result.cost > plan(toy_task(6), FAR).cost


def test_hopeless_is_pruned_not_diverged():
    base = toy_task(8)
    bounded = replace(
        base, lower_bound=lambda x, k, steps: torch.where(x[:, 0].abs() > 3, math.inf, math.nan)
    )
    found, plain = (plan(task, FAR, samples=16, seed=1) for task in (bounded, base))
    assert found.diverged == 0
    assert found.cost <= found.incumbent_cost
    assert plain.diverged == 0


def test_torch_has_its_threads_back():
    seen, broken = set(), False

    class Watch(Damp):
        def act(self, x, u, memory, k):
            seen.add(torch.get_num_threads())
            if broken:
                raise RuntimeError("out of the search")
            return super().act(x, u, memory, k)

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        plan(toy_task(6, [Push(1.0), Watch()]), FAR, samples=2, iterations=1)
        assert torch.get_num_threads() == 3
        broken = True
        with pytest.raises(RuntimeError, match="out of the search"):
            plan(toy_task(6, [Push(1.0), Watch()]), FAR)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert seen == {1}


@pytest.mark.parametrize(("most", "sizes"), [(0, [4] * 15 + [3]), (16, [4, 8, 16, 16, 16, 3])])
def test_batches_double_while_nothing_improves(most, sizes):
    """With an incumbent that nothing improves: all of Omega, each switch once."""
    best, seen = plan(toy_task(6), FAR).schedule, [0]
    result = plan(
        toy_task(6), FAR, schedule=best, samples=4, max_samples=most, progress=lambda p: seen.append(p.draws)
    )
    assert [after - before for before, after in pairwise(seen)] == sizes
    assert result.locally_optimal


def test_batches_begin_small_again_after_a_switch():
    notes = []
    plan(
        toy_task(8),
        FAR,
        samples=2,
        max_samples=64,
        progress=lambda p: notes.append((len(p.switches), p.draws)),
    )
    first: dict[int, int] = {}  # draws of the first batch after each accepted switch
    for (before, drawn), (after, now) in pairwise(notes):
        if before == after:
            first.setdefault(after, now - drawn)
    assert len(first) > 1
    assert set(first.values()) == {2}


def test_coverage_counts_since_the_last_accepted_switch():
    best = plan(toy_task(6), FAR).schedule
    result = plan(toy_task(6), FAR, schedule=best, samples=10, budget=Budget(draws=21))
    assert result.coverage == 21 / 63
    accepted = plan(toy_task(6), FAR, iterations=1)
    assert (accepted.stopped_by, accepted.coverage) == ("iterations", 0.0)


@pytest.mark.parametrize("calls", [1, 2, 5])
@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
def test_progress_sees_every_step_and_can_stop(solver, calls):
    seen: list[Plan] = []

    def watch(so_far: Plan) -> bool:
        seen.append(so_far)
        return len(seen) < calls

    result = plan(toy_task(8), FAR, solver=solver, samples=20, progress=watch)
    assert len(seen) == calls
    assert result.stopped_by == "progress"
    assert result.cost <= seen[-1].cost <= seen[0].cost <= result.incumbent_cost
    assert all(so_far.stopped_by == "" for so_far in seen[:-1])


def test_progress_does_not_change_the_plan():
    watched = plan(toy_task(8), FAR, samples=20, progress=lambda so_far: None)
    assert watched == plan(toy_task(8), FAR, samples=20)


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
@pytest.mark.parametrize("step", [7, 20, 45, 60])
def test_ctrl_c_carries_the_best_plan_so_far(solver, step):
    class Interrupted(ToySim):
        def step(self, u, ids=None):
            super().step(u, ids)
            if len(self.stepped) == step:
                raise KeyboardInterrupt

    task = replace(toy_task(6), make_sim=Interrupted)
    with pytest.raises(KeyboardInterrupt) as caught:
        plan(task, FAR, solver=solver, samples=8)
    assert isinstance(caught.value, PlanInterrupted)
    best = caught.value.plan
    assert best.stopped_by == "interrupt"
    assert best.cost == slow_cost(task, best.schedule, FAR) <= best.incumbent_cost
    if step == 60:
        assert best.cost < best.incumbent_cost


def test_diverged_schedules_are_counted_and_left_alone():
    task = toy_task(6, [Push(0.5), Bad(after=0), Damp()])
    result = plan(task, FAR)
    assert result.diverged > 0
    assert 1 not in result.schedule.modes
    assert "rollouts diverged" in str(result)
    clean = plan(toy_task(6, [Push(0.5), Push(0.5, "same"), Damp()]), FAR, solver="exhaustive")
    assert plan(task, FAR, solver="exhaustive").cost == clean.cost


def test_out_of_a_diverging_incumbent():
    result = plan(toy_task(6, [Bad(after=2), Damp()]), FAR)
    assert result.incumbent_cost == math.inf
    assert math.isfinite(result.cost)
    hopeless = plan(toy_task(6, [Bad(after=2)]), FAR)
    assert hopeless.cost == math.inf
    assert hopeless.diverged == 1


def test_default_incumbent():
    assert plan(toy_task(6), X, iterations=0).schedule.modes == (0,) * 6
    assert plan(toy_task(6), X, mode="damp", iterations=0).schedule.modes == (1,) * 6
    assert plan(toy_task(6), X, mode=2, iterations=0).schedule.modes == (2,) * 6
    named = ["push1", "damp", "ramp", "ramp", "damp", "push1"]
    result = plan(toy_task(6), X, schedule=named, iterations=0)
    assert result.schedule.modes == (0, 1, 2, 2, 1, 0)
    assert str(result.schedule) == "push1 x1 | damp x1 | ramp x2 | damp x1 | push1 x1"


def test_planning_from_a_running_mode():
    memory, modes = [3.0, 0.9, -0.4, 4.0], (2, 2, 2, 2, 2, 2)
    result = plan(
        toy_task(6), X, u=[0.3], mode="ramp", memory=memory, k=7, schedule=modes, solver="exhaustive"
    )
    running = {"u": [0.3], "mode": 2, "memory": memory, "k": 7}
    assert result.incumbent_cost == slow_cost(toy_task(6), modes, X, **running)
    assert result.cost == slow_cost(toy_task(6), result.schedule, X, **running)
    assert result.incumbent_cost != slow_cost(toy_task(6), modes, X, u=[0.3], k=7)


BAD = {
    "short state": ({"x": [0.1]}, ValueError, r"task 'toy': state x: expected 2 numbers.*got shape \(1,\)"),
    "batched state": ({"x": [[0.1, 0.2]]}, ValueError, r"got shape \(1, 2\)"),
    "NaN state": ({"x": [0.1, math.nan]}, ValueError, "state x: expected finite numbers, got nan at index 1"),
    "infinite state": ({"x": [-math.inf, 0.0]}, ValueError, "got -inf at index 0"),
    "NaN input": ({"u": [math.nan]}, ValueError, "last input u: expected finite numbers"),
    "long input": ({"u": [0.1, 0.2]}, ValueError, "last input u: expected 1 numbers"),
    "unknown mode": ({"mode": "rmap"}, KeyError, "unknown mode 'rmap': .*push1, damp, ramp; did you"),
    "mode out of range": ({"mode": 3}, KeyError, "unknown mode 3: this set has push1, damp, ramp"),
    "unknown mode in schedule": ({"schedule": [0, 1, 2, 0, 1, "dump"]}, KeyError, "did you mean 'damp'"),
    "negative mode": ({"schedule": [0, 1, 2, 0, 1, -1]}, KeyError, "unknown mode -1"),
    "short schedule": ({"schedule": [0]}, ValueError, "has 1 steps, expected the horizon, 6"),
    "unknown solver": (
        {"solver": "samples"},
        ValueError,
        "unknown solver 'samples': expected one of sample, .*did",
    ),
    "unknown order": (
        {"order": "tail"},
        ValueError,
        "unknown order 'tail': expected one of uniform, tails; did",
    ),
    "no samples": ({"samples": 0}, ValueError, "samples must be at least 1"),
    "a negative largest batch": ({"max_samples": -1}, ValueError, "max_samples must be >= 0"),
    "fewer pairs than none": ({"pairs": -1}, ValueError, "pairs must be >= 0"),
    "iterations": ({"iterations": -1}, ValueError, "iterations must be >= 0"),
    "tolerance": ({"tolerance": math.nan}, ValueError, "tolerance must be a finite share"),
    "step": ({"k": -1}, ValueError, "control step k must be >= 0"),
    "memory alone": ({"memory": [0.0] * 4}, ValueError, "memory was given without the mode"),
    "memory size": ({"mode": "ramp", "memory": [0.0]}, ValueError, "memory of mode 'ramp': expected 4"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    changed, error, message = BAD[case]
    with pytest.raises(error, match=message):
        plan(toy_task(6), **{"x": X, **changed})


@pytest.mark.parametrize("limit", ["draws", "control_steps", "seconds"])
@pytest.mark.parametrize("value", [0, -1, math.nan])
def test_a_budget_of_nothing_is_refused(limit, value):
    with pytest.raises(ValueError, match=f"budget {limit} must be more than 0"):
        Budget(**{limit: value})


def test_a_start_comes_with_all_it_needs():
    task = toy_task(6)
    whole = hmc.Evaluator(task, task.make_sim(1), hmc.make_start(task, task.make_sim(1), X)).trace(
        Schedule((2,) * 6)
    )
    start = whole.start(2)
    assert plan(task, start, iterations=0).schedule.modes == (2,) * 6
    with pytest.raises(ValueError, match="do not pass them as well"):
        plan(task, start, k=2)


def test_plan_prints_what_backs_it():
    text = str(plan(toy_task(6, [Damp(), Ramp()]), FAR))
    assert "locally optimal of 42 switches" in text
    assert "control steps" in text
    assert "stopped by converged" in text


def test_arrays_and_tensors_are_fine_as_states():
    wanted = plan(toy_task(6), FAR)
    assert plan(toy_task(6), torch.tensor(FAR, dtype=torch.float64)) == wanted
    assert plan(toy_task(6), torch.tensor(FAR, dtype=torch.float64).numpy()) == wanted


def test_what_did_not_fit_is_said():
    class Tight(ToySim):
        def overflow(self):
            return {"constraints": 0, "contacts": 1234}

    with pytest.warns(
        UserWarning, match="did not fit and count as diverged: 1,234 by contacts; .* contacts="
    ):
        plan(replace(toy_task(3), make_sim=Tight), FAR)
    inner = Damp()
    inner.sims = (Tight(1),)
    with pytest.warns(UserWarning, match="1,234 by contacts"):
        plan(toy_task(3, [inner, Ramp()]), FAR)
