"""Two switches at once: what may improve a schedule where no single switch does."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hmc.schedule import Schedule, Switch, SwitchSpace, tails

SHIFTS = (1, 2, 4, 8)  # control steps


def handovers(space: SwitchSpace, k: int, position: int, n: int) -> list[tuple[Switch, ...]]:
    """At most n pairs of a tail, and a tail of another mode after it: a hand-over by way of a third mode.

    Args:
        space: Omega.
        k: control step at which the horizon begins.
        position: where in the order of `tails` to begin.
        n: of them.
    """
    first = next((tail for tail in tails(space, k, position) if tail.duration > 1), None)
    if first is None:
        return []
    later = (
        tail for tail in tails(space, k, position) if tail.start > first.start and tail.mode != first.mode
    )
    return [(first, tail) for tail, _ in zip(later, range(n), strict=False)]


def moves(schedule: Schedule, rng: np.random.Generator, n: int) -> list[tuple[Switch, ...]]:
    """At most n ways to move a moment of switching, or a stretch of the schedule as a whole, at random.

    A stretch that begins too early and ends too early cannot be moved by one switch: it has to grow at one
    end first, and may cost more so. A moment alone is moved by a switch of Omega, which a draw rarely hits.

    Args:
        schedule: whose stretches are moved by one of SHIFTS, either way; none vanishes but the first.
        rng: picks.
        n: of them.
    """
    horizon = len(schedule)
    bounds = [0, *(i + 1 for i, (a, b) in enumerate(pairwise(schedule.modes)) if a != b), horizon]
    found: list[tuple[Switch, ...]] = []
    for i, (before, begin, end) in enumerate(zip(bounds, bounds[1:], bounds[2:], strict=False)):
        for size in SHIFTS:
            later = () if begin + size >= end else (Switch(schedule[begin - 1], begin, size),)
            sooner = () if begin - size < before + (i > 0) else (Switch(schedule[begin], begin - size, size),)
            found += [each for each in (later, sooner) if each]
            if end == horizon:
                continue
            following = bounds[i + 3]
            if end + size < following:
                found.append((Switch(schedule[begin], end, size), Switch(schedule[begin - 1], begin, size)))
            if sooner:
                found.append((*sooner, Switch(schedule[end], end - size, size)))
    return [found[i] for i in rng.permutation(len(found))[:n].tolist()]
