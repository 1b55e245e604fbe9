"""Costs on every engine against rollouts one by one: shared beginnings, pruning, modes with memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Budget, Evaluator, Schedule, Start, SwitchSpace, Task, make_start, plan
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import CostCfg, FlipCfg, JumpCfg, flip_task
from hmc.sampling import SamplingCfg, SamplingMpc
from hmc.sim.base import Sim
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state
from tests.naive import naive_cost

SAMPLING = SamplingCfg(samples=3, horizon=3, knots=2, replan_every=2, worlds=4)
JUMP = JumpCfg(guess=((-0.2, -2.0, 3.0, -1.7), (0.2, -1.1, 1.1, -0.8)), sampling=SAMPLING)
# two learned policies, MPPI, and a motion, all of which remember something; a short tail, so that there is
# something to give up before the end
FLIP = FlipCfg(horizon=6, command=50, jump=JUMP, idle=("home",), cost=CostCfg(tail=0.02))
seeds = st.integers(0, 9999)


def neighbours(task: Task, seed: int, number: int) -> tuple[Schedule, torch.Tensor]:
    """An incumbent of some stretches, and it after some of its switches, (number, T)."""
    generator, modes = torch.Generator().manual_seed(seed), len(task.modes)
    runs = torch.randint(modes, (3,), generator=generator).repeat_interleave(-(-task.horizon // 3))
    incumbent, space = Schedule(runs[: task.horizon]), SwitchSpace(modes, task.horizon)
    return incumbent, space.stitch(incumbent, torch.randint(len(space), (number,), generator=generator))


def compare(
    task: Task,
    start: Start,
    sims: Sequence[Sim],
    seed: int,
    number: int,
    alone: tuple[Task, Sim],
    near: float,
) -> int:
    """Costs with shared beginnings, whole and pruned, against those of the definition.

    Args:
        task: to evaluate; cost terms are non-negative.
        start: where from.
        sims: two; what does not fit into one at once is rolled out in parts.
        seed, number: of the schedules.
        alone: the same task made again, so that no mode finds what the other one kept, and a world of it.
        near: what costs may differ by, as a share of them; 0 for not a bit.

    Returns:
        How many were given up.
    """
    incumbent, rows = neighbours(task, seed, number)
    expected = [naive_cost(alone[0], row, start, alone[1]) for row in (incumbent.modes, *rows.tolist())]
    middle, gone = sorted(expected)[number // 2], 0
    for sim, limits in zip(sims, ((math.inf,), (0.8 * middle, middle, math.inf)), strict=True):
        for mode in task.modes:
            mode.forget()
        ours = Evaluator(task, sim, start)
        assert ours.follow(incumbent) == pytest.approx(expected[0], rel=near, abs=0)
        for limit in limits:
            costs = ours.costs(rows, limit).tolist()
            for cost, wanted in zip(costs, expected[1:], strict=True):
                if wanted <= limit * (1 - near) or cost < math.inf:
                    assert cost == pytest.approx(wanted, rel=near, abs=0)
        gone += ours.pruned
    return gone


@given(
    cfg=st.builds(
        CartpoleCfg,
        horizon=st.integers(3, 14),
        num_modes=st.integers(2, 5),
        angle=st.floats(-math.pi, math.pi),
        substeps=st.integers(1, 2),
    ),
    seed=seeds,
    worlds=st.integers(1, 9),
)
@settings(max_examples=20)
def test_cartpole(cfg, seed, worlds):
    """To the bit, whatever the number of worlds."""
    task, again = cartpole(cfg), cartpole(cfg)
    start = make_start(task, task.make_sim(1), initial_state(cfg))
    sims = [task.make_sim(64), task.make_sim(worlds)]
    compare(task, start, sims, seed, 12, (again, again.make_sim(1)), 0.0)


@cache
def flip(device: str, worlds: tuple[int, ...]) -> tuple[Task, Task, list[Sim]]:
    """The flip on engine warp's device, or without one on the C engine; the same again; simulators."""
    cfg = replace(FLIP, engine="warp" if device else "mujoco", device=device)
    task, again = flip_task(cfg, threads=1), flip_task(cfg, threads=1)
    assert isinstance(task.modes["jump"], SamplingMpc)
    assert all(mode.memory_size > 0 for mode in task.modes)
    return task, again, [task.make_sim(n) for n in worlds]


def disturbed(task: Task, sim: Sim, seed: int, mode: int) -> Start:
    """Beside a foot stand, in the middle of a mode."""
    x = FOOTSTAND.state()
    x[7:] += 0.1 * torch.randn(30, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return make_start(task, sim, x, x[7:19], mode, k=seed % 5)


@given(seed=seeds, mode=st.integers(0, 3), worlds=st.sampled_from([1, 3]))
@settings(max_examples=4)
def test_mujoco(seed, mode, worlds):
    """To the bit, with policies, a motion and MPPI, which re-plans with what is left of its plan."""
    task, again, (one, three, many, alone) = flip("", (1, 3, 40, 1))
    start = disturbed(task, one, seed, mode)
    compare(task, start, [many, one if worlds == 1 else three], seed, 12, (again, alone), 0.0)


@pytest.mark.parametrize(("device", "near"), [("cpu", 0.0), ("cuda", 1e-3)])
def test_warp(device, near, request):
    """To the bit on Warp's CPU device; on a GPU, which adds up in another order, to 1e-3 of the cost."""
    pytest.importorskip("mujoco_warp")
    if device == "cuda":
        request.getfixturevalue("cuda")
    task, again, (one, few) = flip(device, (1, 3))
    start = disturbed(task, one, 5, 1)
    assert compare(task, start, [few, few], 5, 4, (again, one), near) > 0


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
def test_a_plan_does_not_depend_on_threads(solver):
    """Of engine, policies and MPPI: to the bit, at 1, 2 and 3."""
    x, options = FOOTSTAND.state(), {"solver": solver, "samples": 12, "seed": 3}
    options |= {"budget": Budget(draws=60)} if solver == "sample" else {"iterations": 1}
    found: list[Any] = []
    for threads in (1, 2, 3):
        task = flip_task(FLIP, seed=2, threads=threads)
        found.append(plan(task, x, u=x[7:19], mode="foot", schedule=["hand"] * 6, **options))
    assert found[0].switches
    assert found[0] == found[1] == found[2]
