"""Shapes of what goes into a simulator, checked before anything is written."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from hmc.sim.base import Sim
from hmc.sim.ids import Ids, count


def check(worlds: int, ids: Ids, **arrays: tuple[Tensor, int]) -> None:
    """Raise ValueError unless ids are world indices and each named array is (n, width).

    Broadcasting is refused: one row for many worlds is more often a slip than a wish. Indices on a GPU
    are checked by torch when they are used, without waiting for the device here.

    Args:
        worlds: number of worlds W.
        ids: world indices (n,), a slice of them, or None for all.
        arrays: name = (array, its width).
    """
    n = count(ids, worlds)
    if isinstance(ids, Tensor):
        if ids.dtype != torch.long or ids.ndim != 1:
            raise ValueError(f"ids must be a long tensor (n,), got {ids.dtype} {tuple(ids.shape)}")
        # as unsigned numbers, negative indices are too large as well
        if n and ids.device.type == "cpu" and ids.numpy().view(np.uint64).max() >= worlds:
            raise ValueError(f"ids must be in [0, {worlds}), got {int(ids.min())} to {int(ids.max())}")
    for name, (array, width) in arrays.items():
        if array.shape != (n, width):
            raise ValueError(f"{name} must be ({n}, {width}): a row a world, got {tuple(array.shape)}")


def check_latency(latency: int | Sequence[int], worlds: int, substeps: int) -> list[int]:
    """Physics steps by which the inputs of each world come late, from one of all worlds or one of each.

    Raises:
        ValueError: not one a world, or not within a control step of so many physics steps.
    """
    late = [int(latency)] * worlds if isinstance(latency, int | np.integer) else list(latency)
    if len(late) != worlds or not 0 <= min(late) <= max(late) <= substeps:
        raise ValueError(
            f"latency must be 0 to {substeps} physics steps, a control step, one of all worlds or one of "
            f"each of the {worlds}; got {latency}"
        )
    return late


def tell_overflow(sim: Sim) -> None:
    """Warn of world-steps that were spoiled since the last time because contacts or constraints did not fit.

    Waits for the device. Engines without an `overflow` have room for all.
    """
    lost = {what: number for what, number in getattr(sim, "overflow", dict)().items() if number > 0}
    if lost:
        found = ", ".join(f"{number:,} by {what}" for what, number in lost.items())
        names = "= and ".join(lost)
        warnings.warn(
            f"world-steps that did not fit and count as diverged: {found}; give the simulator more {names}=",
            stacklevel=2,
        )
