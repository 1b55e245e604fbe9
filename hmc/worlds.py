"""Worlds: a simulator together with what its modes remember."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.modes import Mode
from hmc.sim.base import Sim
from hmc.sim.device import upload
from hmc.sim.ids import Ids, count, where
from hmc.start import Start
from hmc.task import Task

if TYPE_CHECKING:
    from hmc.trace import Trace

Indices = NDArray[np.integer]
Flags = NDArray[np.bool_]


class Worlds:
    """The worlds of a simulator together with what their modes remember.

    The simulator holds x, u and the engine's own history; this holds the memory of the mode that ran last
    in each world. Branching a rollout copies both.

    Attributes:
        cheap: whether the simulator says so of its steps.
        own_steps: control steps made so far, over all worlds.
        nested_steps: those that modes made inside themselves.
    """

    def __init__(self, task: Task, sim: Sim):
        self.task, self.sim, self.cheap = task, sim, bool(getattr(sim, "cheap", False))
        self.own_steps = self.nested_steps = 0
        constants = task.modes.constants
        self._held = np.empty((0, sim.nu)) if constants is None else constants[:, None].repeat(sim.nu, 1)
        self._all = torch.arange(sim.num_worlds, device=sim.device)
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
        if self.task.modes.memory_size > 0:
            ids = where(ids)
            self.memory[ids] = 0.0
            self.memory[ids, : len(start.memory)] = start.memory

    def enter(self, trace: Trace, i: int, ids: Ids) -> None:
        """Put worlds `ids` where a trace is on arrival at its step i."""
        n = count(ids, self.sim.num_worlds)
        self.sim.load(trace.snapshots[i].expand(n, -1), ids)
        if self.task.modes.memory_size > 0:
            self.memory[where(ids)] = trace.memory[i]

    def branch(self, parents: Ids, children: Ids) -> None:
        """Make worlds `children` (n,) copies of worlds `parents` (n,)."""
        self.sim.load(self.sim.save(parents), children)
        if self.task.modes.memory_size > 0:
            self.memory[where(children)] = self.memory[where(parents)]

    def crew(self, ids: Ids, modes: Indices, before: Indices) -> Crew:
        """Who acts in worlds `ids`: it holds until these or their modes change.

        Args:
            ids: n worlds.
            modes: of each, (n,).
            before: the modes that ran last, (n,); -1 for none. One that did not run before is entered first.
        """
        if self.task.modes.constants is not None:
            return Crew(len(modes), [], upload(self._held.take(modes, 0), self.sim.device).to(self.sim.dtype))
        new, count = modes != before, np.bincount(modes)
        indices = count.nonzero()[0].tolist()
        if len(indices) == 1:
            return Crew(len(modes), [Part(self.task.modes[indices[0]], None, where(ids), self._where(new))])
        parts, worlds = [], self._all[where(ids)]
        for index in indices:
            found = (modes == index).nonzero()[0]
            rows, entered = upload(found, self.sim.device), self._where(new[found])
            parts.append(Part(self.task.modes[index], rows, worlds.index_select(0, rows), entered))
        return Crew(len(modes), parts)

    def act(self, crew: Crew, x: Tensor, u: Tensor, k: int) -> Tensor:
        """Let each world's mode choose its input; a mode that was not running before is entered first.

        Args:
            crew: who acts in which of n worlds.
            x: their states, (n, nx).
            u: their last inputs, (n, nu).
            k: control step.

        Returns:
            The inputs to apply, (n, nu). The worlds' memory is already that after the step.
        """
        if crew.held is not None:
            return crew.held
        action = torch.empty_like(u)
        for part in crew.parts:
            if part.rows is None:
                return action.copy_(self._act(part, x, u, k))  # a mode may fill the same buffer at each step
            acted = self._act(part, x.index_select(0, part.rows), u.index_select(0, part.rows), k)
            action.index_copy_(0, part.rows, acted)
        return action

    def _where(self, flags: Flags) -> Tensor | None:
        """Which are flagged, long; None for none of them."""
        return upload(flags.nonzero()[0], self.sim.device) if flags.any() else None

    def _act(self, part: Part, x: Tensor, u: Tensor, k: int) -> Tensor:
        """Inputs of worlds that are all in one mode, (n, nu)."""
        mode, n, size = part.mode, len(x), part.mode.memory_size
        ks = torch.full((n,), k, device=x.device)
        nested = mode.control_steps
        if part.entered is not None:
            self._enter(part, x, u, ks)
        memory = self.memory if size == self.memory.shape[1] else self.memory[:, :size]
        memory = memory[part.at] if isinstance(part.at, slice) else memory.index_select(0, part.at)
        found = mode.act(x, u, memory, ks)
        if not isinstance(found, (tuple, list)) or len(found) != 2:  # two rows of a tensor would pass for it
            got = type(found).__name__
            raise ValueError(f"mode {mode.name!r}: act() must return (actions, memory), got a {got}")
        action, after = found
        self.nested_steps += mode.control_steps - nested
        # what was picked out is a copy, which a mode may have changed in place
        if size > 0 and (after is not memory or isinstance(part.at, Tensor)):
            self.memory[part.at, :size] = _shaped(mode, "act() memory", after, (n, size)).to(memory.dtype)
        return _shaped(mode, "act() actions", action, (n, self.sim.nu)).to(u.dtype)

    def _enter(self, part: Part, x: Tensor, u: Tensor, k: Tensor) -> None:
        """Begin a mode in the worlds that enter it."""
        new, part.entered = part.entered, None
        if self.task.modes.memory_size == 0:
            return
        assert new is not None
        at, size = self._all[part.at].index_select(0, new), part.mode.memory_size
        if size < self.memory.shape[1]:
            self.memory[:, size:].index_fill_(0, at, 0.0)
        if size > 0:
            if len(at) < len(x):
                x, u, k = x.index_select(0, new), u.index_select(0, new), k[: len(at)]
            start = _shaped(part.mode, "reset() memory", part.mode.reset(x, u, k), (len(at), size))
            self.memory[:, :size].index_copy_(0, at, start.to(self.memory.dtype))


@dataclass
class Part:
    """Worlds in one mode.

    Attributes:
        mode: that acts.
        rows: which of the crew's n worlds they are; None for all of them.
        at: and which of the simulator's.
        entered: which of them enter the mode at the next step; None for none of them.
    """

    mode: Mode
    rows: Tensor | None
    at: Tensor | slice
    entered: Tensor | None


@dataclass(frozen=True)
class Crew:
    """Who acts in n worlds.

    Attributes:
        size: n.
        parts: the worlds by mode.
        held: where all modes are constant inputs, those of the worlds, (n, nu); None otherwise.
    """

    size: int
    parts: list[Part]
    held: Tensor | None = None


def _shaped(mode: Mode, what: str, value: Tensor, shape: tuple[int, int]) -> Tensor:
    if not isinstance(value, Tensor):
        raise ValueError(f"mode {mode.name!r}: {what} are {value!r}, expected a tensor of shape {shape}")
    if value.shape != shape:
        raise ValueError(f"mode {mode.name!r}: {what} have shape {tuple(value.shape)}, expected {shape}")
    return value


def finite(values: Tensor) -> Tensor:
    """Which rows of (n, ...) hold finite numbers only, (n,) bool."""
    return values.isfinite().flatten(1).all(1)
