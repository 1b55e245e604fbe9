"""Which feet carry load: foot force sensors, and joint torques where a sensor is stuck."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.so3 import Array


@dataclass(frozen=True)
class ContactCfg:
    """Thresholds of contact.

    Sources: 20 counts is what published Go2 estimators take; a hysteresis follows Leg-KILO's on the Go2.

    Attributes:
        on: force reading above its zero at which a foot begins to carry [counts, about 1 N].
        off: below which it ends, likewise.
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


class ContactDetector:
    """Hysteresis on each foot's force, its zero tracked, and on its joint torques as the fallback.

    Attributes:
        contact: which feet carry load, (4,) bool.
        stuck: whose sensors are not believed, (4,) bool.
    """

    def __init__(self, cfg: ContactCfg):
        self.cfg = cfg
        self.contact = np.zeros(4, dtype=bool)
        self.stuck = np.zeros(4, dtype=bool)
        self._by_force = np.zeros(4, dtype=bool)
        self._by_load = np.zeros(4, dtype=bool)
        self._zero = np.zeros(4)
        self._doubt = np.zeros(4)

    def update(self, force: Array, load: Array, dt: float) -> None:
        """One tick.

        Args:
            force: sensor readings [counts], (4,); NaN: none came.
            load: normal force by joint torques [N], (4,); NaN: unknown.
            dt: since the tick before [s].
        """
        cfg = self.cfg
        came = np.isfinite(force)
        above = np.where(came, force - self._zero, 0.0)
        self._by_force = np.where(came, above > np.where(self._by_force, cfg.off, cfg.on), self._by_force)
        known = np.isfinite(load)
        load = np.where(known, load, 0.0)
        carries, hangs = known & (load > cfg.load_on), known & (load < cfg.load_off)
        self._by_load = carries | (self._by_load & ~hangs)

        # a sensor that contradicts clear torques for long is stuck; agreeing as long mends it
        wrong = (carries & ~self._by_force) | (hangs & self._by_force) | ~came
        self._doubt = np.clip(self._doubt + np.where(wrong, dt, -0.5 * dt), 0.0, 2.0 * cfg.stuck)
        self.stuck = np.where(self.stuck, self._doubt > 0.0, self._doubt > cfg.stuck)
        self.contact = np.where(self.stuck | ~came, self._by_load, self._by_force)

        idle = came & hangs & ~self.contact
        share = np.where(idle, min(1.0, dt / cfg.zero_time), 0.0)
        self._zero = np.clip(self._zero + share * above, -cfg.zero_limit, cfg.zero_limit)


def normal_load(jacobian: Array, tau: Array, up: Array) -> Array:
    r"""Normal force of the ground on each foot by its joint torques, inertia left out [N], (4,).

    .. math:: f = -J^{-T} \tau, \quad n = e_z^T C f

    Args:
        jacobian: of the feet [m/rad], (4, 3, 3).
        tau: joint torques [N m], (12,).
        up: world z in the body frame, (3,).
    """
    force = np.linalg.solve(jacobian.transpose(0, 2, 1), -tau.reshape(4, 3, 1))
    return np.asarray(force[:, :, 0] @ up)
