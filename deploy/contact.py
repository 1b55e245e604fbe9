r"""Which feet carry load, and whether an estimate can be true of a body that the ground carries.

Foot force sensors tell the load, and joint torques where a sensor is stuck.

The torques tell the normal force of the ground, legs taken as massless:

.. math:: n = -e_z^T C J^{-T} \tau
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ContactCfg:
    """Thresholds of contact.

    Sources: 20 counts is what published Go2 estimators take; a hysteresis follows Leg-KILO's on the Go2.

    Attributes:
        on: force reading above its zero at which a foot begins to carry [counts, about 1 N].
        off: below which it ends, likewise; between the two it ends if the torques say that the foot hangs.
        load_on: normal force by joint torques at which a foot surely carries [N].
        load_off: below which it surely does not [N].
        zero_time: how fast a sensor's zero follows its reading while the foot surely hangs [s].
        zero_limit: how far the zero may move [counts].
        stuck: how long sensor and torques may disagree before the sensor counts as stuck [s].
    """

    on: float = 20.0
    off: float = 12.0
    load_on: float = 25.0
    load_off: float = 12.0
    zero_time: float = 0.5
    zero_limit: float = 20.0
    stuck: float = 0.25


class FootContact:
    """One foot: hysteresis on its force, the sensor's zero tracked, and on its joint torques as the fallback.

    Attributes:
        contact: whether the foot carries load.
        stuck: whether its sensor is not believed.
    """

    def __init__(self, cfg: ContactCfg):
        self.cfg = cfg
        self.contact = self.stuck = False
        self._by_force = self._by_load = False
        self._zero = self._doubt = 0.0

    @property
    def firm(self) -> bool:
        """Whether sensor and torques both say that the foot carries load."""
        return self.contact and self._by_load

    def update(self, force: float, load: float, dt: float) -> bool:
        """One tick; whether the foot carries load.

        Args:
            force: sensor reading [counts]; NaN: none came.
            load: normal force by joint torques [N]; NaN: unknown.
            dt: since the tick before [s].
        """
        cfg, came = self.cfg, math.isfinite(force)
        # what compares with NaN is false: an unknown load neither carries nor hangs
        carries, hangs = load > cfg.load_on, load < cfg.load_off
        self._by_load = carries or (self._by_load and not hangs)
        above = force - self._zero
        if came:
            # a zero not yet known may lie between the two thresholds: there the torques tell the lift-off
            held = self._by_force and not hangs
            self._by_force = above > (cfg.off if held else cfg.on)

        # a sensor that contradicts clear torques for long is stuck; agreeing mends it, half as fast
        wrong = not came or (hangs if self._by_force else carries)
        self._doubt = min(max(self._doubt + (dt if wrong else -0.5 * dt), 0.0), 2.0 * cfg.stuck)
        self.stuck = self._doubt > (0.0 if self.stuck else cfg.stuck)
        self.contact = self._by_load if self.stuck or not came else self._by_force

        if came and hangs and not self.contact:
            zero = self._zero + above * min(1.0, dt / cfg.zero_time)
            self._zero = min(max(zero, -cfg.zero_limit), cfg.zero_limit)
        return self.contact


@dataclass(frozen=True)
class FallCfg:
    """When an estimate counts as lost.

    Attributes:
        time: for how long, in balance with the time in which all is well [s]; longer than any flight.
        clearance: of the body's lowest point from the ground, at most, while a foot carries load [m].
        depth: below the ground, at most [m].
    """

    time: float = 0.6
    clearance: float = 0.15
    depth: float = 0.1


class Fall:
    """Doubt in an estimate: it grows while no foot agrees with it, or while its body would float or sink."""

    def __init__(self, cfg: FallCfg):
        self.cfg = cfg
        self._doubt = 0.0

    def update(self, used: bool, contact: bool, lowest: float, dt: float) -> bool:
        """One tick; whether the estimate is lost.

        Args:
            used: whether a foot agreed with it.
            contact: whether a foot carries load.
            lowest: height of the body's lowest point above the ground by it [m]; 0 if that is not known.
            dt: since the tick before [s].
        """
        # what is no number is not above the ground either
        right = used and lowest >= -self.cfg.depth and not (contact and lowest > self.cfg.clearance)
        self._doubt = max(self._doubt + (-dt if right else dt), 0.0)
        return self._doubt > self.cfg.time
