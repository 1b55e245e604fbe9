"""How much each leg has turned lately: what kinematics and ground hide goes by it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from deploy.noise import NoiseCfg


class Sway:
    r"""Follows the joints and the body; a leg counts as swaying until it has been still for a while.

    With a the angles and T `NoiseCfg.sway_time`, what they have turned lately is a leaky sum, which the noise
    of a gyroscope and the steps of an encoder hardly reach; it counts by its square, so that a stand that
    settles does so least:

    .. math:: s \leftarrow e^{-dt / T} s + \Delta a

    Args:
        cfg: the angle from which on a leg sways as much as any, and the times.
        period: of the readings [s]; a gap is no longer time of stillness than that.

    Attributes:
        legs: how much each leg sways, 0 to 1, 4.
        far: how far each leg, or the body, has turned lately [rad], 4.
    """

    def __init__(self, cfg: NoiseCfg, period: float):
        self._cfg, self._period = cfg, period
        self._turned = [0.0] * 15  # joints and body [rad]
        self.legs, self.far = [1.0] * 4, [0.0] * 4

    def update(self, turned: Sequence[float], rate: Sequence[float], dt: float) -> None:
        """Take a step; one without numbers, as the first is, tells nothing.

        Args:
            turned: how far each joint turned [rad], 12.
            rate: angular velocity of the body [rad/s], 3.
            dt: [s].
        """
        step = [*turned, *(w * dt for w in rate)]
        if not math.isfinite(sum(step) + dt):
            return
        cfg = self._cfg
        keep = math.exp(-dt / cfg.sway_time)
        s = self._turned = [keep * a + b for a, b in zip(self._turned, step, strict=True)]
        fade = math.exp(-min(dt, self._period) / cfg.calm_time)
        low, high = min(s[12:]), max(s[12:])
        for i in range(4):
            joints = s[3 * i : 3 * i + 3]
            far = max(high, -low, max(joints), -min(joints))
            self.far[i] = max(far, fade * self.far[i])
            self.legs[i] = max(min(1.0, (far / cfg.sway) ** 2), fade * self.legs[i])
