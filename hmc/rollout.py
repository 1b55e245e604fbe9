"""Rollouts: many worlds on their way through their schedules, one control step at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.modes import Mode
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.task import Task


class Worlds:
    """The worlds of a simulator together with what their modes remember.

    The simulator holds x, u and the engine's own history; this holds the rest of the rolled-out state:
    the mode that ran last in each world and its memory. Branching a rollout copies both.

    Attributes:
        control_steps: control steps made so far, over all worlds and inside the modes.
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
        memory = self._arrive(ids, modes, x, u, k)
        action = torch.empty_like(u)
        for index, rows in _groups(modes):
            mode = self.task.modes[index]
            size = mode.memory_size
            nested = mode.control_steps
            chosen, after = mode.act(x[rows], u[rows], memory[rows, :size], k[rows])
            self.control_steps += mode.control_steps - nested
            n = len(k[rows])
            action[rows] = _shaped(mode, "act() actions", chosen, (n, self.sim.nu)).to(u.dtype)
            if size > 0:
                memory[rows, :size] = _shaped(mode, "act() memory", after, (n, size)).to(memory.dtype)
        self.memory[ids] = memory
        return action

    def _arrive(self, ids: Tensor, modes: Tensor, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        """Memory at the start of the step, (n, memory_size): made anew where a world changes mode."""
        memory = self.memory[ids]
        entered = modes != self.mode[ids]
        if bool(entered.any()):
            self.mode[ids] = modes
            memory[entered] = 0.0
            for index, mode in enumerate(self.task.modes):
                rows = (entered & (modes == index)).nonzero().squeeze(1) if mode.memory_size > 0 else ()
                if len(rows) > 0:
                    fresh = mode.reset(x[rows], u[rows], k[rows])
                    size = (len(k[rows]), mode.memory_size)
                    memory[rows, : size[1]] = _shaped(mode, "reset() memory", fresh, size).to(memory.dtype)
        return memory


def _groups(modes: Tensor) -> list[tuple[int, Tensor | slice]]:
    """The modes in `modes` (n,) in ascending order, each with its rows: a cheap slice if it has all."""
    if len(modes) > 0 and bool((modes == modes[0]).all()):
        return [(int(modes[0]), slice(None))]
    return [(index, (modes == index).nonzero().squeeze(1)) for index in modes.unique().tolist()]


def _shaped(mode: Mode, what: str, value: Tensor, shape: tuple[int, int]) -> Tensor:
    if value.shape != shape:
        raise ValueError(f"mode {mode.name!r}: {what} have shape {tuple(value.shape)}, expected {shape}")
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
        terms: each term's share, (n, number of terms) float64; NaN where diverged or pruned.
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
    modes = schedules.to(sim.device)
    limit = bound if cost.nonnegative else math.inf
    stages, names = len(cost.stage), len(cost.names)
    result = torch.full((n,), math.inf, dtype=torch.float64, device=sim.device)
    parts = torch.full((n, names), math.nan, dtype=torch.float64, device=sim.device)
    pruned = torch.zeros(n, dtype=torch.bool, device=sim.device)
    ids = torch.arange(n, device=sim.device)  # worlds still going; the rows of modes and terms are theirs
    terms = torch.zeros(n, names, dtype=torch.float64, device=sim.device)
    worlds.reset(start, ids)
    for i in range(horizon):
        if stop is not None and stop():
            return None
        x = sim.x(_indexed(sim, ids))
        if not bool(x.isfinite().all()):
            ids, modes, terms, x = _keep(finite(x), ids, modes, terms, x)
            if len(ids) == 0:
                break
        u_prev, k = sim.u(_indexed(sim, ids)), torch.full_like(ids, start.k + i)
        u = worlds.act(ids, modes[:, i], x, u_prev, k)
        terms[:, :stages] += stage_terms(worlds.task, x, u, u_prev, k, sim.dt)
        partial = total(terms)
        sound, beyond = partial.isfinite() & finite(u), partial > limit
        if not bool((sound & ~beyond).all()):
            given_up = sound & beyond
            result[ids[given_up]], pruned[ids[given_up]] = partial[given_up], True
            ids, modes, terms, u = _keep(sound & ~beyond, ids, modes, terms, u)
            if len(ids) == 0:
                break
        sim.step(u, _indexed(sim, ids))
        worlds.control_steps += len(ids)
    if len(ids) > 0:
        x = sim.x(ids)
        ids, terms, x = _keep(finite(x), ids, terms, x)
    if len(ids) > 0:
        k = torch.full_like(ids, start.k + horizon)
        terms[:, stages:] = cost.terminal_terms(x, k).to(torch.float64)
        result[ids], parts[ids] = total(terms), terms
    diverged = ~result.isfinite() & ~pruned
    result[diverged], parts[diverged] = math.inf, math.nan
    return Rolled(result, parts, diverged, pruned)


def _indexed(sim: Sim, ids: Tensor) -> Tensor | None:
    """Ascending `ids`; None, which costs no indexing, where they are all worlds."""
    return None if len(ids) == sim.num_worlds else ids


def _keep(ok: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    return tuple(tensor[ok] for tensor in tensors)


def stage_terms(task: Task, x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor, dt: float) -> Tensor:
    """l dt, term by term, (n, number of stage terms) float64."""
    return task.cost.stage_terms(x, u, u_prev, k).to(torch.float64) * dt
