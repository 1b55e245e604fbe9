"""Quantiles of the chi-square distribution, and the band that a mean of normalised errors should be in."""

from __future__ import annotations

import math
from statistics import NormalDist


def quantile(p: float, freedom: int) -> float:
    """Chi-square quantile by Wilson and Hilferty's cube, good to 0.2 % from 20 degrees of freedom on."""
    a = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - a + NormalDist().inv_cdf(p) * math.sqrt(a)) ** 3


def band(freedom: int, runs: int, share: float = 0.95) -> tuple[float, float]:
    """Where the mean of `runs` independent chi-square numbers lies with probability `share`.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with applications to tracking and
    navigation", 2001, section 5.4.
    """
    tail = 0.5 * (1.0 - share)
    low, high = (quantile(p, freedom * runs) / runs for p in (tail, 1.0 - tail))
    return low, high
