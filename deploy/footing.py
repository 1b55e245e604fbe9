"""How a foot that bears load moves all the same: it lands, slides where it bears little, and gives way."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class FootingCfg:
    """Standard deviations of a foot's speed, and for how long they stay the same.

    Attributes:
        settle: horizontal speed that a foot has left when it begins to count as standing [m/s].
        settle_time: in which it goes down to 1/e [s].
        bounce: vertical speed with which a foot comes back out of ground that it has hit, of that of the hit.
        bounce_time: in which it goes down to 1/e [s].
        slide_time: over which the speed of a contact point is averaged, and for which it lasts [s].
        slide_gate: squared speed that still counts as noise, in units of its variance.
        light: horizontal speed of a foot that bears next to nothing: it slides before it lifts off [m/s].
        light_share: of the mean load of all feet that carry, from which on a foot does not.
        give_time: in which a foot gives way to a load [s].
        give_share: of the speed at which it does, that is not known.
    """

    settle: float = 0.1
    settle_time: float = 0.01
    bounce: float = 0.25
    bounce_time: float = 0.025
    slide_time: float = 0.004
    slide_gate: float = 2.0
    light: float = 0.2
    light_share: float = 0.5
    give_time: float = 0.0125
    give_share: float = 0.6


class Footing:
    """One foot.

    Attributes:
        load: that it has given way to: what it bears, late by `FootingCfg.give_time` [N].
        bounces: variance of its vertical speed since it touched down [m^2/s^2].
    """

    def __init__(self, cfg: FootingCfg):
        self._cfg = cfg
        self.load = self.bounces = 0.0
        self._settles = self._slides = self._lightness = self._rate = 0.0
        self._mean = (0.0, 0.0)  # speed of the contact point along the ground [m/s]

    def touch_down(self, speed: float) -> None:
        """It begins to carry, at a vertical speed [m/s]."""
        cfg = self._cfg
        self._settles, self._mean = cfg.settle**2, (0.0, 0.0)
        self.bounces = (cfg.bounce * min(speed, 0.0)) ** 2

    def bear(self, load: float, mean: float, dt: float) -> None:
        """It bears a load, all feet that carry bear so much on average [N]; a load of NaN tells nothing."""
        if not math.isfinite(load + mean):
            return
        self._rate = (load - self.load) / (dt + self._cfg.give_time)
        self.load += self._rate * dt
        share = load / mean if mean > 0.0 else 1.0
        self._lightness = min(max(1.0 - share / self._cfg.light_share, 0.0), 1.0)

    def slide(self, x: float, y: float, variance: float, noise: float, dt: float) -> None:
        """Its contact point moves along the ground, as it seems.

        Args:
            x, y: [m/s].
            variance: of that, what stays the same from reading to reading [m^2/s^2].
            noise: what does not.
            dt: [s].
        """
        part = dt / (dt + self._cfg.slide_time)
        a, b = self._mean
        self._mean = a, b = a + part * (x - a), b + part * (y - b)
        self._slides = max(0.0, a * a + b * b - self._cfg.slide_gate * (variance + part * noise))

    def loose(self, give: float, dt: float) -> tuple[float, float]:
        """What its place walks in a step along an axis of the ground, and up and down [m^2/s].

        Args:
            give: mean square of its compliance [m^2/N^2].
            dt: [s].
        """
        cfg = self._cfg
        self._settles *= math.exp(-2.0 * dt / cfg.settle_time)
        self.bounces *= math.exp(-2.0 * dt / cfg.bounce_time)
        slides = 0.5 * self._slides + (cfg.light * self._lightness) ** 2
        yields = give * (cfg.give_share * self._rate) ** 2
        across = self._settles * cfg.settle_time + slides * cfg.slide_time
        return across, self.bounces * cfg.bounce_time + yields * cfg.give_time
