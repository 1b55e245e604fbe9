"""The contact-aided right-invariant extended Kalman filter.

R. Hartley, M. Ghaffari, R. Eustice, J. Grizzle, "Contact-aided invariant extended Kalman filtering for robot
state estimation", IJRR 2020: equations 35 (error dynamics with biases), 24 (forward kinematics) and section
6 (contacts that come and go).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy import so3
from deploy.ekf import GRAVITY, Flags
from deploy.kinematics import IMU
from deploy.so3 import Array, skew
from tools.estimators.reference import Frame

N = 27  # R, v, r, four feet, gyroscope's and accelerometer's bias


@dataclass(frozen=True)
class InvariantCfg:
    """Noise; readings are of 500 Hz.

    Attributes:
        gyro, acc: of a reading [rad/s], [m/s^2].
        gyro_walk, acc_walk: of the biases [rad/s/sqrt(s)], [m/s^2/sqrt(s)].
        gyro_bias, acc_bias: of the biases at the start [rad/s], [m/s^2].
        contact: of a standing foot's random walk [m/sqrt(s)].
        joint: of the joint angles in the kinematics [rad].
    """

    gyro: float = 0.01
    acc: float = 0.1
    gyro_walk: float = 1e-4
    acc_walk: float = 1e-3
    gyro_bias: float = 0.003
    acc_bias: float = 0.03
    contact: float = 0.0015
    joint: float = 0.002


class Invariant:
    """See the module; attributes as `tools.estimators.reference.Reference`."""

    def __init__(self, cfg: InvariantCfg | None = None):
        self.cfg = cfg or InvariantCfg()
        self.C, self.v, self.r, self.d = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((4, 3))
        self.gyro_bias, self.acc_bias = np.zeros(3), np.zeros(3)
        self.P, self.stands = np.eye(N), np.zeros(4, dtype=bool)

    def start(self, C: Array, gyro: Array, r: Array, s: Array) -> None:
        cfg = self.cfg
        tilt = (cfg.acc_bias + 0.1) / GRAVITY
        self.C, self.r = C, r
        spread = [tilt, tilt, 1e-4, 0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4, *[1.0] * 12]
        spread += [cfg.gyro_bias] * 3 + [cfg.acc_bias] * 3
        self.P = np.diag(np.square(spread))

    def step(self, frame: Frame, contact: Flags) -> None:
        self._propagate(frame)
        s = frame.leg.foot - IMU
        for leg in range(4):
            at, C = slice(9 + 3 * leg, 12 + 3 * leg), self.C  # which the foot before has turned
            spread = C @ frame.leg.jacobian[leg]
            noise = self.cfg.joint**2 * spread @ spread.T + 1e-8 * np.eye(3)
            if contact[leg] and not self.stands[leg]:
                self.d[leg] = self.r + C @ s[leg]
                rows = self.P[6:9].copy()  # the error of d is that of r, and the kinematics'
                self.P[at], self.P[:, at] = rows, rows.T
                self.P[at, at] = rows[:, 6:9] + noise
            elif contact[leg]:
                H = np.zeros((3, N))
                H[:, 6:9], H[:, at] = -np.eye(3), np.eye(3)
                self._update(H, C @ s[leg] + self.r - self.d[leg], noise)
            elif self.stands[leg]:
                self.P[at], self.P[:, at], self.P[at, at] = 0.0, 0.0, np.eye(3)
        self.stands = contact.copy()

    def _propagate(self, frame: Frame) -> None:
        cfg, dt, C = self.cfg, frame.dt, self.C
        w, f = frame.gyro - self.gyro_bias, frame.acc - self.acc_bias
        g = np.array([0.0, 0.0, -GRAVITY])
        A, adjoint = np.zeros((N, N)), np.zeros((21, 12))
        A[3:6, :3], A[6:9, 3:6] = skew(g), np.eye(3)
        A[:3, 21:24], A[3:6, 24:] = -C, -C
        A[3:6, 21:24], A[6:9, 21:24] = -skew(self.v) @ C, -skew(self.r) @ C
        standing = np.flatnonzero(self.stands)
        for leg in standing:
            A[9 + 3 * leg : 12 + 3 * leg, 21:24] = -skew(self.d[leg]) @ C
        # noise of the gyroscope reaches whatever the rotation moves, as its bias does
        adjoint[:, :3], adjoint[3:6, 3:6] = A[:21, 21:24], C
        F = np.eye(N) + A * dt
        Q = np.zeros((N, N))
        Q[:21, :21] = (cfg.gyro * dt) ** 2 * adjoint[:, :3] @ adjoint[:, :3].T
        Q[3:6, 3:6] += (cfg.acc * dt) ** 2 * np.eye(3)
        for leg in standing:
            at = slice(9 + 3 * leg, 12 + 3 * leg)
            Q[at, at] += cfg.contact**2 * dt * np.eye(3)
        Q[21:24, 21:24], Q[24:, 24:] = cfg.gyro_walk**2 * dt * np.eye(3), cfg.acc_walk**2 * dt * np.eye(3)
        self.P = F @ self.P @ F.T + Q
        first, second = so3.integrals(w * dt)
        self.r = self.r + self.v * dt + (C @ second @ f + 0.5 * g) * dt * dt
        self.v = self.v + (C @ first @ f + g) * dt
        self.C = C @ so3.exp(w * dt)

    def _update(self, H: Array, e: Array, noise: Array) -> None:
        """Residual e = C s + r - d, linear in the right-invariant error of the estimate."""
        PHt = self.P @ H.T
        K = np.linalg.solve(H @ PHt + noise, PHt.T).T
        xi = K @ e
        A = np.eye(N) - K @ H
        self.P = A @ self.P @ A.T + K @ noise @ K.T
        turn, (left, _) = so3.exp(xi[:3]), so3.integrals(xi[:3])
        self.C = turn @ self.C
        self.v = turn @ self.v + left @ xi[3:6]
        self.r = turn @ self.r + left @ xi[6:9]
        self.d = self.d @ turn.T + xi[9:21].reshape(4, 3) @ left.T
        self.gyro_bias, self.acc_bias = self.gyro_bias + xi[21:24], self.acc_bias + xi[24:]
