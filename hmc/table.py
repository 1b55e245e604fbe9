"""A transposition table: what is known of schedules, whichever switch they came from."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hmc.keys import keys
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
        self._row: dict[bytes, int] = {}
        self._size = 0
        self._cost: Floats = np.full(64, -math.inf)
        self._bound: Bools = np.ones(64, dtype=bool)  # whether the cost is a bound only
        self._terms: Floats = np.empty((64, num_terms))

    def rows(self, schedules: Tensor | Neighbours) -> Rows:
        """The row of each of schedules (N, T) in this table, (N,); equal schedules have one row."""
        found = keys(schedules, self._modes)
        # the number of a row is that of the first who asked for it: what is equal among them leaves gaps
        fresh = range(self._size, self._size + len(found))
        rows = np.fromiter(map(self._row.setdefault, found, fresh), np.int64, len(found))
        self._size = max(self._size, int(rows.max(initial=-1)) + 1)
        room = len(self._cost)
        if self._size > room:
            more = max(self._size - room, room)
            # of a new row nothing is known: a bound that answers nobody
            self._cost = np.concatenate([self._cost, np.full(more, -math.inf)])
            self._bound = np.concatenate([self._bound, np.ones(more, dtype=bool)])
            self._terms = np.concatenate([self._terms, np.empty((more, self._terms.shape[1]))])
        return rows

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
