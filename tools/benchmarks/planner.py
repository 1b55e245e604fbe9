"""What the search itself costs, and how long the Go2 plans."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hmc import Budget, Receding, Task, plan
from hmc.cfg import load
from hmc.cost import Cost
from hmc.go2.task import flip_task, policy_path
from hmc.modes import ModeSet
from hmc.tasks.cartpole import CartpoleCfg, ConstantInput, cartpole, initial_state
from tools import flip
from tools.benchmarks.figures import Common, Figures

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Planner(Common):
    """What the search itself costs, on a system that costs nothing, on the cartpole and on the Go2.

    Attributes:
        horizon: of the systems that cost nothing, control steps.
        draws: switches evaluated on the cartpole.
        samples: switches a batch.
        ticks: of the Go2's closed loop, from shortly before the command to flip on.
        set: overrides of cfg/flip.toml.
    """

    horizon: int = 50
    draws: int = 2048
    samples: int = 256
    ticks: int = 20
    set: tuple[str, ...] = ()


@torch.no_grad()
def planner(args: Planner) -> Figures:
    """Overhead a candidate, the share of naive control steps, and the Go2's planning time."""
    figures = Figures()
    modes = ModeSet([ConstantInput(str(i), float(i)) for i in range(3)])
    zero = Cost({"nothing": lambda x, u, u_prev, k: x[:, 0]}, nonnegative=True)
    still = Task("still", modes, zero, args.horizon, NullSim)
    sim = NullSim(args.samples)
    found = [plan(still, [0.0], solver="exhaustive", samples=args.samples, sim=sim) for _ in range(3)]
    figures.add(
        "plan_overhead_us",
        statistics.median(1e6 * p.elapsed / p.draws for p in found),
        f"a candidate, modes and simulator that do nothing [us]; T {args.horizon}, M 3, all of Omega",
    )

    cfg = CartpoleCfg()
    sim_cart = cartpole(cfg).make_sim(args.samples)
    result = plan(
        cartpole(cfg), initial_state(cfg), samples=args.samples, budget=Budget(draws=args.draws), sim=sim_cart
    )
    figures.add(
        "candidates_per_s", result.draws / result.elapsed, f"cartpole, T {cfg.horizon}, M {cfg.num_modes}"
    )
    figures.add(
        "control_steps_fraction",
        result.control_steps / (cfg.horizon * result.draws),
        "control steps used over T x schedules, cartpole",
    )

    run = load(ROOT / "cfg" / "flip.toml", flip.RunCfg, args.set)
    if all(
        policy_path(*names).is_file()
        for names in (("footstand", run.task.foot), ("handstand", run.task.hand))
    ):
        _ticks(figures, args, run)
    else:
        figures.notes["go2"] = "no policies: the Go2's planning time is left out"
    return figures


def _ticks(figures: Figures, args: Planner, cfg: flip.RunCfg) -> None:
    """The Go2's closed loop as tools/flip.py runs it, around the moment of the command."""
    task = flip_task(cfg.task, threads=args.threads)
    world, (x, u) = task.make_sim(1), flip.disturbed_start(cfg.start, 0)
    world.reset(x[None], u[None])
    loop = Receding(
        task,
        schedule=["foot"] * task.horizon,
        k=max(0, cfg.task.command - 5),
        samples=cfg.search.samples,
        order=cfg.search.order,
        budget=Budget(control_steps=cfg.search.control_steps),
    )
    times, used, naive = [], 0, 0
    for _ in range(args.ticks):
        began = time.perf_counter()
        tick = loop.tick(world.x()[0], world.u()[0], world.save()[0])
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


class NullSim:
    """Worlds whose state never changes, at no cost: what is left is the planner's own work."""

    nx = nu = 1
    dt = 0.02
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, num_worlds: int):
        self.num_worlds, self._zero = num_worlds, torch.zeros(num_worlds, 1, dtype=self.dtype)

    def x(self, ids: Tensor | None = None) -> Tensor:
        return self._zero[: self.num_worlds if ids is None else len(ids)]

    u = save = x

    def reset(self, x: Tensor, u: Tensor, ids: Tensor | None = None) -> None:
        pass

    def step(self, u: Tensor, ids: Tensor | None = None) -> None:
        pass

    def load(self, rows: Tensor, ids: Tensor | None = None) -> None:
        pass
