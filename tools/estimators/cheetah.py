"""The linear Kalman filter of the MIT Cheetah, behind a complementary attitude filter.

G. Bledt et al., "MIT Cheetah 3: design and control of a robust, dynamic quadruped robot", IROS 2018:
position, velocity and feet, measured by the feet's places, their speeds and the ground's height. The attitude
comes from R. Mahony et al., "Nonlinear complementary filters on the special orthogonal group", TAC 2008, with
the accelerometer trusted near 1 g only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy import so3
from deploy.ekf import GRAVITY, Flags
from deploy.kinematics import FOOT_RADIUS, IMU
from deploy.so3 import Array, skew
from tools.estimators.reference import Frame


@dataclass(frozen=True)
class CheetahCfg:
    """Noise of the filter, published but for the speed's, and gains of the attitude filter.

    Attributes:
        p, v, foot: process noise, in the published scaling with dt.
        place, speed, height: of the measurements [m], [m/s], [m].
        suspect: how much less a foot in the air is believed, in variance.
        kp, ki: of the attitude filter [1/s], [1/s^2].
        band: departure from 1 g beyond which the accelerometer is not used [m/s^2].
    """

    p: float = 0.02
    v: float = 0.02
    foot: float = 0.002
    place: float = 0.001
    speed: float = 1.0
    height: float = 0.001
    suspect: float = 100.0
    kp: float = 1.0
    ki: float = 0.05
    band: float = 2.0


class Cheetah:
    """See the module; attributes as `tools.estimators.reference.Reference`."""

    def __init__(self, cfg: CheetahCfg | None = None):
        self.cfg = cfg or CheetahCfg()
        self.C, self.q = np.eye(3), np.array([1.0, 0.0, 0.0, 0.0])
        self.gyro_bias = np.zeros(3)
        self.x, self.P = np.zeros(18), 100.0 * np.eye(18)
        self.H = np.zeros((28, 18))
        for leg in range(4):
            at, foot = slice(3 * leg, 3 * leg + 3), slice(6 + 3 * leg, 9 + 3 * leg)
            self.H[at, :3], self.H[at, foot] = -np.eye(3), np.eye(3)
            self.H[12 + 3 * leg : 15 + 3 * leg, 3:6] = np.eye(3)
            self.H[24 + leg, 8 + 3 * leg] = 1.0

    @property
    def r(self) -> Array:
        return self.x[:3]

    @property
    def v(self) -> Array:
        return self.x[3:6]

    def start(self, C: Array, gyro: Array, r: Array, s: Array) -> None:
        up = np.array([0.0, 0.0, 1.0])
        self.q, self.C = so3.aligning(C[2], up), C
        self.x[:3], self.x[6:] = r, (r + s @ C.T).reshape(12)
        self.P = 1e-2 * np.eye(18)

    def step(self, frame: Frame, contact: Flags) -> None:
        cfg, dt = self.cfg, frame.dt
        self._turn(frame)
        C, w = self.C, frame.gyro - self.gyro_bias
        a = C @ frame.acc - np.array([0.0, 0.0, GRAVITY])
        F = np.eye(18)
        F[:3, 3:6] = dt * np.eye(3)
        self.x[:3] += dt * self.x[3:6] + 0.5 * dt * dt * a
        self.x[3:6] += dt * a
        doubt = np.where(contact, 1.0, cfg.suspect)
        Q = np.concatenate([np.full(3, cfg.p * dt / 20), np.full(3, cfg.v * dt * GRAVITY / 20)])
        Q = np.concatenate([Q, np.repeat(cfg.foot * dt * doubt, 3)])
        self.P = F @ self.P @ F.T + np.diag(Q)

        s = frame.leg.foot - IMU
        swing = s @ skew(w).T + (frame.leg.jacobian @ frame.qd[:, :, None])[:, :, 0]
        # a foot in the air: the speed is the filter's own, the height is where it is
        speed = np.where(contact[:, None], -swing @ C.T, self.x[3:6])
        height = np.where(contact, FOOT_RADIUS, self.x[2] + s @ C[2])
        z = np.concatenate([(s @ C.T).reshape(12), speed.reshape(12), height])
        noise = (np.repeat(cfg.place * doubt, 3), np.repeat(cfg.speed * doubt, 3), cfg.height * doubt)
        PHt = self.P @ self.H.T
        K = np.linalg.solve(self.H @ PHt + np.diag(np.concatenate(noise)), PHt.T).T
        self.x += K @ (z - self.H @ self.x)
        self.P -= K @ PHt.T
        self.P = 0.5 * (self.P + self.P.T)

    def _turn(self, frame: Frame) -> None:
        """The attitude filter: gyroscope, drawn to the accelerometer's vertical."""
        size = float(np.linalg.norm(frame.acc))
        error = np.zeros(3)
        if abs(size - GRAVITY) < self.cfg.band:
            error = np.cross(frame.acc / size, self.C[2])
        self.gyro_bias = self.gyro_bias - self.cfg.ki * error * frame.dt
        w = frame.gyro - self.gyro_bias + self.cfg.kp * error
        self.q = so3.multiply(self.q, so3.quaternion(w * frame.dt))
        self.C = so3.matrix(self.q)
