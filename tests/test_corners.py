"""Corners of the search, each against rollouts one by one."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import pytest
import torch
from torch import Tensor

from hmc import Budget, Cost, Evaluator, Mode, ModeSet, PlanInterrupted, Rules, Schedule, make_start, plan
from hmc.running import Running
from hmc.solvers import Search
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state
from tests.toy import Bad, Damp, Push, Ramp, all_schedules, slow_cost, toy_task

ENDLESS = Cost({"place": lambda x, u, u_prev, k: 1 + x[:, 0] ** 2}, nonnegative=True)  # no terminal terms


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize("after", [0, 2, 5])
def test_a_schedule_that_diverges_is_no_cheap_one_where_the_end_costs_nothing(cheap, after):
    task = toy_task(6, [Push(0.0), Bad(after), Push(1.0)], ENDLESS, cheap=cheap)
    found = plan(task, [0.3, 0.0], schedule=[1] * 6, solver="exhaustive")
    assert found.incumbent_cost == slow_cost(task, [1] * 6, [0.3, 0.0]) == float("inf")
    best = min(slow_cost(task, modes, [0.3, 0.0]) for modes in all_schedules(3, 6).tolist())
    assert best <= found.cost == slow_cost(task, found.schedule.modes, [0.3, 0.0]) < float("inf")


@pytest.mark.parametrize("cheap", [False, True])
def test_nor_is_one_that_a_guard_bars(cheap):
    task = toy_task(6, [Push(0.0), Push(1.0)], ENDLESS, cheap=cheap)
    task = replace(task, rules=Rules(guards={"push1": lambda x, k: k < 2}))
    found = plan(task, [0.3, 0.0], schedule=[0, 0, 0, 1, 1, 1])
    assert found.incumbent_cost == float("inf")
    assert 1 not in found.schedule.modes[2:]
    assert found.ruled_out > 0


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
def test_ctrl_c_before_what_improves_is_noted_leaves_no_certificate(solver):
    def offer(self: Search, switches: object, cost: float, equal: bool = False) -> None:
        if cost < self.bound:
            raise KeyboardInterrupt

    with mock.patch.object(Search, "offer", offer), pytest.raises(PlanInterrupted) as caught:
        plan(toy_task(4), [1.5, 1.0], solver=solver, samples=1000)
    assert not caught.value.plan.locally_optimal
    assert plan(toy_task(4), [1.5, 1.0], solver=solver, samples=1000).cost < caught.value.plan.cost


@pytest.mark.parametrize("worlds", range(200, 260, 6))
def test_what_a_plan_hands_on_is_whole(worlds):
    """The incumbent is rolled out beside others again, and may be given up there."""
    task, x = cartpole(CartpoleCfg(horizon=40)), initial_state()
    first = plan(task, x, solver="exhaustive")
    options = {"schedule": first.schedule, "solver": "exhaustive", "tolerance": 0.5}
    again = plan(task, x, sim=task.make_sim(worlds), **options)
    assert len(again.known) == 40
    assert again.known.cost == again.cost
    options = {"schedule": again.schedule, "budget": Budget(draws=64)}
    assert plan(task, x, known=again.known, **options).cost == plan(task, x, **options).cost


@pytest.mark.parametrize("room", [300, 400, 600])
@pytest.mark.parametrize("steps", [500, 2000, 3000])
def test_control_steps_are_not_exceeded_in_parts(room, steps):
    task = cartpole(CartpoleCfg(horizon=30, num_modes=3))
    options = {"schedule": [0, 2] * 15, "solver": "exhaustive", "room": room * 1024}
    found = plan(task, initial_state(), budget=Budget(control_steps=steps), **options)
    assert found.control_steps <= steps
    assert found.draws > 0


class InPlace(Mode):
    """Counts its steps in the memory that it is given, and acts in one buffer."""

    name, memory_size = "in place", 1

    def __init__(self) -> None:
        self._buffer = torch.empty(0, 1, dtype=torch.float64)

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        memory[:, 0] += 1
        if len(self._buffer) != len(x):
            self._buffer = torch.empty(len(x), 1, dtype=torch.float64)
        self._buffer[:] = 0.3 * memory - x[:, :1]
        return self._buffer, memory


class Counting(Mode):
    """The same in tensors of its own."""

    name, memory_size = "in place", 1

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        return 0.3 * (memory + 1) - x[:, :1], memory + 1


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize("others", [[], [Push(1.0), Damp()], [Ramp()]])
def test_a_mode_may_work_in_place(cheap, others):
    rows = all_schedules(len(others) + 1, 5)
    found = []
    for mode in (InPlace(), Counting()):
        task = toy_task(5, [*others, mode], cheap=cheap)
        sim = task.make_sim(len(rows))
        evaluator = Evaluator(task, sim, make_start(task, sim, [0.4, -0.2]))
        evaluator.follow(Schedule((len(others),) * 5))
        found.append(evaluator.costs(rows))
    assert torch.equal(*found)


def test_what_a_robot_s_mode_remembers_is_its_own_copy():
    """Between two of its steps a planner rolls the same mode out, in the same buffers."""
    mode = InPlace()
    running = Running(ModeSet([mode]))
    x, u = torch.tensor([0.4, -0.2], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    for step in range(1, 4):
        running.act(0, x, u, step)
        mode.act(x[None], u[None], torch.full((1, 1), 7.0, dtype=torch.float64), torch.tensor([0]))
        assert running.memory is not None
        assert running.u is not None
        assert running.memory.tolist() == [step]
        assert running.u.tolist() == pytest.approx([0.3 * step - 0.4])


@pytest.mark.parametrize("seed", range(5))
def test_iterations_are_improvements_of_one_switch_or_two(seed):
    options = {"pairs": 8, "moves": 4, "samples": 4, "seed": seed}
    for iterations in (1, 2):
        found = plan(toy_task(6), [1.5, 1.0], iterations=iterations, **options)
        assert found.stopped_by == "iterations"
        assert len(found.steps) == iterations == len(found.costs) - 1
        assert iterations <= len(found.switches) <= 2 * iterations


def test_how_long_a_mode_has_run_is_of_the_start_not_of_what_was_known():
    task, x = toy_task(6, [Push(1.0), Push(0.0)]), [0.4, -0.2]
    known = plan(task, x, mode=0, ran=3).known
    again = plan(task, x, mode=0, ran=7, known=known).known
    assert again.start(0).ran == 7
