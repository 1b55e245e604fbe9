"""Counts of successes with the interval that their rate is in."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Score:
    """Successes of a number of episodes, with the 95 % Wilson interval of the rate."""

    success: int
    episodes: int

    @property
    def rate(self) -> float:
        """Share of episodes that succeeded."""
        return self.success / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval (Wilson 1927)."""
        n, p, z = self.episodes, self.rate, 1.959964
        middle = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(middle - half, 0.0), min(middle + half, 1.0)  # the bounds themselves, but for rounding

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.success} of {self.episodes} ({self.rate:.1%}; 95 % interval {low:.1%} to {high:.1%})"
