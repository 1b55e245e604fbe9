"""How work and time grow with horizon, modes, samples and worlds, on the C engine."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from statistics import median

import torch

from hmc import Evaluator, ModeSet, Schedule, SwitchSpace, Task, make_start, plan
from hmc.cfg import load
from hmc.go2.model import SUBSTEPS, load_model
from hmc.go2.policy import Policy
from hmc.go2.task import flip_task, policy_path
from hmc.sim.mujoco import MujocoSim
from tools import closed_loop
from tools.benchmarks.figures import Common, Figures, fits
from train.config import ROOT


@dataclass(frozen=True)
class Growth(Common):
    """How work and time grow with horizon, modes, samples and worlds: the Go2, policies as modes, C engine.

    Attributes:
        horizons: T of exact solutions with three modes [control steps].
        modes: M of exact solutions with the first horizon.
        samples: switches of a batch with three modes and the last horizon.
        worlds: that the engine steps together.
        repeats: of what is timed.
    """

    horizons: tuple[int, ...] = (10, 20, 30)
    modes: tuple[int, ...] = (2, 3, 5)
    samples: tuple[int, ...] = (16, 64, 256)
    worlds: tuple[int, ...] = (1, 16, 64, 256, 1024)
    repeats: int = 3


@torch.no_grad()
def growth(args: Growth) -> Figures:
    """Exact solutions, batches and bare steps, each at several sizes."""
    figures = Figures()
    fits(args.samples, "samples", args.horizons[-1])
    run = load(ROOT / "cfg" / "flip.toml", closed_loop.RunCfg)
    flip = flip_task(run.task, threads=args.threads)
    x, u = closed_loop.disturbed_start(run.start, 0)

    def task(modes: int, horizon: int) -> Task:
        """The flip between so many policies, which but for the first are all the handstand's."""
        hands = [
            Policy(policy_path("handstand", run.task.hand), name=f"hand{i}", threads=args.threads)
            for i in range(1, modes)
        ]
        # nothing is pruned, so that the work is that of the method alone
        cost = replace(flip.cost, nonnegative=False)
        return replace(
            flip, modes=ModeSet([flip.modes["foot"], *hands]), cost=cost, horizon=horizon, rules=None
        )

    for name, modes, horizon in (
        *((f"exact_t{horizon}", 3, horizon) for horizon in args.horizons),
        *((f"exact_m{modes}", modes, args.horizons[0]) for modes in args.modes),
    ):
        small, size = task(modes, horizon), len(SwitchSpace(modes, horizon))
        sim, took = small.make_sim(min(size, 1024)), []
        for _ in range(args.repeats):
            found = plan(small, x, u=u, schedule=["foot"] * horizon, solver="exhaustive", samples=size,
                         iterations=1, sim=sim)  # fmt: skip
            took.append(found.elapsed)
        what = f"all {size:,} switches, T {horizon}, M {modes}"
        shared = (modes - 1) * horizon * (horizon + 1) * (horizon + 2) // 6 + horizon
        figures.add(f"{name}_control_steps", found.control_steps, f"{what}; one batch takes {shared:,}")
        figures.add(f"{name}_ms", 1e3 * median(took), f"{what} [ms]")
    small = task(3, args.horizons[-1])
    space, foot = SwitchSpace(3, small.horizon), Schedule.constant(0, small.horizon)
    for samples in args.samples:
        sim, took = small.make_sim(samples + 1), []
        at = torch.randperm(len(space), generator=torch.Generator().manual_seed(0))[:samples]
        for _ in range(args.repeats):
            evaluator = Evaluator(small, sim, make_start(small, sim, x, u))
            began = time.perf_counter()
            evaluator.follow(foot)
            evaluator.costs(space.stitch(foot, at))
            took.append(time.perf_counter() - began)
        figures.add(
            f"batch_{samples}_ms", 1e3 * median(took), f"{samples} switches at once, T {small.horizon} [ms]"
        )
    for worlds in args.worlds:
        alone, took = MujocoSim(load_model(), worlds, threads=args.threads), []
        alone.reset(x.expand(worlds, -1), u.expand(worlds, -1))
        rows = alone.save()
        for _ in range(args.repeats):
            alone.load(rows)
            began = time.perf_counter()
            for _ in range(10):
                alone.step(u.expand(worlds, -1))
            took.append(time.perf_counter() - began)
        rate = 10 * SUBSTEPS * worlds / median(took)
        figures.add(f"worlds_{worlds}_steps_per_s", rate, "physics steps/s of the C engine")
    return figures
