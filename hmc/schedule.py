"""Mode schedules, single switches of a schedule, and the space Omega of all such switches."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby, islice
from typing import overload

import numpy as np
import torch
from torch import Tensor

from hmc.neighbours import Indices, Neighbours


@dataclass(frozen=True)
class Switch:
    """Run `mode` in steps start <= k < start + duration: the paper's (m, mu, nu), with nu >= 1."""

    mode: int
    start: int
    duration: int

    def __post_init__(self) -> None:
        if self.mode < 0 or self.start < 0 or self.duration < 1:
            raise ValueError(f"{self!r}: expected mode >= 0, start >= 0 and duration >= 1")

    @property
    def stop(self) -> int:
        """First step after the switch."""
        return self.start + self.duration


@dataclass(frozen=True)
class Schedule(Sequence[int]):
    """K in M^T: the mode of each of T control steps. An immutable value, equal where the modes are equal.

    Attributes:
        modes: T mode indices; any iterable of integers is taken.
        names: names of all modes, for printing only.
    """

    modes: tuple[int, ...]
    names: tuple[str, ...] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        items: Iterable[int] = self.modes.tolist() if isinstance(self.modes, Tensor) else self.modes
        modes = tuple(map(operator.index, items))
        if not modes:
            raise ValueError("a schedule needs at least one control step, got none")
        limit = len(self.names) if self.names is not None else None
        if min(modes) < 0 or (limit is not None and max(modes) >= limit):
            k = next(k for k, mode in enumerate(modes) if mode < 0 or (limit is not None and mode >= limit))
            known = f"0 to {limit - 1} ({', '.join(self.names or ())})" if limit else "indices >= 0"
            raise ValueError(f"schedule step {k}: unknown mode {modes[k]}, expected {known}")
        object.__setattr__(self, "modes", modes)

    @classmethod
    def constant(cls, mode: int, horizon: int, names: tuple[str, ...] | None = None) -> Schedule:
        """The same mode at all `horizon` steps."""
        return cls((mode,) * horizon, names)

    def __len__(self) -> int:
        return len(self.modes)

    def __iter__(self) -> Iterator[int]:
        return iter(self.modes)

    @overload
    def __getitem__(self, k: int) -> int: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[int, ...]: ...
    def __getitem__(self, k: int | slice) -> int | tuple[int, ...]:
        return self.modes[k]

    def stitch(self, switch: Switch) -> Schedule:
        """(m, mu, nu) u K: this schedule with the switch's steps overwritten."""
        if switch.stop > len(self):
            raise ValueError(f"{switch!r} ends at step {switch.stop}, after the schedule's {len(self)} steps")
        modes = (*self.modes[: switch.start], *[switch.mode] * switch.duration, *self.modes[switch.stop :])
        return Schedule(modes, self.names)

    def shift(self, fill: int | None = None) -> Schedule:
        """One step later: without the first step, with `fill` (default: the last mode) at the end."""
        return Schedule((*self.modes[1:], self.modes[-1] if fill is None else fill), self.names)

    def runs(self) -> tuple[Switch, ...]:
        """Stretches of one mode, in order."""
        runs, start = [], 0
        for mode, steps in groupby(self.modes):
            duration = len(list(steps))
            runs.append(Switch(mode, start, duration))
            start += duration
        return tuple(runs)

    def tensor(self, device: torch.device | str = "cpu") -> Tensor:
        """Mode indices, (T,) long."""
        return torch.tensor(self.modes, dtype=torch.long, device=device)

    def __str__(self) -> str:
        label = (lambda m: str(m)) if self.names is None else self.names.__getitem__
        return " | ".join(f"{label(run.mode)} x{run.duration}" for run in self.runs())


def batch(schedules: Iterable[Schedule]) -> Tensor:
    """Schedules of equal length as rows, (N, T) long."""
    return torch.tensor([schedule.modes for schedule in schedules], dtype=torch.long)


class SwitchSpace:
    r"""Omega: every switch of a schedule of T steps into one of M modes, Z = M T (T+1) / 2 of them.

    A bijection between 0 <= index < Z and (m, mu, nu) that stores nothing and uses integers only. The
    T (T+1) / 2 intervals of one mode form a triangle: start mu has T - mu durations. Row i of the
    triangle and the row that holds W - (T - i) durations, W the odd one of T and T + 1, are laid side by
    side; the triangle becomes a rectangle of width W, and a division finds row and column.
    """

    def __init__(self, num_modes: int, horizon: int):
        if num_modes < 1 or horizon < 1:
            raise ValueError(
                f"expected at least 1 mode and 1 step, got num_modes={num_modes}, horizon={horizon}"
            )
        self.num_modes = num_modes
        self.horizon = horizon
        self._intervals = horizon * (horizon + 1) // 2
        self._width = horizon | 1

    def __len__(self) -> int:
        return self.num_modes * self._intervals

    def __getitem__(self, index: int) -> Switch:
        if not 0 <= index < len(self):
            raise IndexError(f"switch {index} of a space of {len(self)}")
        mode, interval = divmod(index, self._intervals)
        row, column = divmod(interval, self._width)
        durations = self.horizon - row
        if column < durations:
            return Switch(mode, row, column + 1)
        return Switch(mode, 2 * self.horizon - self._width - row, column - durations + 1)

    def index(self, switch: Switch) -> int:
        """Inverse of ``space[index]``."""
        if switch.mode >= self.num_modes or switch.stop > self.horizon:
            raise ValueError(f"{switch!r} is not among {self.num_modes} modes x {self.horizon} steps")
        return int(self._index(switch.mode, np.array(switch.start), np.array(switch.duration)))

    def coarse(self, parts: int) -> Tensor:
        """Indices of the switches that begin and end where a horizon cut into `parts` is cut, ascending."""
        cuts = np.unique(np.arange(parts + 1) * self.horizon // parts)
        start, stop = (cuts[ends] for ends in np.triu_indices(len(cuts), 1))
        modes = np.arange(self.num_modes)[:, None]
        return torch.from_numpy(np.sort(self._index(modes, start, stop - start).ravel()))

    def _index(self, mode: int | Indices, start: Indices, duration: Indices) -> Indices:
        """The index of switches."""
        lower = 2 * start >= self.horizon
        row = np.where(lower, 2 * self.horizon - self._width - start, start)
        column = duration - 1 + lower * (self.horizon - row)
        found: Indices = mode * self._intervals + row * self._width + column
        return found

    def split(self, indices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mode, start and duration of each index: three long tensors in the shape of `indices`."""
        flat = indices.cpu().numpy()  # which divides several times as fast
        mode = flat // self._intervals
        interval = flat - mode * self._intervals
        row = interval // self._width
        column = interval - row * self._width
        durations = self.horizon - row
        lower = column >= durations
        start = np.where(lower, 2 * self.horizon - self._width - row, row)
        duration = column + 1 - lower * durations
        return torch.as_tensor(mode), torch.as_tensor(start), torch.as_tensor(duration)

    def stitch(self, schedule: Schedule, indices: Tensor) -> Tensor:
        """`schedule` with each of the switches `indices` (N,) in turn, (N, T), in a type that fits."""
        return self.neighbours(schedule, indices).tensor()

    def neighbours(self, schedule: Schedule, indices: Tensor) -> Neighbours:
        """The same, as what differs from `schedule`."""
        mode, start, duration = (part.numpy() for part in self.split(indices))
        return Neighbours.of(schedule, self.num_modes, mode, start, start + duration)


class Draws:
    """Uniform draws without replacement from 0 <= index < size.

    A Fisher-Yates shuffle of which only the moved entries are kept: O(draws) memory at any size, every
    order of the whole range equally likely, and each index comes exactly once.
    """

    def __init__(self, size: int, rng: np.random.Generator):
        self._size, self._rng = size, rng
        self._taken = 0
        self._moved: dict[int, int] = {}

    @property
    def left(self) -> int:
        """How many indices have not been drawn yet."""
        return self._size - self._taken

    def take(self, n: int) -> Tensor:
        """The next n indices, or all that are left if fewer, (n,) long."""
        first, self._taken = self._taken, self._taken + min(n, self.left)
        if first == self._taken:
            return torch.empty(0, dtype=torch.long)
        picks = self._rng.integers(np.arange(first, self._taken), self._size)
        drawn = []
        for position, pick in enumerate(picks.tolist(), first):
            here = self._moved.pop(position, position)
            if pick == position:
                drawn.append(here)
            else:
                drawn.append(self._moved.get(pick, pick))
                self._moved[pick] = here
        return torch.tensor(drawn, dtype=torch.long)


def tails(space: SwitchSpace, k: int, position: int) -> Iterator[Switch]:
    """The switches that last to the end of the horizon, once each, spread evenly over modes and moments.

    They follow an additive recurrence with a step near the golden section. A moment keeps its place in it
    from one control step to the next.

    Args:
        space: Omega, of M modes and T steps.
        k: control step at which the horizon begins.
        position: where in the sequence to begin.
    """
    size, horizon = space.num_modes * space.horizon, space.horizon
    step = next(s for s in range(max(1, round(0.618 * size)), 2 * size) if math.gcd(s, size) == 1)
    for i in range(position, position + size):
        mode, moment = divmod(i * step % size, horizon)
        start = (moment - k) % horizon
        yield Switch(mode, start, horizon - start)


class TailsFirst:
    """Every switch once: those that last to the end of the horizon first, then the rest, shuffled.

    Once a plan exists it is mostly the moment of handing over that is wrong, and the M T switches that
    hand over for good are few beside the Z of all. They come in the order of `tails`: searches that
    draw n of them each, at positions n apart, come to all of them before they come to any again. The
    interface is that of `Draws`.

    Args:
        space: Omega.
        rng: shuffles the rest.
        k: control step at which the horizon begins.
        position: where in the order of the tails to begin.
    """

    def __init__(self, space: SwitchSpace, rng: np.random.Generator, k: int = 0, position: int = 0):
        self._space = space
        self._tails = (space.index(tail) for tail in tails(space, k, position))
        self._rest = Draws(len(space), rng)
        self.left = len(space)

    def take(self, n: int) -> Tensor:
        """The next n indices, or all that are left if fewer, (n,) long."""
        n = min(n, self.left)
        head = list(islice(self._tails, n))
        self.left -= n
        parts = [torch.tensor(head, dtype=torch.long)]
        missing = n - len(head)
        while missing > 0:
            drawn = self._rest.take(missing)
            _, start, duration = self._space.split(drawn)
            parts.append(drawn[start + duration < self._space.horizon])
            missing -= len(parts[-1])
        return torch.cat(parts)


class InOrder:
    """Every index 0 <= index < size, ascending, after some that come first; the interface is that of `Draws`.

    Args:
        size: of the range.
        first: what comes first, (n,) long, in a batch of its own.
    """

    def __init__(self, size: int, first: Tensor | None = None):
        self._first = torch.empty(0, dtype=torch.long) if first is None else first
        later = torch.ones(size, dtype=torch.bool)
        later[self._first] = False
        self._later = later.nonzero()[:, 0]

    @property
    def left(self) -> int:
        """How many indices have not been taken yet."""
        return len(self._first) + len(self._later)

    def take(self, n: int) -> Tensor:
        """The next n indices or fewer, (n,) long: at least one, if any is left."""
        if len(self._first) > 0:
            taken, self._first = self._first[:n], self._first[n:]
        else:
            taken, self._later = self._later[:n], self._later[n:]
        return taken
