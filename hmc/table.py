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
        self._type = torch.uint8 if num_modes <= 256 else torch.int32
        self._row: dict[bytes, int] = {}
        self._cost: Floats = np.full(64, -math.inf)
        self._bound: Bools = np.ones(64, dtype=bool)  # whether the cost is a bound only
        self._terms: Floats = np.empty((64, num_terms))

    def rows(self, schedules: Tensor) -> Rows:
        """The row of each of schedules (N, T) in this table, (N,); equal schedules have one row."""
        small = np.ascontiguousarray(schedules.to("cpu", self._type).numpy())
        # fixed-width strings lose their trailing zeros, all of them the same way: they stay distinct
        keys = small.view(f"S{small.shape[1] * small.itemsize}")[:, 0].tolist()
        row = self._row
        rows = np.fromiter((row.setdefault(key, len(row)) for key in keys), np.int64, len(keys))
        while len(row) > len(self._cost):
            # of a new row nothing is known: a bound that answers nobody
            self._cost = np.concatenate([self._cost, np.full_like(self._cost, -math.inf)])
            self._bound = np.concatenate([self._bound, np.ones_like(self._bound)])
            self._terms = np.concatenate([self._terms, np.empty_like(self._terms)])
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
