"""Where a plan starts: state, last input, and the mode that is running with what it remembers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hmc.sim.base import Sim
from hmc.task import Task

Vector = Tensor | np.ndarray | Sequence[float]


@dataclass(frozen=True, eq=False)
class Start:
    """The situation to plan from.

    Attributes:
        x: state, (nx,).
        u: input applied last, (nu,).
        mode: the mode now running; None where every schedule enters its first mode anew.
        memory: what that mode remembers, (its memory_size,).
        k: control steps since the start of the task.
        snapshot: engine snapshot row of this state, (ns,), where there is one: warm start and actuator
            states go on as well. x and u must be those of the snapshot.
        ran: control steps that the mode has been running, for rules on dwell times; None: long enough.
    """

    x: Tensor
    u: Tensor
    mode: int | None
    memory: Tensor
    k: int
    snapshot: Tensor | None = None
    ran: int | None = None


@torch.no_grad()
def make_start(
    task: Task,
    sim: Sim,
    x: Vector,
    u: Vector | None = None,
    mode: int | str | None = None,
    memory: Vector | None = None,
    k: int = 0,
    snapshot: Tensor | None = None,
    ran: int | None = None,
) -> Start:
    """A `Start` in the simulator's type and on its device, from values that are checked.

    A running mode whose memory is not given gets that of an entry now; for rules it goes on running.
    """
    x = _vector(f"task {task.name!r}: state x", x, sim.nx, sim)
    u = _vector(f"task {task.name!r}: last input u", [0.0] * sim.nu if u is None else u, sim.nu, sim)
    if snapshot is not None:
        snapshot = _row(f"task {task.name!r}: snapshot", snapshot, sim.save(slice(0, 1)).shape[1], sim)
    if k < 0:
        raise ValueError(f"task {task.name!r}: control step k must be >= 0, got {k}")
    if mode is None:
        if memory is not None:
            raise ValueError("memory was given without the mode it belongs to: pass mode= as well")
        if ran is not None:
            raise ValueError(f"ran={ran} was given without the mode that ran so long: pass mode= as well")
        return Start(x, u, None, x.new_zeros(0), k, snapshot)
    if ran is not None and ran < 0:
        raise ValueError(f"task {task.name!r}: the mode has been running for ran >= 0 steps, got {ran}")
    index = task.modes.index(mode)
    running = task.modes[index]
    if memory is None:
        memory = running.reset(x[None], u[None], torch.tensor([k], device=x.device))[0]
    memory = _vector(f"memory of mode {running.name!r}", memory, running.memory_size, sim)
    return Start(x, u, index, memory, k, snapshot, ran)


def _row(what: str, values: Vector, size: int, sim: Sim) -> Tensor:
    row = torch.as_tensor(values, dtype=sim.dtype, device=sim.device).detach().clone()
    if row.shape != (size,):
        raise ValueError(f"{what}: expected {size} numbers, shape ({size},), got shape {tuple(row.shape)}")
    return row


def _vector(what: str, values: Vector, size: int, sim: Sim) -> Tensor:
    vector = _row(what, values, size, sim)
    if not vector.isfinite().all():
        at = int((~vector.isfinite()).nonzero()[0])
        raise ValueError(
            f"{what}: expected finite numbers, got {float(vector[at])} at index {at}; "
            "check the estimator or simulator it comes from"
        )
    return vector
