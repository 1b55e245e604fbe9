"""How much memory the processes of a run take, and whether it grows."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

WARM = 20.0  # s after which what is made on first use has been made
EVERY = 5.0  # s
WINDOW = 12  # looks: a writer's buffers come and go within a minute


class Memory:
    """The most resident memory that processes take within a minute.

    The kernel keeps the most, looked at now and then: a buffer of some MB that is there for a hundredth of a
    second counts each time, and not by chance.
    """

    def __init__(self) -> None:
        self._processes: dict[str, int] = {}
        self._peaks: dict[str, list[float]] = {}  # of each minute
        self._looks = 0
        self._next = math.inf

    def begin(self, processes: Mapping[str, int]) -> None:
        """Look at these from when they are warm, by name; their numbers."""
        self._processes, self._next = dict(processes), time.monotonic() + WARM

    def look(self) -> None:
        """Look, if it is time for it."""
        if (now := time.monotonic()) < self._next:
            return
        self._next = now + EVERY
        for name, number in self._processes.items():
            peaks = self._peaks.setdefault(name, [])
            with suppress(OSError, ValueError, IndexError):  # it has just ended
                if self._looks > 0:
                    peaks[-1] = _peak(number)
                if self._looks % WINDOW == 0:
                    _forget(number)
                    peaks.append(_peak(number))
        self._looks += 1

    @property
    def found(self) -> dict[str, tuple[float, float]]:
        """Of each process, the most in the first minute once it was warm, and in the last two [MiB]."""
        return {name: (peaks[0], max(peaks[-2:])) for name, peaks in self._peaks.items() if peaks}


def _peak(process: int) -> float:
    """The most resident memory since `_forget` [MiB]."""
    status = Path(f"/proc/{process}/status").read_text()
    return round(int(status.split("VmHWM:")[1].split()[0]) / 1024, 1)


def _forget(process: int) -> None:
    """Let the kernel's most begin anew."""
    with suppress(OSError):  # where that is not permitted, it is the most since the beginning
        Path(f"/proc/{process}/clear_refs").write_text("5")
