"""A transposition table: what is known of schedules, whichever switch they came from."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
        self._modes, self._type = max(num_modes, 2), torch.uint8 if num_modes <= 256 else torch.int32
        # steps that a byte has room for: short keys are quicker to lay out and to look up
        self._fit = max(fit for fit in range(1, 9) if fit == 1 or self._modes**fit <= 256)
        self._row: dict[bytes, int] = {}
        self._size = 0
        self._cost: Floats = np.full(64, -math.inf)
        self._bound: Bools = np.ones(64, dtype=bool)  # whether the cost is a bound only
        self._terms: Floats = np.empty((64, num_terms))

    def rows(self, schedules: Tensor) -> Rows:
        """The row of each of schedules (N, T) in this table, (N,); equal schedules have one row."""
        row, keys = self._row, self._keys(schedules.to("cpu", self._type).numpy().T)
        # the number of a row is that of the first who asked for it: what is equal among them leaves gaps
        fresh = range(self._size, self._size + len(keys))
        rows = np.fromiter(map(row.setdefault, keys, fresh), np.int64, len(keys))
        self._size = max(self._size, int(rows.max(initial=-1)) + 1)
        room = len(self._cost)
        if self._size > room:
            more = max(self._size - room, room)
            # of a new row nothing is known: a bound that answers nobody
            self._cost = np.concatenate([self._cost, np.full(more, -math.inf)])
            self._bound = np.concatenate([self._bound, np.ones(more, dtype=bool)])
            self._terms = np.concatenate([self._terms, np.empty((more, self._terms.shape[1]))])
        return rows

    def _keys(self, steps: NDArray[np.integer]) -> list[bytes]:
        """What schedules (T, N) are looked up by."""
        words = steps[:: self._fit].copy()
        for i in range(1, self._fit):
            words *= self._modes
            more = steps[i :: self._fit]
            words[: len(more)] += more
        rows = np.ascontiguousarray(words.T)
        # fixed-width strings lose their trailing zeros, all of them the same way: they stay distinct
        keys: list[bytes] = rows.view(f"S{rows.shape[1] * rows.itemsize}")[:, 0].tolist()
        return keys

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
