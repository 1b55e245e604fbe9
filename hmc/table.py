"""A transposition table: what is known of schedules, whichever switch they came from."""

from __future__ import annotations

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
        self._size = 0
        self._cost: Floats = np.empty(64)
        self._pruned: Bools = np.empty(64, dtype=bool)
        self._terms: Floats = np.empty((64, num_terms))

    def keys(self, schedules: Tensor) -> list[bytes]:
        """What names each of schedules (N, T) in this table."""
        small = schedules.to("cpu", self._type).contiguous().numpy()
        # fixed-width strings lose their trailing zeros, all of them the same way: keys stay distinct
        names: list[bytes] = small.view(f"S{small.shape[1] * small.itemsize}")[:, 0].tolist()
        return names

    def find(self, keys: list[bytes]) -> Rows:
        """Rows of keys, (N,); -1 where nothing is known."""
        get = self._row.get
        return np.fromiter((get(key, -1) for key in keys), np.int64, len(keys))

    def missing(self, rows: Rows, bound: float) -> Bools:
        """Which of rows (N,) do not answer a caller who has no use for costs above `bound`, (N,)."""
        return (rows < 0) | (self._pruned[rows] & (self._cost[rows] <= bound))

    def costs(self, rows: Rows, bound: float) -> Floats:
        """Costs of rows (N,): NaN where `missing`, inf where pruned."""
        known = np.where(self._pruned[rows], np.inf, self._cost[rows])
        return np.where(self.missing(rows, bound), np.nan, known)

    def terms(self, row: int) -> Floats:
        """Cost terms of a row that was not pruned."""
        return self._terms[row]

    def learn(self, keys: list[bytes], cost: Floats, pruned: Bools, terms: Floats) -> None:
        """Take down (n,) costs and whether they are lower bounds only, and terms (n, number of terms)."""
        first, self._size = self._size, self._size + len(keys)
        while self._size > len(self._cost):
            self._cost, self._pruned, self._terms = (
                np.concatenate([part, np.empty_like(part)])
                for part in (self._cost, self._pruned, self._terms)
            )
        new = slice(first, self._size)
        self._cost[new], self._pruned[new], self._terms[new] = cost, pruned, terms
        self._row.update(zip(keys, range(first, self._size), strict=True))
