"""What a search may spend: draws, control steps, seconds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hmc import Budget, Rules, plan
from tests.toy import Damp, Push, ToySim, toy_task

FAR = [1.5, 1.0]


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
@pytest.mark.parametrize("draws", [1, 10, 57])
def test_a_draw_budget_is_kept(solver, draws):
    result = plan(toy_task(8), FAR, solver=solver, samples=16, budget=Budget(draws=draws))
    assert result.draws == draws
    assert result.stopped_by == "draws"
    assert not result.locally_optimal
    assert result.cost <= result.incumbent_cost


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
@pytest.mark.parametrize("steps", [8, 9, 60, 120])
def test_a_control_step_budget_is_never_exceeded(solver, steps):
    result = plan(toy_task(8), FAR, solver=solver, budget=Budget(control_steps=steps))
    assert 8 <= result.control_steps <= steps
    assert result.stopped_by == "control_steps"
    if steps >= 60:
        assert result.control_steps > steps - 16, "what fits is used"
        assert result.cost < result.incumbent_cost


@pytest.mark.parametrize("worlds", [1, 2, 5, 40])
@pytest.mark.parametrize("rules", [None, Rules(max_changes=2)])
def test_all_control_steps_are_within_the_budget_and_reported(worlds, rules):
    """Those of recording what was found included, whatever fits into the simulator."""
    for steps in range(20, 200, 12):
        sim = ToySim(worlds)
        task = replace(toy_task(12), rules=rules)
        found = plan(task, FAR, samples=4, pairs=2, seed=steps, sim=sim, budget=Budget(control_steps=steps))
        assert sum(map(len, sim.stepped)) == found.control_steps <= steps


def test_a_budget_counts_although_nothing_had_to_be_stepped_yet():
    """The incumbent is known from before, or breaks a rule: searches on, and within the budget."""
    task = toy_task(6)
    known = plan(task, FAR, iterations=0).known
    wild = replace(task, rules=Rules(max_changes=1))
    for one, options in ((task, {"known": known}), (wild, {"schedule": [0, 1, 0, 1, 0, 1]})):
        sim = ToySim(9)
        found = plan(one, FAR, samples=8, sim=sim, budget=Budget(control_steps=60), **options)
        assert found.draws > 0
        assert sum(map(len, sim.stepped)) == found.control_steps <= 60
        assert found.cost < plan(one, FAR, iterations=0, **options).cost


def test_control_steps_inside_modes_count():
    class Nested(Damp):
        def act(self, x, u, memory, k):
            self.control_steps += 10 * len(x)
            return super().act(x, u, memory, k)

    result = plan(toy_task(6, [Push(1.0), Nested()]), FAR, schedule=[1] * 6, iterations=0)
    assert result.control_steps == 6 + 60
    budget = Budget(control_steps=200)
    limited = plan(toy_task(6, [Push(1.0), Nested()]), FAR, schedule=[0] * 6, samples=2, budget=budget)
    assert limited.stopped_by == "control_steps"
    assert limited.control_steps <= 200 + 2 * 66, "at most one batch too many"
    assert 6 * limited.rollouts < limited.control_steps


def test_control_steps_on_entry_into_modes_count():
    """Of a mode that plans as it is entered, and plays that."""

    class PlansOnce(Damp):
        memory_size = 1

        def reset(self, x, u, k):
            self.control_steps += 10 * len(x)
            return super().reset(x, u, k)

    task = toy_task(6, [Push(1.0), PlansOnce()])
    assert plan(task, FAR, schedule=[0, 1, 1, 0, 1, 1], iterations=0).control_steps == 6 + 20


def test_a_budget_that_reaches_all_of_omega_converges():
    task = toy_task(4)
    best = plan(task, FAR)
    again = plan(task, FAR, schedule=best.schedule, budget=Budget(draws=30))
    assert (again.stopped_by, again.draws, again.coverage) == ("converged", 30, 1.0)


def test_wall_clock_budget_stops_in_mid_batch_and_says_so(monkeypatch):
    clock = iter(range(10_000))
    monkeypatch.setattr("hmc.budget.time.perf_counter", lambda: float(next(clock)))
    task = toy_task(8)
    result = plan(task, FAR, samples=200, budget=Budget(seconds=30), sim=task.make_sim(16))
    assert result.stopped_by == "seconds"
    assert result.machine_dependent
    assert "another speed" in str(result)
    assert 0 < result.draws < 100, "two or three chunks of 16 worlds x 8 steps"
    assert result.cost < result.incumbent_cost
    assert result.control_steps < 8 + 30 * 16


def test_no_time_gives_back_the_incumbent():
    result = plan(toy_task(6), FAR, schedule=[0, 1, 2, 0, 1, 2], budget=Budget(seconds=1e-9))
    assert result.schedule.modes == (0, 1, 2, 0, 1, 2)
    assert (result.draws, result.rollouts, result.coverage) == (0, 1, 0.0)
