"""How much memory the processes of a run take, and whether it grows."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

WARM = 20.0  # s after which what is made on first use has been made
EVERY = 5.0  # s
WINDOW = 12  # looks: a writer's buffers come and go within a minute
_PAGE = 4096 / 2**20  # MiB


class Memory:
    """Resident memory of processes, looked at now and then.

    Args:
        processes: names and numbers of them.
    """

    def __init__(self, processes: Mapping[str, int]):
        self._processes = dict(processes)
        self._seen: dict[str, list[float]] = {}
        self._next = time.monotonic() + WARM

    def look(self) -> None:
        """Look, if it is time for it."""
        if (now := time.monotonic()) < self._next:
            return
        self._next = now + EVERY
        for name, number in self._processes.items():
            with suppress(OSError, ValueError, IndexError):  # it has just ended
                pages = int(Path(f"/proc/{number}/statm").read_text().split()[1])
                self._seen.setdefault(name, []).append(round(_PAGE * pages, 1))

    @property
    def found(self) -> dict[str, tuple[float, float]]:
        """Of each process, the most in the first minute that it was warm, and in the last one [MiB]."""
        return {name: (max(seen[:WINDOW]), max(seen[-WINDOW:])) for name, seen in self._seen.items()}
