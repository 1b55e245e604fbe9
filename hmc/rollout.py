"""Rollouts: many worlds on their way through their schedules, one control step at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.sim.base import Sim
from hmc.start import Start
from hmc.task import Task


class Worlds:
    """The worlds of a simulator together with what their modes remember.

    The simulator holds x, u and the engine's own history; this holds the rest of the rolled-out state:
    the mode that ran last in each world and its memory. Branching a rollout copies both.

    Attributes:
        control_steps: control steps made so far, over all worlds.
    """

    def __init__(self, task: Task, sim: Sim):
        self.task, self.sim = task, sim
        self.control_steps = 0
        self.mode = torch.full((sim.num_worlds,), -1, dtype=torch.long, device=sim.device)
        self.memory = torch.zeros(sim.num_worlds, task.modes.memory_size, dtype=sim.dtype, device=sim.device)

    def reset(self, start: Start, ids: Tensor) -> None:
        """Put worlds `ids` (n,) at `start`."""
        if start.snapshot is None:
            self.sim.reset(start.x.expand(len(ids), -1), start.u.expand(len(ids), -1), ids)
        else:
            self.sim.load(start.snapshot.expand(len(ids), -1), ids)
        self.mode[ids] = -1 if start.mode is None else start.mode
        self.memory[ids] = 0.0
        self.memory[ids, : len(start.memory)] = start.memory

    def act(self, ids: Tensor, modes: Tensor, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        """Let each world's mode choose its input; a mode that was not running before is entered first.

        Args:
            ids: worlds, (n,).
            modes: the mode of each at this step, (n,).
            x: their states, (n, nx).
            u: their last inputs, (n, nu).
            k: control step, (n,).

        Returns:
            The inputs to apply, (n, nu). The worlds' memory is already that after the step.
        """
        memory = self.memory[ids]
        entered = modes != self.mode[ids]
        action = torch.empty_like(u)
        for index, mode in enumerate(self.task.modes):
            rows = (modes == index).nonzero().squeeze(1)
            if len(rows) == 0:
                continue
            remembered = memory[rows, : mode.memory_size]
            new = entered[rows].nonzero().squeeze(1)
            if len(new) > 0 and mode.memory_size > 0:
                at = rows[new]
                fresh = mode.reset(x[at], u[at], k[at])
                remembered[new] = _shaped(mode.name, "reset() memory", fresh, (len(new), mode.memory_size))
            chosen, remembered = mode.act(x[rows], u[rows], remembered, k[rows])
            action[rows] = _shaped(mode.name, "act() actions", chosen, (len(rows), self.sim.nu)).to(u.dtype)
            memory[rows, : mode.memory_size] = _shaped(
                mode.name, "act() memory", remembered, (len(rows), mode.memory_size)
            ).to(memory.dtype)
        self.mode[ids] = modes
        self.memory[ids] = memory
        return action


def _shaped(mode: str, what: str, value: Tensor, shape: tuple[int, int]) -> Tensor:
    if value.shape != shape:
        raise ValueError(f"mode {mode!r}: {what} have shape {tuple(value.shape)}, expected {shape}")
    return value


def finite(values: Tensor) -> Tensor:
    """Which rows of (n, ...) hold finite numbers only, (n,) bool."""
    return values.isfinite().flatten(1).all(1)


def total(terms: Tensor) -> Tensor:
    """Sum over terms (n, number of terms) -> (n,), in one fixed order whatever n is.

    Every addend enters by one monotone rounding, so that with terms >= 0 a partial cost never exceeds
    the final one: pruning by it is exact, in floating point too.
    """
    cost = torch.zeros(len(terms), dtype=terms.dtype, device=terms.device)
    for column in terms.unbind(1):
        cost = cost + column
    return cost


@dataclass(frozen=True, eq=False)
class Rolled:
    """What came of n rollouts.

    Attributes:
        cost: J, (n,) float64; inf where diverged, the partial cost where pruned.
        terms: each term's share, (n, number of terms) float64; of no meaning where diverged or pruned.
        diverged: worlds whose state, input or cost stopped being finite, (n,) bool.
        pruned: worlds given up because their partial cost exceeded the bound, (n,) bool.
    """

    cost: Tensor
    terms: Tensor
    diverged: Tensor
    pruned: Tensor


def roll(
    worlds: Worlds,
    start: Start,
    schedules: Tensor,
    bound: float = math.inf,
    stop: Callable[[], bool] | None = None,
) -> Rolled | None:
    r"""Roll out schedules (n, T), n <= num_worlds, in step: J = sum_i l_i dt + c_f(x_T, k + T).

    Args:
        worlds: where to; the first n are used.
        start: where from.
        schedules: mode indices, long.
        bound: where cost terms are non-negative, a world is given up once its partial cost exceeds this.
        stop: asked before every control step; when it says True the rollout ends with None.
    """
    sim, cost = worlds.sim, worlds.task.cost
    n, horizon = schedules.shape
    schedules = schedules.to(sim.device)
    limit = bound if cost.nonnegative else math.inf
    terms = torch.zeros(n, len(cost.names), dtype=torch.float64, device=sim.device)
    stages = len(cost.stage)
    result = torch.full((n,), math.inf, dtype=torch.float64, device=sim.device)
    pruned = torch.zeros(n, dtype=torch.bool, device=sim.device)
    live = torch.arange(n, device=sim.device)
    worlds.reset(start, live)
    for i in range(horizon):
        if stop is not None and stop():
            return None
        live, x = _keep(finite(x := sim.x(live)), live, x)
        if len(live) == 0:
            break
        u_prev, k = sim.u(live), torch.full_like(live, start.k + i)
        u = worlds.act(live, schedules[live, i], x, u_prev, k)
        terms[live, :stages] += stage_terms(worlds.task, x, u, u_prev, k, sim.dt)
        partial = total(terms[live])
        beyond = partial > limit
        result[live[beyond]], pruned[live[beyond]] = partial[beyond], True
        live, u = _keep(finite(u) & partial.isfinite() & ~beyond, live, u)
        if len(live) == 0:
            break
        sim.step(u, live)
        worlds.control_steps += len(live)
    if len(live) > 0:
        live, x = _keep(finite(x := sim.x(live)), live, x)
    if len(live) > 0:
        k = torch.full_like(live, start.k + horizon)
        terms[live, stages:] = cost.terminal_terms(x, k).to(torch.float64)
        result[live] = total(terms[live])
    diverged = ~result.isfinite()
    result[diverged] = math.inf
    return Rolled(result, terms, diverged & ~pruned, pruned)


def stage_terms(task: Task, x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor, dt: float) -> Tensor:
    """l dt, term by term, (n, number of stage terms) float64."""
    return task.cost.stage_terms(x, u, u_prev, k).to(torch.float64) * dt


def _keep(ok: Tensor, live: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    return (live, values) if bool(ok.all()) else (live[ok], values[ok])
