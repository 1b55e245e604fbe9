"""The paper's Proposition 1 and Theorems 1 and 2, against brute force over all M^T schedules."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hmc import Budget, Ensemble, Evaluator, Rules, Schedule, Switch, SwitchSpace, make_start, plan
from hmc.cost import Cost
from hmc.modes import Mode
from hmc.task import Task
from tests.toy import Push, Ramp, ToySim, all_schedules, toy_task


class RandomFeedback(Mode):
    """A random nonlinear state feedback."""

    def __init__(self, name: str, generator: torch.Generator):
        self.name = name
        self.gain = torch.randn(3, generator=generator, dtype=torch.float64).tolist()

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        a, b, c = self.gain
        return (2.0 * torch.tanh(a * x[:, :1] + b * x[:, 1:]) + c), memory


def random_task(seed: int, horizon: int) -> tuple[Task, list[float], list[int]]:
    """A task of three or four random modes, a random state and a random incumbent."""
    generator = torch.Generator().manual_seed(seed)
    modes = [RandomFeedback(f"random{i}", generator) for i in range(2 + seed % 2)]
    weights = torch.randn(3, generator=generator, dtype=torch.float64).tolist()
    cost = Cost(
        stage={
            "bowl": lambda x, u, u_prev, k: (x[:, 0] - weights[0]) ** 2,
            "ripple": lambda x, u, u_prev, k: torch.sin(5.0 * x[:, 1] + weights[1] * k.to(x.dtype)),
            "change": lambda x, u, u_prev, k: 0.1 * (u - u_prev)[:, 0] ** 2,
        },
        terminal={"end": lambda x, k: (x[:, 1] - weights[2]) ** 2},
    )
    task = toy_task(horizon, [*modes, Ramp()], cost)
    x = torch.randn(2, generator=generator, dtype=torch.float64).tolist()
    incumbent = torch.randint(len(task.modes), (horizon,), generator=generator).tolist()
    return task, x, incumbent


def brute_force(task: Task, x: list[float]) -> dict[tuple[int, ...], float]:
    """J of all M^T schedules."""
    sim, rows = task.make_sim(256), all_schedules(len(task.modes), task.horizon)
    costs = Evaluator(task, sim, make_start(task, sim, x)).costs(rows)
    return {tuple(row): cost for row, cost in zip(rows.tolist(), costs.tolist(), strict=True)}


systems = st.tuples(st.integers(0, 999), st.integers(1, 6))


@pytest.mark.parametrize("solver", ["exhaustive", "sample"])
@given(systems)
@settings(max_examples=15)
def test_proposition_1_no_single_switch_improves_the_result(solver, system):
    seed, horizon = system
    task, x, incumbent = random_task(seed, horizon)
    every = brute_force(task, x)
    result = plan(task, x, schedule=incumbent, solver=solver, tolerance=0.0, seed=seed)
    space = SwitchSpace(len(task.modes), horizon)
    assert result.locally_optimal
    assert result.cost == every[result.schedule.modes]
    for i in range(len(space)):
        assert every[result.schedule.stitch(space[i]).modes] >= result.cost
    assert result.cost <= every[tuple(incumbent)]
    assert result.cost == min(every.values()) or horizon > 1, (
        "with one step every schedule is one switch away"
    )


@pytest.mark.parametrize("solver", ["exhaustive", "sample"])
@given(systems)
@settings(max_examples=15)
def test_theorem_1_the_cost_never_rises_and_the_search_ends(solver, system):
    seed, horizon = system
    task, x, incumbent = random_task(seed, horizon)
    result = plan(task, x, schedule=incumbent, solver=solver, tolerance=0.0, seed=seed)
    assert all(after < before for before, after in pairwise(result.costs))
    assert len(result.switches) < len(task.modes) ** horizon
    fixed = plan(task, x, schedule=result.schedule, solver=solver, tolerance=0.0, seed=seed + 1)
    assert fixed.schedule == result.schedule
    assert fixed.switches == ()


@given(systems)
@settings(max_examples=10)
def test_exhaustive_solves_each_single_switch_problem_exactly(system):
    """Problem 5 at every iteration: the cost after each accepted switch is the least over all of Omega."""
    seed, horizon = system
    task, x, incumbent = random_task(seed, horizon)
    every = brute_force(task, x)
    result = plan(task, x, schedule=incumbent, solver="exhaustive", tolerance=0.0, samples=7)
    schedule, space = Schedule(tuple(incumbent)), SwitchSpace(len(task.modes), horizon)
    for switch, cost in zip(result.switches, result.costs[1:], strict=True):
        assert cost == min(every[schedule.stitch(space[i]).modes] for i in range(len(space)))
        schedule = schedule.stitch(switch)


def needle_task() -> tuple[Task, int]:
    """One switch of Omega costs less than the incumbent, mode 0 throughout; no other one does."""
    task = toy_task(3, [Push(0.0), Push(1.0)], Cost(stage={}, terminal={"end": lambda x, k: x[:, 0]}))
    space = SwitchSpace(2, 3)
    index = space.index(Switch(1, 1, 2))
    sim = task.make_sim(1)
    rolled = Evaluator(task, sim, make_start(task, sim, [0.0, 0.0]))
    wanted = rolled.trace(Schedule.constant(0, 3).stitch(space[index])).x[-1]
    cost = Cost(stage={}, terminal={"missed": lambda x, k: (x != wanted).any(1).to(x.dtype)})
    task = toy_task(3, [Push(0.0), Push(1.0)], cost)
    costs = brute_force(task, [0.0, 0.0])
    assert sorted(costs.values())[:2] == [0.0, 1.0]
    return task, index


def test_theorem_2_a_first_batch_holds_the_best_switch_with_probability_n_over_z():
    runs, samples = 400, 4
    task, index = needle_task()
    space = SwitchSpace(2, 3)
    sim = task.make_sim(samples)
    found = 0
    for seed in range(runs):
        result = plan(task, [0.0, 0.0], samples=samples, seed=seed, budget=Budget(draws=samples), sim=sim)
        assert result.switches in ((), (space[index],))
        found += len(result.switches)
    p = samples / len(space)
    assert abs(found - runs * p) <= 2.576 * math.sqrt(runs * p * (1 - p))


@given(st.integers(0, 10_000), st.integers(1, 12))
@settings(max_examples=20)
def test_theorem_2_z_over_n_batches_always_hold_it(seed, samples):
    task, index = needle_task()
    space = SwitchSpace(2, 3)
    batches = math.ceil(len(space) / samples)
    result = plan(task, [0.0, 0.0], samples=samples, seed=seed, budget=Budget(draws=batches * samples))
    assert result.switches == (space[index],)


def test_a_pair_gets_past_what_no_single_switch_improves():
    task, x, incumbent = random_task(57, 6)
    stuck = plan(task, x, schedule=incumbent, solver="exhaustive")
    assert stuck.locally_optimal
    assert plan(task, x, schedule=stuck.schedule, samples=200).cost == stuck.cost
    freed = plan(task, x, schedule=stuck.schedule, pairs=40)
    assert len(freed.switches) == 2
    assert freed.costs == (stuck.cost, freed.cost)
    assert freed.cost == min(brute_force(task, x).values()) < stuck.cost


searches = st.fixed_dictionaries(
    {
        "solver": st.sampled_from(["sample", "exhaustive"]),
        "samples": st.integers(2, 40),
        "max_samples": st.sampled_from([0, 30]),
        "order": st.sampled_from(["uniform", "tails"]),
        "pairs": st.sampled_from([0, 4]),
        "moves": st.sampled_from([0, 3]),
        "mode": st.sampled_from([None, "random1", "ramp"]),
        "ran": st.just(1),
    }
)
some_rules = st.builds(
    Rules,
    dwell=st.sampled_from([{}, {"ramp": 2}, {"random0": 3}]),
    forbidden=st.sampled_from([(), [("ramp", "random0")]]),
    max_changes=st.sampled_from([None, 1, 2]),
    guards=st.sampled_from([{}, {"random1": lambda x, k: x[:, 0] < 0.5}]),
)


@given(
    system=st.tuples(st.integers(0, 9999), st.integers(1, 5)),
    options=searches,
    rules=st.none() | some_rules,
    members=st.sampled_from([0, 0, 2]),
    tail=st.sampled_from([0.0, 0.7, 1.0]),
)
@settings(max_examples=200)
def test_pruning_never_changes_a_plan(system, options, rules, members, tail):
    """Without pruning, with it, and with a lower bound: what the next step's state is sure to cost."""
    task, x, incumbent = random_task(*system)
    stage = {name: lambda *args, f=f: 1.0 + f(*args) for name, f in task.cost.stage.items()}
    bowl = stage["bowl"]

    def ahead(x, k, steps):
        return 0.5 * bowl(x, None, None, k) if steps > 0 else torch.zeros(len(x))

    others = Ensemble(2, lambda which: ToySim(len(which), [0.3 * e for e in which]), tail=tail)
    plain = replace(
        task,
        cost=Cost(stage, task.cost.terminal),
        rules=rules,
        ensemble=others if members else None,
    )
    pruned = replace(plain, cost=Cost(stage, task.cost.terminal, nonnegative=True))
    options = {**options, "schedule": incumbent, "iterations": 2}
    if options["mode"] is None:
        del options["ran"]
    first, second, third = (
        plan(each, x, **options) for each in (plain, pruned, replace(pruned, lower_bound=ahead))
    )
    for other in (second, third):
        assert other.schedule == first.schedule
        assert other.costs == first.costs
        assert (other.switches, other.seen, other.stopped_by) == (
            first.switches,
            first.seen,
            first.stopped_by,
        )
    assert third.control_steps <= second.control_steps <= first.control_steps
