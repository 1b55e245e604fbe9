"""Schedules that are one switch away from another one, without spelling them out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from hmc.schedule import Schedule

Indices = NDArray[np.integer]
BLOCK = 2**18  # modes that are spelt out at a time, about: what is computed on the way stays in the cache


@dataclass(frozen=True, eq=False)
class Neighbours:
    """A schedule of T steps with each of n switches stitched onto it in turn.

    Equal schedules are equal here: a switch begins and ends with a step whose mode it changes, and one that
    changes none is into mode 0 from step T to step T.

    Attributes:
        base: the schedule.
        num_modes: M.
        mode: of each switch, (n,).
        start: its first step, (n,).
        stop: the first step after it, (n,).
    """

    base: Schedule
    num_modes: int
    mode: Indices
    start: Indices
    stop: Indices

    @classmethod
    def of(cls, base: Schedule, num_modes: int, mode: Indices, start: Indices, stop: Indices) -> Neighbours:
        """Those of switches into `mode` (n,) from step `start` (n,) on, up to `stop` (n,)."""
        horizon, other = len(base), _other(base, num_modes)
        at = mode * (horizon + 1)
        first = _next(other).take(at + start)
        end = horizon - _next(other[:, ::-1]).take(at + (horizon - stop))
        none = first >= end
        return cls(
            base,
            num_modes,
            np.where(none, 0, mode),
            np.where(none, horizon, first),
            np.where(none, horizon, end),
        )

    def __len__(self) -> int:
        return len(self.mode)

    def __getitem__(self, rows: slice | Indices) -> Neighbours:
        return replace(self, mode=self.mode[rows], start=self.start[rows], stop=self.stop[rows])

    @cached_property
    def changed_next(self) -> Indices:
        """The first step from each `stop` on that has another mode than the switch, T if none has, (n,)."""
        after = _next(_other(self.base, self.num_modes))
        return after.take(self.mode * after.shape[1] + self.stop)

    def tensor(self) -> Tensor:
        """The schedules, (n, T), in a type that fits and laid out by steps."""
        horizon = len(self.base)
        most = max(self.num_modes, horizon)
        kind = next(k for k in (np.uint8, np.int16, np.int64) if most <= np.iinfo(k).max)
        # unsigned, what lies before the start is far behind the end
        wide = np.dtype(f"u{np.dtype(kind).itemsize}")
        start, duration = self.start.astype(wide), (self.stop - self.start).astype(wide)
        steps, base = np.arange(horizon, dtype=wide)[:, None], np.array(self.base.modes, dtype=kind)[:, None]
        mode, modes = self.mode.astype(kind), np.empty((horizon, len(self)), dtype=kind)
        size = max(1, BLOCK // max(1, len(self)))
        for first in range(0, horizon, size):
            part = slice(first, first + size)
            # what `where` gives, several times as fast
            found = np.bitwise_xor(mode, base[part], out=modes[part])
            found *= (steps[part] - start < duration).view(np.uint8)
            found ^= base[part]
        return torch.from_numpy(modes).T


def _other(base: Schedule, num_modes: int) -> NDArray[np.bool_]:
    """Which steps have another mode than each, (M, T)."""
    return np.arange(num_modes)[:, None] != np.array(base.modes)


def _next(flags: NDArray[np.bool_]) -> Indices:
    """The first step flagged from each on, of flags (M, T), (M, T + 1); T if none is."""
    horizon = flags.shape[1]
    steps = np.hstack([np.where(flags, np.arange(horizon), horizon), np.full((len(flags), 1), horizon)])
    found: Indices = np.minimum.accumulate(steps[:, ::-1], 1)[:, ::-1]
    return found
