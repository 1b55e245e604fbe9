"""How late the control steps are, how long nothing was heard, and who else had the machine's cores."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from pathlib import Path

EDGES = (0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # ms; the last bin has no end
_WINDOW = 100  # ticks
_STAT, _STEAL = Path("/proc/stat"), 7  # Linux; field of its first line


class Lateness:
    """Time from when the robot measured a tick's state until its command leaves, beyond the best of late.

    The two clocks differ by an unknown offset that drifts slowly. The smallest difference in the last 2 s is
    the offset and the shortest way; what a tick takes beyond it is its lateness.

    Attributes:
        bins: ticks by lateness; EDGES are the bins' upper ends.
    """

    def __init__(self) -> None:
        self.bins = [0] * (len(EDGES) + 1)
        self._recent: deque[float] = deque(maxlen=_WINDOW)

    def add(self, robot: float, now: float) -> float:
        """A tick of time `robot` on the robot's clock left at `now` on ours [s]; its lateness [ms]."""
        difference = now - robot
        self._recent.append(difference)
        late = 1e3 * (difference - min(self._recent))
        self.bins[bisect_left(EDGES, late)] += 1
        return late

    def __len__(self) -> int:
        """How many ticks."""
        return sum(self.bins)


class Silence:
    """Whether something has been silent for too long, counted in looks.

    A time in which nobody looked counts as `step`. When the whole machine stood still, what was to be heard
    did so, too, and gets the time that it has otherwise. That it did so again and again, and let nothing be
    heard in between, is less and less likely: each such time of one silence counts twice as much as the last.

    Attributes:
        heard: when it was heard last [s]; -inf before the first time.

    Args:
        allowed: silence that is not too long [s].
        most: nor is one of no more than this with what was not looked at [s].
        step: what counts of the first time between two looks that is longer, at most [s].
    """

    def __init__(self, allowed: float, most: float, step: float):
        self.heard = self._looked = -math.inf
        self._allowed, self._most, self._step = allowed, most, step
        self._counted, self._counts = 0.0, step

    def hear(self, t: float) -> None:
        """It was heard at t [s]."""
        self.heard, self._counted, self._counts = t, 0.0, self._step

    def too_long(self, now: float) -> bool:
        """Whether it is, looking `now` [s]."""
        age = now - self.heard
        unseen = min(now - self._looked, age)
        self._counted = min(self._counted + min(unseen, self._counts), age)
        if unseen > self._counts:
            self._counts *= 2
        self._looked = now
        return self._counted > self._allowed or age > self._most


class Stolen:
    """How much of the cores' time the host of a virtual machine has given to others since this was made."""

    def __init__(self) -> None:
        self._before = _times()

    @property
    def share(self) -> float | None:
        """Of the time of all cores; None where the kernel does not tell."""
        spent = [now - before for now, before in zip(_times(), self._before, strict=True)]
        return spent[_STEAL] / sum(spent) if len(spent) > _STEAL and sum(spent) > 0 else None


def _times() -> list[int]:
    """What the cores spent their time on: user, nice, system, idle, I/O, interrupts (2), stolen."""
    if not _STAT.exists():
        return []
    return [int(field) for field in _STAT.read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]]
