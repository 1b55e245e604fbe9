"""Robust planning: risks against hand-computed values, costs against single members, plans that differ."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Budget, Ensemble, Member, Schedule, make_start, plan
from hmc.robust import EnsembleEvaluator
from tests.toy import Bad, Push, ToySim, all_schedules, slow_cost, toy_task

HIDDEN = (0.0, 0.4, -0.3)
X = [0.4, -0.2]


def shifted(x, u):
    return x + torch.tensor([0.3, -0.1], dtype=x.dtype), u


def members() -> list[Member]:
    """Three toys with different hidden dynamics, the last one begun elsewhere."""
    made = [Member(partial(ToySim, hidden=h)) for h in HIDDEN]
    return [*made[:2], replace(made[2], disturb=shifted)]


def by_hand(modes) -> list[float]:
    """J of one schedule on each member."""
    starts = [X, X, [X[0] + 0.3, X[1] - 0.1]]
    tasks = [toy_task(4, hidden=h) for h in HIDDEN]
    return [slow_cost(task, modes, x) for task, x in zip(tasks, starts, strict=True)]


def evaluator(tail, num_worlds=81) -> EnsembleEvaluator:
    task = replace(toy_task(4), ensemble=Ensemble(members(), tail))
    sim = task.make_sim(num_worlds)
    return EnsembleEvaluator(task, sim, make_start(task, sim, X))


@pytest.mark.parametrize(
    ("tail", "risk"),
    [(1.0, 2.5), (0.0, 4.0), (0.25, 4.0), (0.5, 3.5), (0.375, (4 + 0.5 * 3) / 1.5), (0.75, 3.0)],
)
def test_risk_by_hand(tail, risk):
    costs = torch.tensor([[1.0], [4.0], [2.0], [3.0]], dtype=torch.float64)
    ensemble = Ensemble(members() + members()[:1], tail)
    assert float(ensemble.risk(costs)[0]) == pytest.approx(risk)
    assert float(ensemble.weights(costs).sum()) == pytest.approx(1.0)


def test_one_world_that_breaks_is_an_infinite_risk_however_many_do_not():
    costs = torch.tensor([[1.0, 1.0], [math.inf, 2.0]], dtype=torch.float64)
    for tail in (0.0, 0.7, 1.0):
        risk = Ensemble(members()[:2], tail).risk(costs)
        assert risk.isinf().tolist() == [True, False]


@pytest.mark.parametrize("tail", [0.0, 0.5, 1.0])
def test_costs_are_risks_of_the_members_costs(tail):
    rows = all_schedules(3, 4)[::5]
    ours = evaluator(tail)
    costs = ours.costs(rows)
    expected = torch.tensor([by_hand(row) for row in rows.tolist()], dtype=torch.float64).T
    torch.testing.assert_close(costs, ours.ensemble.risk(expected), rtol=1e-12, atol=0)
    for row in rows[:3]:
        schedule = Schedule(tuple(row.tolist()))
        assert ours.follow(schedule) == pytest.approx(float(ours.costs(row[None])[0]), rel=1e-12)
        assert sum(ours.terms(schedule).values()) == pytest.approx(ours.follow(schedule), rel=1e-12)
    assert torch.equal(evaluator(tail, num_worlds=7).costs(rows), costs)


@given(tail=st.floats(0, 1), rank=st.integers(0, 80))
@settings(max_examples=30)
def test_pruning_is_exact_up_to_the_bound(tail, rank):
    rows = all_schedules(3, 4)
    plain = evaluator(tail).costs(rows)
    bound = float(plain.sort().values[rank])
    costs = evaluator(tail).costs(rows, bound)
    assert torch.equal(costs[plain <= bound], plain[plain <= bound])
    assert bool((costs[plain > bound] > bound).all())


@pytest.mark.parametrize("tail", [0.0, 1.0])
def test_a_plan_is_the_best_of_all_for_the_ensemble(tail):
    ensemble = Ensemble(members(), tail)
    task = replace(toy_task(4), ensemble=ensemble)
    found = plan(task, X, solver="exhaustive")
    expected = torch.tensor([by_hand(found.schedule.modes)], dtype=torch.float64).T
    assert found.cost == pytest.approx(float(ensemble.risk(expected)[0]), rel=1e-12)
    assert found.cost <= found.incumbent_cost
    assert plan(task, X, solver="exhaustive", sim=task.make_sim(5)) == found


@pytest.mark.parametrize("steps", [1, 20, 30, 60, 120, 200])
def test_a_draw_takes_a_rollout_of_each_member_out_of_the_budget(steps):
    task = replace(toy_task(4), ensemble=Ensemble(members()))
    found = plan(task, X, samples=8, pairs=4, budget=Budget(control_steps=steps))
    assert found.control_steps <= max(steps, 3 * 4), "the incumbent is always rolled out"


def test_an_ensemble_of_the_nominal_model_changes_nothing():
    task = toy_task(5)
    alone = plan(task, X)
    same = plan(replace(task, ensemble=Ensemble([Member(task.make_sim)])), X)
    assert (same.schedule, same.costs, same.switches) == (alone.schedule, alone.costs, alone.switches)


def test_what_breaks_on_one_member_is_avoided():
    """The bold mode is best on the nominal model and leaves the second one's safe range."""
    modes = [Push(0.1), Push(2.0)]
    cost = replace(toy_task().cost, stage={"far": lambda x, u, u_prev, k: (x[:, 0] - 9.0) ** 2}, terminal={})
    task = toy_task(5, modes, cost)
    assert 1 in plan(task, X).schedule.modes
    edge = Ensemble([Member(task.make_sim), Member(lambda n: ToySim(n, blow_up=1.0))], tail=1.0)
    careful = plan(replace(task, ensemble=edge), X)
    assert math.isfinite(careful.cost)
    assert careful.diverged > 0


def test_divergence_is_counted_once_a_member():
    task = toy_task(4, [Push(1.0), Bad(1)])
    found = plan(replace(task, ensemble=Ensemble([Member(task.make_sim)] * 2)), X)
    assert set(found.schedule.modes) <= {0, 1}
    assert math.isfinite(found.cost)


def test_bad_ensembles():
    with pytest.raises(ValueError, match="at least one member"):
        Ensemble([])
    with pytest.raises(ValueError, match=r"tail is a share of the outcomes, 0 to 1, got 1\.5"):
        Ensemble(members(), 1.5)
