"""Worlds: a simulator together with what its modes remember, and the sums that rollouts keep."""

from __future__ import annotations

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

    def branch(self, parents: Tensor, children: Tensor) -> None:
        """Make worlds `children` (n,) copies of worlds `parents` (n,)."""
        self.sim.load(self.sim.save(parents), children)
        self.mode[children] = self.mode[parents]
        self.memory[children] = self.memory[parents]

    def barred(self, ids: Tensor, modes: Tensor, x: Tensor, k: Tensor) -> Tensor:
        """Which of worlds `ids` would enter a mode whose guard bars it, (n,) bool; arguments as in `act`."""
        rules = self.task.rules
        if rules is None or not rules.guards:
            return torch.zeros_like(ids, dtype=torch.bool)
        return rules.barred(self.task.modes, modes != self.mode[ids], modes, x, k)

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


def stage_terms(task: Task, x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor, dt: float) -> Tensor:
    """l dt, term by term, (n, number of stage terms) float64."""
    return task.cost.stage_terms(x, u, u_prev, k).to(torch.float64) * dt
