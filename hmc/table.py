"""A transposition table: what is known of schedules, whichever switch they came from."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hmc.keys import Words, keys
from hmc.neighbours import Neighbours

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rows = NDArray[np.int64]


class Table:
    """Costs and cost terms of schedules of one length; of a pruned one, a lower bound of its cost.

    Args:
        num_modes: M.
        num_terms: of the cost.
    """

    def __init__(self, num_modes: int, num_terms: int):
        self._modes = num_modes
        # a hash table with linear probing, of keys that are random already
        self._keys: Words = np.empty(2 * 64, dtype=np.uint64)
        self._rows: Rows = np.full(2 * 64, -1)  # of the key in each slot; -1 for none
        self._size = 0  # rows given out
        self._cost: Floats = np.full(64, -math.inf)
        self._bound: Bools = np.ones(64, dtype=bool)  # whether the cost is a bound only
        self._terms: Floats = np.empty((64, num_terms))

    def rows(self, schedules: Tensor | Neighbours) -> Rows:
        """The row of each of schedules (N, T) in this table, (N,); equal schedules have one row."""
        wanted = keys(schedules, self._modes)
        # what is equal among those that are new leaves gaps
        fresh = np.arange(self._size, self._size + len(wanted))
        self._make_room(self._size + len(wanted))
        rows = self._found(wanted, fresh)
        self._size = max(self._size, int(rows.max(initial=-1)) + 1)
        return rows

    def _found(self, wanted: Words, fresh: Rows) -> Rows:
        """The rows of keys (N,), (N,); a new one gets its `fresh` (N,) one."""
        last = np.uint64(len(self._keys) - 1)
        rows, asking, slots = np.empty_like(fresh), np.arange(len(wanted)), (wanted & last).view(np.int64)
        while len(asking) > 0:
            empty = self._rows.take(slots) < 0
            # of several that want the same slot the last one gets it
            self._keys[slots[empty]], self._rows[slots[empty]] = wanted[empty], fresh[empty]
            there = self._keys.take(slots) == wanted
            rows[asking[there]] = self._rows.take(slots[there])
            other = ~there
            asking, wanted, fresh = asking[other], wanted[other], fresh[other]
            slots = slots[other] + 1 & int(last)
        return rows

    def _make_room(self, number: int) -> None:
        """Let so many rows fit, half of the slots staying empty."""
        if 2 * number <= len(self._keys):
            return
        used, slots = self._rows >= 0, 1 << (2 * number - 1).bit_length()
        given = self._keys[used], self._rows[used]
        # of a new row nothing is known: a bound that answers nobody
        room = np.full(slots // 2, -math.inf), np.ones(slots // 2, dtype=bool)
        kept, known = (*room, np.empty((slots // 2, self._terms.shape[1]))), len(self._cost)
        for new, old in zip(kept, (self._cost, self._bound, self._terms), strict=True):
            new[:known] = old
        self._cost, self._bound, self._terms = kept
        self._keys, self._rows = np.empty(slots, dtype=np.uint64), np.full(slots, -1)
        self._found(*given)

    def missing(self, rows: Rows, bound: float) -> Bools:
        """Which of rows (N,) do not answer a caller who has no use for costs above `bound`, (N,)."""
        return self._bound[rows] & (self._cost[rows] <= bound)

    def costs(self, rows: Rows, bound: float) -> Floats:
        """Costs of rows (N,): NaN where `missing`, inf where pruned."""
        known = np.where(self._bound[rows], np.inf, self._cost[rows])
        return np.where(self.missing(rows, bound), np.nan, known)

    def terms(self, row: int) -> Floats:
        """Cost terms of a row that was not pruned."""
        return self._terms[row]

    def learn(self, rows: Rows, cost: Floats, pruned: Bools, terms: Floats) -> None:
        """Take down (n,) costs and whether they are lower bounds only, and terms (n, number of terms)."""
        self._cost[rows], self._bound[rows], self._terms[rows] = cost, pruned, terms
