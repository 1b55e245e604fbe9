"""Schedules that begin alike, as the branches of a tree: equal beginnings need one rollout only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Branches:
    """n schedules of T steps around a trunk, a schedule of which t <= T steps are known already.

    A branch is born at the step where its schedule parts from that of its parent; up to there the two
    are one. Branches are in order of birth, so those that exist at a step are the first so many.

    Attributes:
        row: which of the given schedules each branch is, (n,) long.
        modes: those schedules in order of the branches, (n, T) long.
        parent: the branch that each parts from, (n,) long; -1 for the trunk.
        born: how many branches are born before step i, for i = 0 ... T + 1. Those of step T differ from
            their parent nowhere.
    """

    row: Tensor
    modes: Tensor
    parent: Tensor
    born: list[int]


def branches(schedules: Tensor, trunk: Sequence[int]) -> Branches:
    """The tree of schedules (n, T) long, with modes below 256 or not, around `trunk` (t modes)."""
    horizon = schedules.shape[1]
    wide = schedules.numpy()
    order = in_order(wide, trunk)
    rows = wide[order]
    lead = np.zeros((1, horizon), dtype=rows.dtype)
    lead[0, : len(trunk)] = trunk
    apart = np.vstack([lead, rows[:-1]]) != rows  # each from the one before
    apart[:1, len(trunk) :] = True
    birth = np.where(apart.any(1), apart.argmax(1), horizon)
    # the parent of a branch is the last one before it that was there earlier: its neighbour's ancestor
    parent = np.full(len(rows), -1)
    for j, here in enumerate(birth.tolist()):
        above = j - 1
        while above >= 0 and birth[above] >= here:
            above = int(parent[above])
        parent[j] = above
    slots = np.argsort(birth, kind="stable")
    rank = np.empty_like(slots)
    rank[slots] = np.arange(len(slots))
    stems = parent[slots]
    counts = np.bincount(birth, minlength=horizon + 1)
    return Branches(
        row=torch.from_numpy(order[slots]),
        modes=torch.from_numpy(rows[slots]),
        parent=torch.from_numpy(np.where(stems < 0, -1, rank[stems])),
        born=[0, *np.cumsum(counts).tolist()],
    )


def in_order(schedules: np.ndarray, trunk: Sequence[int]) -> np.ndarray:
    """Order of schedules (n, T) with common beginnings side by side, those nearest to the trunk first."""
    # the trunk's mode becomes the first of each step's alphabet, so that the trunk sorts before all others
    swapped = schedules.copy()
    known = swapped[:, : len(trunk)]
    known[known == np.asarray(trunk, dtype=known.dtype)] = -1
    return np.lexsort(swapped.T[::-1])
