"""Some of an environment's worlds: by index where they are counted at no cost, by flags on a GPU."""

from __future__ import annotations

from typing import TypeAlias

import torch
from torch import Tensor

from hmc.sim.base import CanResetFlagged, Sim

# indices of n worlds (n,) long, or flags of all W of them (W,) bool, where n is W below
Chosen: TypeAlias = Tensor


def choose(flags: Tensor) -> Chosen:
    """The worlds that are flagged, of flags (W,) bool.

    To count them on a GPU is to wait for it. What is made for the chosen worlds is made for all of them
    there, and `put` and `reset` take what is flagged.
    """
    return flags.nonzero().squeeze(1) if flags.device.type == "cpu" else flags


def pick(values: Tensor, chosen: Chosen) -> Tensor:
    """Of values (W, ...), those of the chosen worlds, (n, ...)."""
    return values if chosen.dtype == torch.bool else values[chosen]


def put(values: Tensor, chosen: Chosen, rows: Tensor | float) -> None:
    """Write rows (n, ...), or a number, into the values (W, ...) of the chosen worlds."""
    if chosen.dtype != torch.bool:
        values[chosen] = rows
        return
    flags = chosen.view(-1, *[1] * (values.ndim - 1))
    values.copy_(torch.where(flags, rows, values))


def reset(sim: Sim, chosen: Chosen, x: Tensor, u: Tensor) -> None:
    """Put the chosen worlds at states x (n, nx) with last inputs u (n, nu)."""
    if chosen.dtype != torch.bool:
        sim.reset(x, u, chosen)
        return
    if isinstance(sim, CanResetFlagged):
        sim.reset_flagged(chosen, x, u)
        return
    before = sim.save()
    sim.reset(x, u)
    sim.load(torch.where(chosen[:, None], sim.save(), before))
