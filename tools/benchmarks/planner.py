"""What the search itself costs, and how long the Go2 plans."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hmc import Evaluator, Receding, Schedule, SwitchSpace, Task, make_start, plan
from hmc.cfg import load
from hmc.cost import Cost
from hmc.go2.model import SUBSTEPS, load_model
from hmc.go2.policy import Policy
from hmc.go2.task import flip_task, jump_mode, make_sim, policy_path
from hmc.modes import ConstantInput, ModeSet
from hmc.sim.ids import Ids, count
from hmc.sim.mujoco import MujocoSim
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state
from tools import closed_loop
from tools.benchmarks import engine
from tools.benchmarks.figures import Common, Figures

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Planner(Common):
    """What the search itself costs, on a system that costs nothing, on the cartpole and on the Go2.

    Attributes:
        horizon: of the system that costs nothing and of the Go2's search of all of Omega, control steps.
        cartpole_horizon: of the cartpole.
        samples: switches a batch of the cartpole's converged plan.
        max_samples: that they may double to.
        seeds: of that plan; how many draws it takes is chance.
        few: horizon of the evaluator in few worlds.
        repeats: of what is fast.
        clock: of the engine inside the evaluator: wall, or cpu, as for `Engine`.
        ticks: of the Go2's closed loop, from shortly before the command to flip on.
        set: overrides of cfg/flip.toml.
    """

    horizon: int = 50
    cartpole_horizon: int = 100
    samples: int = 4096
    max_samples: int = 16384
    seeds: int = 3
    few: int = 20
    repeats: int = 5
    clock: Literal["wall", "cpu"] = "wall"
    ticks: int = 20
    set: tuple[str, ...] = ()


@torch.no_grad()
def planner(args: Planner) -> Figures:
    """Overhead a candidate, exact and converged plans of the cartpole, the engine's share, and the Go2's
    planning."""
    figures = Figures()
    modes = ModeSet([ConstantInput(str(i), float(i)) for i in range(3)])
    zero = Cost({"nothing": lambda x, u, u_prev, k: x[:, 0]}, nonnegative=True)
    still = Task("still", modes, zero, args.horizon, NullSim)
    size = len(SwitchSpace(3, args.horizon))
    sim = NullSim(size + 1)
    found = [plan(still, [0.0], solver="exhaustive", samples=size, sim=sim) for _ in range(args.repeats)]
    figures.add(
        "us_per_candidate",
        statistics.median(1e6 * p.elapsed / p.draws for p in found),
        f"plan() with modes and simulator that do nothing [us]; T {args.horizon}, M 3, all of Omega",
    )
    _cartpole(figures, args)

    run = load(ROOT / "cfg" / "flip.toml", closed_loop.RunCfg, args.set)
    if all(
        policy_path(*names).is_file()
        for names in (("footstand", run.task.foot), ("handstand", run.task.hand))
    ):
        turns = engine.Turns(args.threads, args.repeats, args.clock)
        engine.evaluator(figures, turns, policy_path("handstand", run.task.hand), args.horizon, args.few)
        _omega(figures, args, run)
        _replan(figures, args, run)
        _ticks(figures, args, run)
        _ensembles(figures, args, run)
    else:
        figures.notes["go2"] = "no policies: the Go2's part is left out"
    return figures


def _cartpole(figures: Figures, args: Planner) -> None:
    """The single-switch problem solved exactly, and a plan that no single switch improves."""
    cfg = CartpoleCfg(horizon=args.cartpole_horizon)
    task, x, idle = cartpole(cfg), initial_state(cfg), [cfg.num_modes // 2] * cfg.horizon
    what = f"cartpole, T {cfg.horizon}, M {cfg.num_modes}"
    size = len(SwitchSpace(cfg.num_modes, cfg.horizon))
    sim = task.make_sim(size + 1)
    exact = [
        plan(task, x, schedule=idle, solver="exhaustive", samples=size, iterations=1, sim=sim)
        for _ in range(args.repeats)
    ]
    figures.add(
        "cartpole_exact_ms",
        1e3 * statistics.median(p.elapsed for p in exact),
        f"the best of all {size:,} switches, {exact[0].control_steps:,} control steps [ms]; {what}",
    )
    converged = [
        plan(task, x, schedule=idle, samples=args.samples, max_samples=args.max_samples, seed=seed)
        for seed in range(args.seeds)
    ]
    plans = ", ".join(
        f"{len(p.switches)} switches to {p.cost:.4g} with {p.draws:,} draws and {p.control_steps:,} control "
        f"steps in {p.elapsed:.2f} s"
        for p in converged
    )
    figures.add(
        "cartpole_converged_ms",
        1e3 * statistics.median(p.elapsed for p in converged),
        f"a locally optimal plan, median of {args.seeds} seeds [ms]: {plans}; {what}",
    )


def _omega(figures: Figures, args: Planner, cfg: closed_loop.RunCfg) -> None:
    """All of Omega from a foot stand, policies as modes, without and with pruning."""
    task = flip_task(cfg.task, threads=args.threads)
    foot, hand = task.modes["foot"], task.modes["hand"]
    modes = ModeSet([foot, hand, Policy(policy_path("handstand", cfg.task.hand), name="again")])
    x, u = closed_loop.disturbed_start(cfg.start, 0)
    size = len(SwitchSpace(3, args.horizon))
    naive = _each_alone(replace(task, modes=modes, rules=None), x, u, args.horizon, size)
    for name, nonnegative, what in (
        ("shared", False, "sharing beginnings"),
        ("pruned", True, "sharing and pruning"),
    ):
        cost = replace(task.cost, nonnegative=nonnegative)
        small = replace(task, modes=modes, cost=cost, horizon=args.horizon, rules=None)
        found = plan(small, x, u=u, schedule=["foot"] * args.horizon, solver="exhaustive", samples=size,
                     iterations=1, sim=small.make_sim(min(size, 1024)))  # fmt: skip
        what = f"{what}; Go2, T {args.horizon}, M 3"
        figures.add(
            f"{name}_fraction",
            found.control_steps / (args.horizon * size),
            f"control steps over T Z, {what}, {found.elapsed:.1f} s",
        )
        figures.add(
            f"{name}_time_fraction",
            found.elapsed / naive,
            f"wall time over that of all {size:,} schedules from their beginning, {naive:.1f} s, {what}",
        )


def _each_alone(task: Task, x: Tensor, u: Tensor, horizon: int, schedules: int) -> float:
    """How long it takes to roll out so many schedules from their beginning [s], by what some of them take."""
    many = min(schedules, 256)
    sim, cost = task.make_sim(many), task.cost
    sim.reset(x.expand(many, -1), u.expand(many, -1))
    began, before = time.perf_counter(), sim.u()
    parts = torch.arange(many).split(-(-many // len(task.modes)))
    memories = [mode.reset(x.expand(len(part), -1), before[part], torch.zeros(len(part), dtype=torch.long))
                for mode, part in zip(task.modes, parts, strict=True)]  # fmt: skip
    for i in range(horizon):
        state, ks = sim.x(), torch.full((many,), i)
        acted = [mode.act(state[part], before[part], memory, ks[part])
                 for mode, part, memory in zip(task.modes, parts, memories, strict=True)]  # fmt: skip
        inputs, memories = torch.cat([action for action, _ in acted]), [memory for _, memory in acted]
        cost.stage_terms(state, inputs, before, ks)
        sim.step(inputs)
        before = inputs
    cost.terminal_terms(sim.x(), ks)
    return (time.perf_counter() - began) * schedules / many


class _Recorded(MujocoSim):
    """Keeps the inputs of its last rollout, (n, steps, nu), and the states that they led to, (n, nx)."""

    given: Tensor
    ends: Tensor

    def rollout(self, controls: Tensor, ids: Tensor) -> Tensor:
        self.given, states = controls, super().rollout(controls, ids)
        self.ends = states[:, -1]
        return states


def _replan(figures: Figures, args: Planner, cfg: closed_loop.RunCfg) -> None:
    """One MPPI update against the bare engine's rollouts under the same inputs."""
    settings = replace(cfg.task.jump.sampling, samples=30, horizon=40, replan_every=40, worlds=30)
    sim, bare = (_Recorded(load_model(), 30, substeps=SUBSTEPS, threads=args.threads) for _ in range(2))
    mpc = jump_mode(replace(cfg.task.jump, sampling=settings), lambda n: sim, seed=0)
    x, u = (row[None] for row in closed_loop.disturbed_start(cfg.start, 0))
    took: list[list[float]] = [[], []]
    for i in range(3 * args.repeats):
        k = torch.tensor([i])
        memory = mpc.reset(x, u, k)
        began = time.perf_counter()
        mpc.act(x, u, memory, k)
        took[0].append(time.perf_counter() - began)
        bare.reset(x.expand(30, -1), u.expand(30, -1))
        held = sim.given.repeat_interleave(SUBSTEPS, 1).numpy()
        began = time.perf_counter()
        found = bare.batch.rollout(held.shape[1], held, record=("qpos", "qvel"))
        took[1].append(time.perf_counter() - began)
        ends = np.concatenate([found["qpos"][:, -1], found["qvel"][:, -1]], 1)
        engine.same(sim.ends.numpy(), ends, "an MPPI update")
    figures.add(
        "mppi_overhead",
        statistics.median(took[0]) / statistics.median(took[1]),
        "an MPPI update of 30 rollouts of 40 control steps over Batch.rollout of as many",
    )


def _ticks(figures: Figures, args: Planner, cfg: closed_loop.RunCfg) -> None:
    """The Go2's closed loop as tools/flip.py runs it, around the moment of the command."""
    task = flip_task(cfg.task, threads=args.threads)
    world, (x, u) = make_sim(1, threads=args.threads), closed_loop.disturbed_start(cfg.start, 0)
    world.reset(x[None], u[None])
    loop = Receding(
        task,
        schedule=["foot"] * task.horizon,
        k=max(0, cfg.task.command - 5),
        **cfg.search.options(),
    )
    times, used, naive = [], 0, 0
    for _ in range(args.ticks):
        began = time.perf_counter()
        tick = loop.tick(
            world.x()[0], world.u()[0], world.save()[0] if closed_loop.same_model(cfg.task) else None
        )
        times.append(1e3 * (time.perf_counter() - began))
        used, naive = used + tick.plan.control_steps, naive + task.horizon * tick.plan.draws
        world.step(tick.u[None])
    p50, p99 = np.percentile(times, [50, 99])
    figures.add(
        "go2_tick_ms_p50", p50, f"planning time of a tick at cfg/flip.toml's budget, {args.ticks} ticks [ms]"
    )
    figures.add("go2_tick_ms_p99", p99, "the slowest of them [ms]")
    figures.add(
        "go2_us_per_control_step", 1e3 * sum(times) / used, "wall time a control step, all included [us]"
    )
    figures.add(
        "go2_control_steps_fraction", used / naive, "control steps used, MPPI's own included, over T x draws"
    )


def _ensembles(figures: Figures, args: Planner, cfg: closed_loop.RunCfg) -> None:
    """A batch of the flip's search on several models in step, against one model after the other."""
    x, u = closed_loop.disturbed_start(cfg.start, 0)
    draws, jump = cfg.search.samples + cfg.search.pairs + cfg.search.moves, replace(cfg.task.jump, mpc=False)
    for others in (2, 4):
        settings = replace(cfg.task, jump=jump, ensemble=replace(cfg.task.ensemble, members=others))
        task = flip_task(settings, threads=args.threads)
        assert task.ensemble is not None
        space, foot = SwitchSpace(3, task.horizon), Schedule.constant(0, task.horizon)
        at = torch.randperm(len(space), generator=torch.Generator().manual_seed(0))[:draws]
        rows, sim = space.stitch(foot, at), task.make_sim(draws + 1)
        start = make_start(task, sim, x, u, k=cfg.task.command)
        alone, starts = replace(task, ensemble=None), task.ensemble.starts(start)
        sims = [task.ensemble.make_sim([e] * (draws + 1)) for e in range(others + 1)]
        took: list[list[float]] = [[], []]
        for _ in range(args.repeats):
            each = [Evaluator(alone, own, begin) for own, begin in zip(sims, starts, strict=True)]
            took[0].append(_seconds([Evaluator(task, sim, start)], foot, rows))
            took[1].append(_seconds(each, foot, rows))
        figures.add(
            f"ensemble_{others + 1}_fraction",
            statistics.median(took[0]) / statistics.median(took[1]),
            f"time of {draws + 1} schedules on {others + 1} models at once over that on one after the other",
        )


def _seconds(evaluators: list[Evaluator], incumbent: Schedule, schedules: Tensor) -> float:
    """How long it takes to roll out an incumbent, then schedules (n, T) around it [s]."""
    began = time.perf_counter()
    for evaluator in evaluators:
        evaluator.follow(incumbent)
        evaluator.costs(schedules)
    return time.perf_counter() - began


class NullSim:
    """Worlds whose state never changes, at no cost: what is left is the planner's own work."""

    nx = nu = 1
    dt = 0.02
    cheap = True
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, num_worlds: int):
        self.num_worlds, self._zero = num_worlds, torch.zeros(num_worlds, 1, dtype=self.dtype)

    def x(self, ids: Ids = None) -> Tensor:
        return self._zero[: count(ids, self.num_worlds)]

    u = save = x

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        pass

    def step(self, u: Tensor, ids: Ids = None) -> None:
        pass

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        pass
