"""The one protocol between the planner and whatever simulates the robot."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from hmc.sim.ids import Ids


@runtime_checkable
class Sim(Protocol):
    """W worlds that step together, singly or in any subset, one control step at a time.

    Every method takes ``ids``, a long tensor of distinct world indices (n,), a slice of the worlds, or
    None for all of them in order. Tensors come back as fresh copies on `device`; a sim never hands out
    a live buffer.

    The state x is what a mode and a cost may look at (for MuJoCo: qpos then qvel). The input u that
    was applied last is part of a world too: costs and observations need it.

    A snapshot row holds everything that decides how a world goes on (x, u, time, solver warm start):
    `load` of a saved row into any world and the same inputs give the same trajectory, bit for bit on
    the CPU engines. Branching a rollout is `load(ids, save(parent)[...])`.

    A simulator may have an attribute `cheap`, True where a control step of all worlds takes less time than to
    ask a cost what it cost: rollouts then ask for several steps at once, make some in vain, and keep the
    worlds that go on side by side. It may have an attribute `world_bytes`, what a world takes on its device:
    a search has as many as fit there (`hmc.memory`).

    A world whose state stops being finite stays so, quietly, and never disturbs another one: the
    caller finds it by looking at x.
    """

    @property
    def num_worlds(self) -> int:
        """Number of worlds W."""
        ...

    @property
    def nx(self) -> int:
        """Size of the state x."""
        ...

    @property
    def nu(self) -> int:
        """Size of the input u."""
        ...

    @property
    def dt(self) -> float:
        """Duration of one control step [s]."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """Type of x, u and snapshots."""
        ...

    def x(self, ids: Ids = None) -> Tensor:
        """State, (n, nx)."""
        ...

    def u(self, ids: Ids = None) -> Tensor:
        """Input applied last, (n, nu)."""
        ...

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        """Put worlds at state x (n, nx) with last input u (n, nu): no history, time 0."""
        ...

    def step(self, u: Tensor, ids: Ids = None) -> None:
        """Apply u (n, nu) for one control step of dt seconds."""
        ...

    def save(self, ids: Ids = None) -> Tensor:
        """Snapshot rows, (n, ns)."""
        ...

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        """Continue from snapshot rows (n, ns)."""
        ...


def rollout(sim: Sim, controls: Tensor, ids: Tensor) -> Tensor:
    """States after each control step under given inputs (n, H, nu) in worlds `ids` (n,), (n, H, nx).

    Engines that can do it in one call have a method of this name. A world that the engine gives up is NaN
    from there on.
    """
    if isinstance(sim, CanRollOut):
        return sim.rollout(controls, ids)
    states = []
    for u in controls.unbind(1):
        sim.step(u, ids)
        states.append(sim.x(ids))
    return torch.stack(states, 1)


@runtime_checkable
class CanRollOut(Protocol):
    """An engine that makes many control steps in one call."""

    def rollout(self, controls: Tensor, ids: Tensor) -> Tensor:
        """See the function of this name."""
        ...


@runtime_checkable
class CanResetFlagged(Protocol):
    """An engine on whose device worlds begin anew without anybody knowing how many."""

    def reset_flagged(self, flags: Tensor, x: Tensor, u: Tensor) -> None:
        """`Sim.reset` of the worlds that are flagged, of flags (W,) bool, x (W, nx) and u (W, nu)."""
        ...
