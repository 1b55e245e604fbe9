"""Lower bounds of what is left of a rollout: admissible, used to give up, and never seen in a plan."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hmc import Evaluator, Plan, PlanInterrupted, Schedule, SwitchSpace, make_start, plan, solvers
from hmc.branches import branches, fan
from hmc.cost import Cost
from hmc.modes import ConstantInput, Mode
from hmc.sim.cartpole import CartpoleParams, CartpoleSim
from hmc.solvers import Search
from hmc.task import Task
from hmc.tasks.cartpole import CartpoleCfg, TailBound, cartpole, initial_state
from tests.test_theorems import RandomFeedback
from tests.toy import Push, ToySim, toy_task

cfgs = st.builds(
    CartpoleCfg,
    horizon=st.integers(2, 40),
    dt=st.floats(0.005, 0.08),
    substeps=st.integers(1, 2),
    num_modes=st.integers(2, 5),
    angle=st.floats(-math.pi, math.pi),
    params=st.builds(
        CartpoleParams,
        cart_mass=st.floats(0.2, 3),
        pole_mass=st.floats(0.05, 2),
        pole_length=st.floats(0.2, 2),
        gear=st.floats(1, 20),
    ),
)
seeds = st.integers(0, 9999)


def to_go(cfg: CartpoleCfg, x: Tensor, u: float, steps: int) -> Tensor:
    """What an input held for so many steps costs from states x (n, 4), terminal cost included, (n,)."""
    task, sim = cartpole(cfg), CartpoleSim(len(x), cfg.params, dt=cfg.dt, substeps=cfg.substeps)
    held, ks, total = (
        torch.full((len(x), 1), u, dtype=torch.float64),
        torch.zeros(len(x)),
        torch.zeros(len(x)),
    )
    sim.reset(x, held)
    for _ in range(steps):
        total = total + task.cost.stage_terms(sim.x(), held, held, ks).sum(1) * cfg.dt
        sim.step(held)
    return total + task.cost.terminal_terms(sim.x(), ks).sum(1)


def what_matters(found: Plan) -> tuple[object, ...]:
    """What two plans that are equal have in common, also where an incumbent's terms are no numbers."""
    return found.schedule, found.costs, found.switches, found.seen, found.draws, found.stopped_by


@given(cfg=cfgs, seed=seeds, u=st.floats(-1, 1))
def test_the_cartpoles_bound_is_admissible(cfg, seed, u):
    x = torch.randn(200, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    x *= torch.tensor([2.0, 1.0, 4.0, 2.0])
    x[:20, 2:] = 0.0  # at rest, where it is tightest
    bound = TailBound(cfg)(ConstantInput("held", u), x, torch.zeros(200), cfg.horizon)
    assert bound is not None
    assert bool((bound <= to_go(cfg, x, u, cfg.horizon) * (1 + 1e-12)).all())


def test_the_cartpoles_bound_by_hand():
    cfg = CartpoleCfg(substeps=10)  # so that next to nothing has to be allowed for
    none, k = ConstantInput("none", 0.0), torch.zeros(3)

    def bound(mode: ConstantInput, x: Tensor, cfg: CartpoleCfg = cfg) -> list[float]:
        found = TailBound(cfg)(mode, x, k[: len(x)], 50)
        assert found is not None
        return list(found.tolist())

    level = math.sqrt(
        2 * 9.81 / 0.5
    )  # rad/s that carry a pole from level to upright, on a cart that is fixed
    fixed = replace(cfg, params=CartpoleParams(cart_mass=1e9))
    x = torch.tensor(
        [[math.pi, 0, 0, 0], [math.pi / 2, 3, 0, 1], [math.pi / 2, 0, level, 0]], dtype=torch.float64
    )
    # hanging it costs 4 (-1 - 1)^2 a second and as much at the end; level a quarter of it
    expected = [16.0 * (50 * 0.02 + 1), 4.0 * (50 * 0.02 + 1), 0.0]
    assert bound(none, x, fixed) == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert bound(none, x[:2]) == pytest.approx(expected[:2], rel=1e-3)
    # pushed it leans: from rest at the angle of rest it stays there, and the push costs itself
    lean = math.atan2(10 * 0.5 / 1.1, 9.81)
    rest = torch.tensor([[math.pi + lean, 0, 0, 0]], dtype=torch.float64)
    (found,) = bound(ConstantInput("half", 0.5), rest)
    assert found == pytest.approx(4 * (math.cos(math.pi - lean) - 1) ** 2 * 2 + 0.25, rel=1e-3)
    assert TailBound(cfg)(Push(0.0), x, k, 50) is None


@given(cfg=cfgs, seed=seeds, u=st.floats(-1, 1))
def test_what_a_step_adds_to_h_is_allowed_for(cfg, seed, u):
    """Of random states: no step adds more than is allowed for, and some add a good part of that."""
    bound, generator = TailBound(cfg), torch.Generator().manual_seed(seed)
    pull, lean, drift = bound._field(u)
    x = torch.rand(20_000, 4, generator=generator, dtype=torch.float64) * 2 - 1
    x[:, 0] *= math.pi
    x[:, 2] *= 2 * math.sqrt(
        2 * pull / cfg.params.pole_length * (1 + cfg.params.pole_mass / cfg.params.cart_mass)
    )
    before = bound._kept(x, pull, lean)
    x, before = x[before <= pull], before[before <= pull]
    sim = CartpoleSim(1, cfg.params, dt=cfg.dt, substeps=cfg.substeps)
    added = bound._kept(sim.advance(x, torch.full((len(x), 1), u, dtype=torch.float64)), pull, lean) - before
    assert 0.2 * drift < float(added.max()) <= drift


@given(cfg=cfgs, seed=seeds, worth=st.sampled_from([0, 8]))
@settings(max_examples=60)
def test_the_cartpoles_bound_never_changes_a_plan(cfg, seed, worth):
    task, x = cartpole(cfg), initial_state(cfg)
    generator = torch.Generator().manual_seed(seed)
    runs = torch.randint(cfg.num_modes, (4,), generator=generator).repeat_interleave(-(-cfg.horizon // 4))
    options = {"schedule": runs[: cfg.horizon].tolist(), "solver": "exhaustive", "iterations": 2}
    with mock.patch.object(solvers, "WORTH", worth):
        bounded, free = (plan(each, x, **options) for each in (task, replace(task, tail_bound=None)))
    assert what_matters(bounded) == what_matters(free)


def test_the_cartpoles_bound_saves_most_of_a_swing_up():
    cfg = CartpoleCfg(horizon=60)
    task, x = cartpole(cfg), initial_state(cfg)
    options = {"schedule": [2] * 60, "solver": "exhaustive", "iterations": 1}
    bounded, free = (plan(each, x, **options) for each in (task, replace(task, tail_bound=None)))
    assert what_matters(bounded) == what_matters(free)
    assert bounded.control_steps < 0.5 * free.control_steps


def bounded_task(seed: int, horizon: int, cheap: bool) -> tuple[Task, list[float], list[int]]:
    """Random modes, and as bound what a mode that runs to the end costs, all but the changes of input."""
    generator = torch.Generator().manual_seed(seed)
    modes = [RandomFeedback(f"random{i}", generator) for i in range(2 + seed % 2)]
    a, b = torch.randn(2, generator=generator, dtype=torch.float64).tolist()
    stage = {
        "bowl": lambda x, u, u_prev, k: (x[:, 0] - a) ** 2,
        "ripple": lambda x, u, u_prev, k: 1 + torch.sin(5 * x[:, 1] + k.to(x.dtype)),
        "change": lambda x, u, u_prev, k: 0.1 * (u - u_prev)[:, 0] ** 2,
    }
    cost = Cost(stage, {"end": lambda x, k: (x[:, 1] - b) ** 2}, nonnegative=True)

    def to_the_end(mode: Mode, x: Tensor, k: Tensor, steps: int) -> Tensor | None:
        if mode.name == "random1":
            return None
        sim, total = ToySim(len(x)), torch.zeros(len(x), dtype=torch.float64)
        sim.reset(x, torch.zeros(len(x), 1, dtype=torch.float64))
        for j in range(steps):
            now = sim.x()
            u, _ = mode.act(now, sim.u(), now[:, :0], k + j)
            total += cost.stage_terms(now, u, u, k + j).sum(1) * sim.dt
            sim.step(u)
        return total + cost.terminal_terms(sim.x(), k + steps).sum(1)

    task = replace(toy_task(horizon, modes, cost, cheap=cheap), tail_bound=to_the_end)
    x = torch.randn(2, generator=generator, dtype=torch.float64).tolist()
    return task, x, torch.randint(len(modes), (horizon,), generator=generator).tolist()


@given(
    system=st.tuples(seeds, st.integers(1, 8), st.booleans()),
    solver=st.sampled_from(["sample", "exhaustive"]),
    parts=st.integers(1, 4),
    samples=st.sampled_from([3, 20, 200]),
)
@settings(max_examples=200)
def test_a_tight_bound_never_changes_a_plan(system, solver, parts, samples):
    task, x, incumbent = bounded_task(*system)
    options = {"schedule": incumbent, "solver": solver, "samples": samples, "iterations": 2}
    plain = replace(task, tail_bound=None, cost=replace(task.cost, nonnegative=False))
    with mock.patch.multiple(solvers, PARTS=parts, WORTH=1):
        free, bounded = plan(plain, x, **options), plan(task, x, **options)
    assert what_matters(bounded) == what_matters(free)


def test_of_equal_switches_the_first_is_taken_though_another_came_before():
    """Only the number of steps with an input counts: many switches cost the same."""
    cost = Cost({"input": lambda x, u, u_prev, k: (u[:, 0] - 1).abs()}, nonnegative=True)
    task = toy_task(12, [Push(0.0, "off"), Push(1.0, "on"), Push(1.0, "also")], cost)
    bounded = replace(task, tail_bound=lambda mode, x, k, steps: None)
    for parts in range(2, 13):
        with mock.patch.multiple(solvers, PARTS=parts, WORTH=0):
            found = plan(bounded, [0.0, 0.0], solver="exhaustive", iterations=1)
        assert found.switches == plan(task, [0.0, 0.0], solver="exhaustive", iterations=1).switches


@pytest.mark.parametrize("cheap", [False, True])
def test_the_incumbent_is_rolled_out_beside_others(cheap):
    cfg = CartpoleCfg(horizon=40)
    task, x, idle = cartpole(cfg), initial_state(cfg), Schedule((2,) * 40)
    sim = task.make_sim(500)
    space, omega = SwitchSpace(5, 40), torch.arange(2 * 820)  # of modes 0 and 1
    with mock.patch.object(CartpoleSim, "cheap", cheap):
        one, other = (Evaluator(task, sim, make_start(task, sim, x)) for _ in range(2))
        one.aim(idle)
        assert one.control_steps == 0
        some = space.neighbours(idle, omega[::20])
        costs = one.costs(some)
        steps = one.control_steps
        assert one.follow(idle) == other.follow(idle)
        assert one.control_steps == steps
        assert one.pending == (40 if cheap else 0), "cheap steps are made again rather than recorded"
        assert torch.equal(other.costs(some), costs)
        # the next ones are worth less than the incumbent: it is given up on the way, and known all the same
        some, bound = space.neighbours(idle, omega[7::20]), float(costs.min())
        assert torch.equal(one.costs(some, bound), other.costs(some, bound))
        assert one.follow(idle) == other.follow(idle) > bound
        assert one.rollouts == other.rollouts
        one.record()
        assert one.pending == 0
        assert torch.equal(one.trunk.snapshots, other.trunk.snapshots)
        assert one.trunk.cost == other.trunk.cost
        alone = Evaluator(task, task.make_sim(1), make_start(task, sim, x))
        alone.aim(idle)  # no room beside it
        assert alone.trunk.cost == one.trunk.cost


def test_interrupted_before_the_incumbent_is_known():
    cfg = CartpoleCfg(horizon=40)
    task, x = cartpole(cfg), initial_state(cfg)
    with (
        mock.patch.object(Search, "_roll", side_effect=KeyboardInterrupt),
        pytest.raises(PlanInterrupted) as caught,
    ):
        plan(task, x, schedule=[2] * 40, solver="exhaustive")
    assert caught.value.plan.costs == (plan(task, x, schedule=[2] * 40, iterations=0).cost,)


@given(data=st.data(), horizon=st.integers(1, 8), beside=st.booleans())
def test_branches_settle_when_nothing_more_comes_of_them(data, horizon, beside):
    modes = st.lists(st.integers(0, 2), min_size=horizon, max_size=horizon)
    base = Schedule(tuple(data.draw(modes)))
    space = SwitchSpace(3, horizon)
    some = data.draw(st.lists(st.integers(0, len(space) - 1), min_size=1, max_size=30))
    switched = space.neighbours(base, torch.tensor(some))
    distinct = {tuple(row): i for i, row in enumerate(switched.tensor().tolist()) if tuple(row) != base.modes}
    if not distinct:
        return
    switched = switched[np.array(list(distinct.values()))]
    for tree in (
        fan(switched, base.modes if not beside else (), beside),
        branches(switched.tensor(), base.modes),
    ):
        rows, parents = tree.modes.tolist(), tree.parent.tolist()
        births = [i for i in range(horizon + 1) for _ in range(tree.born[i + 1] - tree.born[i])]
        for j, (row, settled) in enumerate(zip(rows, tree.settled.tolist(), strict=True)):
            assert len(set(row[settled:])) <= 1
            assert all(births[c] <= settled for c, parent in enumerate(parents) if parent == j)


def test_the_cartpoles_bound_never_changes_a_plan_where_worlds_diverge():
    params = CartpoleParams(cart_mass=0.2, pole_mass=2.0, pole_length=0.25)
    cfg = CartpoleCfg(horizon=30, dt=0.08, num_modes=3, angle=1.0, params=params)
    task, x = cartpole(cfg), initial_state(cfg)
    options = {"schedule": [1] * 30, "solver": "exhaustive", "iterations": 2}
    bounded, free = (plan(each, x, **options) for each in (task, replace(task, tail_bound=None)))
    assert free.diverged > 0
    assert what_matters(bounded) == what_matters(free)
