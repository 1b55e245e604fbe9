"""What schedules are looked up by."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hmc.neighbours import Neighbours

Words = NDArray[np.uint64]
BLOCK = 2**15  # numbers that are looked up at a time, about


def keys(schedules: Tensor | Neighbours, num_modes: int) -> list[bytes]:
    """A key of each of schedules (N, T): equal ones have equal keys, N.

    Each mode at each step is 128 bits drawn once and for all, and a schedule the sum of its own (Zobrist,
    "A new hashing method with application for game playing", 1970, with + for exclusive or): of a neighbour
    that is a difference of partial sums. Two schedules of a million have the same key with a chance of 1e-27.
    """
    words = _near(schedules, num_modes) if isinstance(schedules, Neighbours) else _sums(schedules, num_modes)
    # fixed-width strings lose their trailing zeros, all of them the same way: they stay distinct
    found: list[bytes] = words.view("S16")[:, 0].tolist()
    return found


def _near(switched: Neighbours, num_modes: int) -> Words:
    """Of the neighbours of a schedule, (N, 2)."""
    base = np.array(switched.base.modes)
    horizon = len(base)
    drawn = _drawn(horizon, num_modes)
    # what each mode adds to the base's sum at each step, summed up to before it
    change = np.zeros((num_modes, horizon + 1, 2), dtype=np.uint64)
    own = drawn[np.arange(horizon), base]
    np.cumsum((drawn - own[:, None]).transpose(1, 0, 2), axis=1, out=change[:, 1:])
    flat, row = change.reshape(-1, 2), switched.mode * (horizon + 1)
    found: Words = flat.take(row + switched.stop, 0) - flat.take(row + switched.start, 0) + own.sum(0)
    return found


def _sums(schedules: Tensor, num_modes: int) -> Words:
    """Of schedules (N, T) as they come, (N, 2)."""
    steps = schedules.cpu().numpy().T
    horizon, n = steps.shape
    drawn, found = _drawn(horizon, num_modes), np.zeros((n, 2), dtype=np.uint64)
    size = max(1, BLOCK // max(1, n))
    for first in range(0, horizon, size):
        part = np.arange(first, min(first + size, horizon))
        found += drawn[part[:, None], steps[part]].sum(0, dtype=np.uint64)
    return found


@lru_cache(maxsize=16)
def _drawn(horizon: int, num_modes: int) -> Words:
    """The words of each mode at each step, (T, M, 2)."""
    return np.random.default_rng(0).integers(2**64, size=(horizon, num_modes, 2), dtype=np.uint64)
