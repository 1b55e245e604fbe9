"""Worlds: a simulator together with what its modes remember, and the sums that rollouts keep."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from hmc.modes import Mode
from hmc.sim.base import Sim
from hmc.sim.ids import Ids, count, fresh, where
from hmc.start import Start
from hmc.task import Task


class Worlds:
    """The worlds of a simulator together with what their modes remember.

    The simulator holds x, u and the engine's own history; this holds the rest of the rolled-out state:
    the mode that ran last in each world and its memory. Branching a rollout copies both.

    Attributes:
        own_steps: control steps made so far, over all worlds.
        nested_steps: those that modes made inside themselves.
    """

    def __init__(self, task: Task, sim: Sim):
        self.task, self.sim = task, sim
        self.own_steps = self.nested_steps = 0
        self.mode = torch.full((sim.num_worlds,), -1, dtype=torch.long, device=sim.device)
        self.memory = torch.zeros(sim.num_worlds, task.modes.memory_size, dtype=sim.dtype, device=sim.device)

    @property
    def control_steps(self) -> int:
        """Control steps made so far, over all worlds and inside the modes."""
        return self.own_steps + self.nested_steps

    def reset(self, start: Start, ids: Ids) -> None:
        """Put worlds `ids` at `start`."""
        n = count(ids, self.sim.num_worlds)
        if start.snapshot is None:
            self.sim.reset(start.x.expand(n, -1), start.u.expand(n, -1), ids)
        else:
            self.sim.load(start.snapshot.expand(n, -1), ids)
        ids = where(ids)
        self.mode[ids] = -1 if start.mode is None else start.mode
        self.memory[ids] = 0.0
        self.memory[ids, : len(start.memory)] = start.memory

    def branch(self, parents: Tensor, children: Ids) -> None:
        """Make worlds `children` (n,) copies of worlds `parents` (n,)."""
        self.sim.load(self.sim.save(parents), children)
        children = where(children)
        self.mode[children] = self.mode[parents]
        if self.task.modes.memory_size > 0:
            self.memory[children] = self.memory[parents]

    def barred(self, ids: Ids, modes: Tensor, x: Tensor, k: int) -> Tensor:
        """Which of worlds `ids` would enter a mode whose guard bars it, (n,) bool; arguments as in `act`."""
        rules = self.task.rules
        if rules is None or not rules.guards:
            return torch.zeros_like(modes, dtype=torch.bool)
        entered = modes != self.mode[where(ids)]
        return rules.barred(self.task.modes, entered, modes, x, torch.full_like(modes, k))

    def act(self, ids: Ids, modes: Tensor, x: Tensor, u: Tensor, k: int) -> Tensor:
        """Let each world's mode choose its input; a mode that was not running before is entered first.

        Args:
            ids: worlds, n of them.
            modes: the mode of each at this step, (n,) long.
            x: their states, (n, nx).
            u: their last inputs, (n, nu).
            k: control step.

        Returns:
            The inputs to apply, (n, nu). The worlds' memory is already that after the step.
        """
        groups, ids, ks = _groups(modes, len(self.task.modes)), where(ids), torch.full_like(modes, k)
        remembers = self.task.modes.memory_size > 0
        memory = self._arrive(ids, modes, groups, x, u, ks) if remembers else self.memory[ids]
        action = torch.empty_like(u)
        for index, rows in groups:
            mode = self.task.modes[index]
            size = mode.memory_size
            nested, now = mode.control_steps, x[rows]
            n = len(now)
            chosen, after = mode.act(now, u[rows], memory[rows, :size], ks[:n])
            self.nested_steps += mode.control_steps - nested
            action[rows] = _shaped(mode, "act() actions", chosen, (n, self.sim.nu)).to(u.dtype)
            if size > 0:
                memory[rows, :size] = _shaped(mode, "act() memory", after, (n, size)).to(memory.dtype)
        self.mode[ids] = modes
        if remembers:
            self.memory[ids] = memory
        return action

    def _arrive(
        self, ids: Tensor | slice, modes: Tensor, groups: Groups, x: Tensor, u: Tensor, k: Tensor
    ) -> Tensor:
        """Memory at the start of the step, (n, memory_size): made anew where a world changes mode."""
        memory = fresh(self.memory, ids)
        entered = modes != self.mode[ids]
        if bool(entered.any()):
            memory[entered] = 0.0
            for index, rows in groups:
                mode = self.task.modes[index]
                size = mode.memory_size
                if size > 0 and len(new := _where(entered, rows)) > 0:
                    start = mode.reset(x[new], u[new], k[: len(new)])
                    start = _shaped(mode, "reset() memory", start, (len(new), size))
                    memory[new, :size] = start.to(memory.dtype)
        return memory


# the modes at work, each with its rows
Groups: TypeAlias = list[tuple[int, Tensor | slice]]


def _groups(modes: Tensor, size: int) -> Groups:
    """The modes in `modes` (n,), of `size` that there are, in ascending order; a slice where one has all."""
    if len(modes) == 1 or bool((modes == modes[0]).all()):
        return [(int(modes[0]), slice(None))]
    counts = modes.bincount(minlength=size).tolist()
    if modes.device.type == "cpu":  # by counting, which torch does not for so few values
        small = np.uint8 if size <= 256 else np.uint16 if size <= 65536 else np.int64
        order = torch.from_numpy(modes.numpy().astype(small).argsort(kind="stable"))
    else:
        order = modes.argsort(stable=True)
    return [(index, rows) for index, rows in enumerate(order.split(counts)) if len(rows) > 0]


def _where(mask: Tensor, rows: Tensor | slice) -> Tensor:
    """Those of `rows` where `mask` (n,) holds."""
    return mask.nonzero().squeeze(1) if isinstance(rows, slice) else rows[mask[rows]]


def _shaped(mode: Mode, what: str, value: Tensor, shape: tuple[int, int]) -> Tensor:
    if value.shape != shape:
        raise ValueError(f"mode {mode.name!r}: {what} have shape {tuple(value.shape)}, expected {shape}")
    return value


def finite(values: Tensor) -> Tensor:
    """Which rows of (n, ...) hold finite numbers only, (n,) bool."""
    return values.isfinite().flatten(1).all(1)


def stage_terms(task: Task, x: Tensor, u: Tensor, u_prev: Tensor, k: int, dt: float) -> Tensor:
    """l dt, term by term, (n, number of stage terms) float64, at control step k."""
    ks = torch.full((len(x),), k, device=x.device)
    return task.cost.stage_terms(x, u, u_prev, ks).to(torch.float64) * dt
