"""What schedules are looked up by."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hmc.neighbours import Neighbours

Words = NDArray[np.uint64]
BLOCK = 2**15  # numbers that are looked up at a time, about


def keys(schedules: Tensor | Neighbours, num_modes: int) -> Words:
    """A key of each of schedules (N, T), (N,): equal ones have equal keys.

    Each mode at each step is a word drawn once and for all, and a schedule the sum of its own (Zobrist, "A
    new hashing method with application for game playing", 1970, with + for exclusive or): of a neighbour that
    is a difference of partial sums. Of n different schedules two have the same key with a chance of less than
    n^2 / 2^65, 3e-8 for a million.
    """
    return _near(schedules, num_modes) if isinstance(schedules, Neighbours) else _sums(schedules, num_modes)


def _near(switched: Neighbours, num_modes: int) -> Words:
    """Of the neighbours of a schedule, (N,)."""
    base = np.array(switched.base.modes)
    horizon = len(base)
    drawn = _drawn(horizon, num_modes)
    # what each mode adds to the base's sum at each step, summed up to before it
    change = np.zeros((num_modes, horizon + 1), dtype=np.uint64)
    own = drawn[np.arange(horizon), base]
    np.cumsum((drawn - own[:, None]).T, axis=1, out=change[:, 1:])
    row = switched.mode * (horizon + 1)
    found: Words = change.take(row + switched.stop) - change.take(row + switched.start) + own.sum()
    return found


def _sums(schedules: Tensor, num_modes: int) -> Words:
    """Of schedules (N, T) as they come, (N,)."""
    steps = schedules.cpu().numpy().T
    horizon, n = steps.shape
    drawn, found = _drawn(horizon, num_modes), np.zeros(n, dtype=np.uint64)
    size = max(1, BLOCK // max(1, n))
    for first in range(0, horizon, size):
        part = np.arange(first, min(first + size, horizon))
        found += drawn[part[:, None], steps[part]].sum(0, dtype=np.uint64)
    return found


@lru_cache(maxsize=16)
def _drawn(horizon: int, num_modes: int) -> Words:
    """The word of each mode at each step, (T, M)."""
    return np.random.default_rng(0).integers(2**64, size=(horizon, num_modes), dtype=np.uint64)
