r"""How the estimator begins: gravity and velocity from a short stand that may sway, or from a body that lies.

With \Phi the rotation since the first reading, f the specific force and u the velocity that the feet tell,
seen from where the body was at the first reading,

.. math:: \Phi(t) u(t) - \int \Phi f\, dt = v_0 + g\, t

so that gravity is the slope of a line through what is measured, and the velocity is where the line ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from deploy import so3
from deploy.kinematics import FOOT_RADIUS, IMU, chains
from deploy.so3 import Array

_CORRELATED = 3  # readings that err together: a foot that slides does so for some ticks
_IMU = (float(IMU[0]), float(IMU[1]), float(IMU[2]))


@dataclass(frozen=True)
class StartCfg:
    """The stand at the start.

    Attributes:
        time: its length [s].
        speed: of a contact point, standard deviation [m/s]; also of a body without any that lies still.
        outlier: difference from the line beyond which the feet slide [m/s].
        rate: mean angular velocity, standard deviation [rad/s].
        acc: mean acceleration of the contact points, likewise [m/s^2].
        max_rate: mean angular speed beyond which the robot is not standing still [rad/s].
        max_acc: difference of the mean specific force from gravity, likewise [m/s^2].
    """

    time: float = 0.25
    speed: float = 0.03
    outlier: float = 0.15
    rate: float = 0.005
    acc: float = 0.07
    max_rate: float = 0.5
    max_acc: float = 2.0


@dataclass(frozen=True)
class Stood:
    """What a stand tells, in the body frame at its last reading.

    Attributes:
        force: specific force of a body at rest there, g upward [m/s^2], (3,).
        force_error: standard deviation of each of its components [m/s^2].
        velocity: of the IMU [m/s], (3,).
        velocity_error: likewise [m/s].
        rate: mean angular velocity [rad/s], (3,), and its variances [rad^2/s^2], (3,).
    """

    force: Array
    force_error: float
    velocity: Array
    velocity_error: float
    rate: Array
    rate_variance: Array


def foot_speed(
    q: list[float], qd: list[float], gyro: list[float], up: list[float], loaded: list[bool]
) -> Array:
    r"""Velocity of the IMU in the body frame by the feet that carry it [m/s], (3,); NaN without any.

    .. math:: u = -w \times s_i - J_i \dot q_i + \rho \, w_i \times C^T e_z, averaged

    Args:
        q, qd: joint angles [rad] and speeds [rad/s], 12.
        gyro: angular velocity [rad/s], 3.
        up: world z in the body frame, 3.
        loaded: which feet, 4.
    """
    out, (p, h, r) = [], gyro
    for i, chain in enumerate(chains(q)):
        if not loaded[i]:
            continue
        rates = qd[3 * i : 3 * i + 3]
        x, y, z = (a - b for a, b in zip(chain.foot, _IMU, strict=True))
        a, b, c = (sum(j * rate for j, rate in zip(row, rates, strict=True)) for row in chain.rows)
        d, e, f = (w + turn for w, turn in zip(gyro, chain.shank(*rates), strict=True))
        k, m, n = (FOOT_RADIUS * part for part in up)
        out.append(
            (
                r * y - h * z - a + e * n - f * m,
                p * z - r * x - b + f * k - d * n,
                h * x - p * y - c + d * m - e * k,
            )
        )
    return np.mean(out, 0) if out else np.full(3, np.nan)


class Start:
    """Collects readings until they make a stand.

    Args:
        cfg: settings.
        gyro: standard deviation of a gyroscope's reading [rad/s].
    """

    def __init__(self, cfg: StartCfg, gyro: float):
        self.cfg, self._noise = cfg, gyro
        self._begin()

    def _begin(self) -> None:
        self._t = 0.0
        self._turned, self._gained = np.eye(3), np.zeros(3)  # Phi, and the integral of Phi f
        self._rows: list[Array] = []  # t, the line's value, angular velocity

    def take(
        self, imu: Array, dt: float, q: list[float], qd: list[float], loaded: list[bool]
    ) -> Stood | None:
        """One reading; what the stand was, at its end.

        Args:
            imu: angular velocity [rad/s] and specific force [m/s^2], (6,).
            dt: since the last reading [s].
            q, qd: joint angles [rad] and speeds [rad/s], 12.
            loaded: feet that carry load, 4.
        """
        gyro, acc = imu[:3], imu[3:]
        self._t += dt
        first, _ = so3.carried(gyro * dt, acc)
        self._gained = self._gained + self._turned @ first * dt
        self._turned = self._turned @ so3.exp(gyro * dt)
        up = (acc / max(math.sqrt(float(acc @ acc)), 1e-9)).tolist()
        u = foot_speed(q, qd, gyro.tolist(), up, loaded)
        self._rows.append(np.concatenate([[self._t], self._turned @ u - self._gained, gyro, self._gained]))
        if self._t < self.cfg.time:
            return None
        stood = self._judge(np.array(self._rows))
        self._begin()
        return stood

    def _judge(self, rows: Array) -> Stood | None:
        """Fit the line; None if this was no stand."""
        cfg, (t, gyro) = self.cfg, (rows[:, 0], rows[:, 4:7])
        y, use = rows[:, 1:4], np.isfinite(rows[:, 1])
        if use.mean() < 0.5:  # nothing carries by its feet: it lies, and its velocity is 0
            y, use = -rows[:, 7:], np.ones(len(t), dtype=bool)
        error = cfg.speed
        for _ in range(3):
            if use.sum() < 0.5 * len(t):
                return None
            middle = t[use].mean()
            spread = float(((t[use] - middle) ** 2).sum())
            slope = (t[use] - middle) @ y[use] / spread
            line = y[use].mean(0) + np.outer(t - middle, slope)
            off = np.sqrt(((y - line) ** 2).sum(1))
            error = max(cfg.speed, float(np.sqrt(np.mean(off[use] ** 2) / 3.0)))
            use = off < cfg.outlier  # NaN is no less
        force, rate = -slope @ self._turned, gyro.mean(0)
        if np.linalg.norm(rate) > cfg.max_rate or abs(np.linalg.norm(force) - 9.81) > cfg.max_acc:
            return None
        white = self._noise**2
        # what turns more than noise is a stand that sways, slower than the mean could tell; a steady turn
        # does not vary, and is no bias either
        sway = 4.0 * np.maximum(gyro.var(0) - white, 0.0) + rate**2 + cfg.rate**2
        return Stood(
            force,
            math.sqrt(_CORRELATED * error**2 / spread + cfg.acc**2),
            (line[-1] + self._gained) @ self._turned,
            error * math.sqrt(1.0 + 4.0 * _CORRELATED / len(t)),
            rate,
            white / len(t) + sway,
        )
