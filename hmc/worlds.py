"""Worlds: a simulator together with what its modes remember, and the sums that rollouts keep."""

from __future__ import annotations

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
        if self.task.modes.memory_size > 0:
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
        """Which of worlds `ids` enter a mode that the task's guards bar, (n,) bool; arguments as in `act`."""
        rules = self.task.rules
        assert rules is not None
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
        n, ids, remembers = len(modes), where(ids), self.task.modes.memory_size > 0
        memory, entered = fresh(self.memory, ids), modes != self.mode[ids]
        order, groups = _groups(modes, len(self.task.modes))
        if order is not None:  # side by side, what is in one mode needs no more indexing
            x, u, entered = x[order], u[order], entered[order]
            memory = memory[order] if remembers else memory
        if remembers:
            memory[entered] = 0.0
        ks = torch.full((n,), k, device=modes.device)
        parts = zip(
            groups, *(each.split(list(groups.values())) for each in (x, u, memory, entered, ks)), strict=True
        )
        actions = [self._act(self.task.modes[index], *part) for index, *part in parts]
        action = torch.cat(actions) if len(actions) > 1 else actions[0]
        if order is not None:
            action = torch.empty_like(action).index_copy_(0, order, action)
            memory = torch.empty_like(memory).index_copy_(0, order, memory) if remembers else memory
        self.mode[ids] = modes
        if remembers:
            self.memory[ids] = memory
        return action

    def _act(self, mode: Mode, x: Tensor, u: Tensor, memory: Tensor, entered: Tensor, k: Tensor) -> Tensor:
        """Inputs of worlds that are all in one mode, (n, nu); their `memory` is brought up to date."""
        n, size = len(x), mode.memory_size
        memory = memory[:, :size]
        if size > 0 and bool(entered.any()):
            start = mode.reset(x[entered], u[entered], k[entered])
            start = _shaped(mode, "reset() memory", start, (int(entered.sum()), size))
            memory[entered] = start.to(memory.dtype)
        nested = mode.control_steps
        action, after = mode.act(x, u, memory, k)
        self.nested_steps += mode.control_steps - nested
        if size > 0:
            memory[:] = _shaped(mode, "act() memory", after, (n, size))
        return _shaped(mode, "act() actions", action, (n, self.sim.nu)).to(u.dtype)


def _groups(modes: Tensor, size: int) -> tuple[Tensor | None, dict[int, int]]:
    """An order that brings equal ones of `modes` (n,) together, and how many there are of each of `size`.

    None for the order where one mode has all.
    """
    groups = {index: n for index, n in enumerate(modes.bincount(minlength=size).tolist()) if n > 0}
    if len(groups) == 1:
        return None, groups
    if modes.device.type == "cpu":  # by counting, which torch does not for so few values
        small = np.uint8 if size <= 256 else np.uint16 if size <= 65536 else np.int64
        return torch.from_numpy(modes.numpy().astype(small).argsort(kind="stable")), groups
    return modes.argsort(stable=True), groups


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
