"""Schedules that begin alike, as the branches of a tree: equal beginnings need one rollout only.

With the trunk 0 0 0 0 0, which is known already, three schedules of five steps:

    a  0 0 1 0 0   is the trunk up to step 2, where it is born from it: 3 steps to roll out
    b  0 0 1 1 0   is a up to step 3, where it becomes a world of its own, a copy of a's: 2 steps
    c  0 0 0 0 2   is born from the trunk at step 4: 1 step

Six steps in place of 15. Then row = [0, 1, 2], parent = [-1, 0, -1] and born = [0, 0, 0, 1, 2, 3, 3].
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from hmc.neighbours import Neighbours


@dataclass(frozen=True, eq=False)
class Branches:
    """n schedules of T steps around a trunk, a schedule of which t <= T steps are known already.

    A branch is born at the step where its schedule parts from that of its parent; up to there the two
    are one. Branches are in order of birth, so those that exist at a step are the first so many.

    Attributes:
        row: which of the given schedules each branch is, (n,) long.
        modes: those schedules in order of the branches, (n, T).
        parent: the branch that each parts from, (n,) long; -1 for the trunk.
        born: how many branches are born before step i, for i = 0 ... T + 1. Those of step T differ from
            their parent nowhere.
        seeds: how many of those born at step i, the first ones, part from the trunk.
        last: the step from which on each schedule stays in one mode, (n,).
    """

    row: Tensor
    modes: Tensor
    parent: Tensor
    born: list[int]
    seeds: list[int]
    last: np.ndarray

    @cached_property
    def settled(self) -> np.ndarray:
        """The step from which on a branch stays in one mode and none parts from it, (n,)."""
        births, parent = np.arange(len(self.born) - 1).repeat(np.diff(self.born)), self.parent.numpy()
        parted, some = np.zeros_like(births), parent >= 0
        parted[parent[some]] = births[some]  # of several the last one, as they come in order of birth
        return np.maximum(self.last, parted)

    def path(self, row: int) -> list[int]:
        """The branch that a given schedule is at each step i = 0 ... T; -1 while it is the trunk."""
        path, stop, branch = [-1] * (len(self.born) - 1), len(self.born) - 1, int((self.row == row).nonzero())
        while branch >= 0:
            birth = bisect(self.born, branch) - 1
            path[birth:stop] = [branch] * (stop - birth)
            stop, branch = birth, int(self.parent[branch])
        return path


def tree_of(
    schedules: Tensor | Neighbours, trunk: Sequence[int], ahead: Sequence[int] | None = None
) -> Branches:
    """The tree of schedules (n, T), after one `ahead` of them, around `trunk` (t modes)."""
    if isinstance(schedules, Neighbours):
        if schedules.base.modes == tuple(trunk if ahead is None else ahead):
            return fan(schedules, trunk, ahead is not None)
        schedules = schedules.tensor()
    rows = schedules.cpu()
    if ahead is not None:
        rows = torch.cat([torch.tensor(ahead, dtype=rows.dtype)[:, None], rows.T], 1).T
    return branches(rows, trunk)


def branches(schedules: Tensor, trunk: Sequence[int]) -> Branches:
    """The tree of schedules (n, T), mode indices, around `trunk` (t modes)."""
    steps = _steps(schedules)
    birth, parent = _parted(steps, trunk)
    slots = _slots(birth, parent, len(steps))
    return _tree(torch.from_numpy(steps.take(slots, 1)).T, slots, birth, parent, _last(steps))


def fan(switched: Neighbours, trunk: Sequence[int], beside: bool) -> Branches:
    """The tree of neighbours of a schedule around `trunk` (t modes), from when they part: no two are equal.

    Args:
        switched: the neighbours.
        trunk: of that very schedule, if it is not `beside`.
        beside: whether that schedule is row 0 of the tree, and the neighbours come after it.
    """
    base, horizon, n = switched.base.modes, len(switched.base), len(switched)
    # schedule and trunk part here; before that, all that parts from the one parts from both
    apart = next((i for i, (a, b) in enumerate(zip(base, trunk, strict=False)) if a != b), len(trunk))
    mode, start, stop = switched.mode, switched.start, switched.stop
    # those of one mode and start are one until the first of them ends: they part from the one that ends last
    longest = np.zeros(switched.num_modes * (horizon + 1), dtype=np.int64)
    group, by_stop = mode * (horizon + 1) + start, _sorted(stop, horizon)
    longest[group[by_stop]] = by_stop
    stem = longest[group]
    first = stem == np.arange(n)
    birth = np.where(first, start, switched.changed_next)
    parent = np.where(first, np.where(start <= apart, -1, 0), stem + beside)
    if apart < len(trunk):  # some switch to what the trunk goes on with
        along = np.flatnonzero((start == apart) & (mode == trunk[apart]))
        if len(along) > 0:
            birth[along], stems = _parted(_steps(switched[along].tensor()), trunk)
            parent[along] = np.where(stems < 0, -1, along[stems] + beside)
    calm = next((i for i in range(horizon - 1, 0, -1) if base[i] != base[i - 1]), 0)
    last = np.where(stop < horizon, np.maximum(stop, calm), start)
    if beside:
        birth, parent, last = np.r_[apart, birth], np.r_[-1, parent], np.r_[calm, last]
    slots = _slots(birth, parent, horizon)
    if not beside:
        return _tree(switched[slots].tensor(), slots, birth, parent, last)
    modes = switched[np.maximum(slots - 1, 0)].tensor()
    modes[int(np.flatnonzero(slots == 0)[0])] = torch.tensor(base)
    return _tree(modes, slots, birth, parent, last)


def _parted(steps: np.ndarray, trunk: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """When each of schedules (T, n) parts from which other one, -1 for the trunk: (n,) each."""
    horizon, n = steps.shape
    order = _order(steps, trunk)
    rows = steps.take(order, 1)
    before = np.empty_like(rows)  # the one before each; the first comes after the trunk
    before[:, 1:], before[: len(trunk), 0], before[len(trunk) :, 0] = rows[:, :-1], trunk, -1
    apart = before != rows
    birth = np.where(apart.any(0), apart.argmax(0), horizon)
    # the parent of a branch is the last one before it that was there earlier: its neighbour's ancestor
    parent = np.full(n, -1)
    for i in np.flatnonzero(np.bincount(birth))[1:]:
        here, there = np.flatnonzero(birth == i), np.flatnonzero(birth < i)
        last = np.searchsorted(there, here) - 1
        parent[here] = np.where(last < 0, -1, order[there[last]])
    place = np.empty_like(order)
    place[order] = np.arange(n)
    return birth[place], parent[place]


def _slots(birth: np.ndarray, parent: np.ndarray, horizon: int) -> np.ndarray:
    """The order of birth of branches born at steps `birth` (n,), at each step those from the trunk first."""
    return _sorted(2 * birth + (parent >= 0), 2 * horizon + 1)


def _sorted(values: np.ndarray, largest: int) -> np.ndarray:
    """The stable order of values, (n,); small numbers are sorted by their digits, which is quicker."""
    return np.argsort(values.astype(np.uint16 if largest < 2**16 else np.int64), kind="stable")


def _last(steps: np.ndarray) -> np.ndarray:
    """The step from which on each of schedules (T, n) stays in one mode, (n,)."""
    last = np.zeros(steps.shape[1], dtype=np.int64)
    for i in range(1, len(steps)):
        np.copyto(last, i, where=steps[i] != steps[i - 1])
    return last


def _tree(
    modes: Tensor, slots: np.ndarray, birth: np.ndarray, parent: np.ndarray, last: np.ndarray
) -> Branches:
    """The tree of schedules (n, T) in order `slots` of birth, of rows that part when `_parted` says."""
    rank = np.empty_like(slots)
    rank[slots] = np.arange(len(slots))
    steps, stems = modes.shape[1] + 1, parent[slots]
    return Branches(
        row=torch.from_numpy(slots),
        modes=modes,
        parent=torch.from_numpy(np.where(stems < 0, -1, rank[stems])),
        born=[0, *np.cumsum(np.bincount(birth, minlength=steps)).tolist()],
        seeds=np.bincount(birth[parent < 0], minlength=steps).tolist(),
        last=last[slots],
    )


def added_steps(schedules: Tensor, trunk: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Steps that each of schedules (n, T) adds to `trunk` and those before it, and to `trunk` alone, (n,)."""
    n, horizon = schedules.shape
    steps = _steps(schedules)
    order = _order(steps, trunk)
    rows = steps.take(order, 1)
    # what each, in order, shares with the one before; `most` is with the trunk, which is always there
    apart = rows[:, 1:] != rows[:, :-1]
    shared = [0, *np.where(apart.any(0), apart.argmax(0), horizon).tolist(), 0]
    lead = rows[: len(trunk)] != np.asarray(trunk, dtype=rows.dtype)[:, None]
    most = np.vstack([lead, np.ones((1, n), dtype=bool)]).argmax(0)
    # taken away from the last one to the first, each one's neighbours are of those that come before it
    before, after = list(range(-1, n - 1)), list(range(1, n + 1))
    place = np.argsort(order, kind="stable")
    alike = np.zeros(n, dtype=np.int64)
    for j in reversed(place.tolist()):
        above, below = before[j], after[j]
        left, right = shared[j], shared[below]
        alike[j] = max(left, right)
        shared[below] = min(left, right)
        if below < n:
            before[below] = above
        if above >= 0:
            after[above] = below
    return horizon - np.maximum(alike, most)[place], horizon - most[place]


def in_order(schedules: Tensor, trunk: Sequence[int]) -> np.ndarray:
    """Order of schedules (n, T) with common beginnings side by side, those nearest to the trunk first."""
    return _order(_steps(schedules), trunk)


def _order(steps: np.ndarray, trunk: Sequence[int]) -> np.ndarray:
    """As `in_order`, of steps (T, n)."""
    horizon, n = steps.shape
    if n < 2:
        return np.arange(n)
    # the trunk's mode becomes the first of each step's alphabet, so that the trunk sorts before all others
    swapped, lead = steps + 1, np.asarray(trunk, dtype=steps.dtype)[:, None]
    known = swapped[: len(trunk)]
    known[known == lead + 1] = 0
    # a word holds as many steps as fit, the first one in its highest bits
    bits = int(swapped.max(initial=1)).bit_length()
    fit, words = 64 // bits, []
    for first in range(0, horizon, fit):
        word = np.zeros(n, dtype=np.uint64)
        for step in swapped[first : first + fit]:
            np.left_shift(word, np.uint64(bits), out=word)
            np.bitwise_or(word, step.astype(np.uint64), out=word)
        words.append(word)
    return np.lexsort(words[::-1])


def _steps(schedules: Tensor) -> np.ndarray:
    """Schedules (n, T) as (T, n), a step's modes side by side, in a type with room for M and -1."""
    rows = schedules.numpy().T
    return np.ascontiguousarray(rows, dtype=np.int16 if rows.itemsize == 1 else rows.dtype)
