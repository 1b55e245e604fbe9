r"""Error-state Kalman filter of a legged body: IMU in, feet on the ground as measurements.

Base: M. Bloesch et al., "State estimation for legged robots: consistent fusion of leg kinematics and IMU",
RSS 2012, with the rotation error taken in the world frame, feet that roll, and the ground's height.

========== ===== ======================================================== ============
state      error meaning                                                  unit
========== ===== ======================================================== ============
q          0:3   attitude of the body, C = C(q) turns body into world     rad
v          3:6   velocity of the IMU in the world frame                   m/s
r          6:9   position of the IMU in the world frame                   m
b_w        9:12  bias of the gyroscope                                    rad/s
b_f        12:15 bias of the accelerometer                                m/s^2
p[0..3]    15:27 centres of the four foot spheres in the world frame      m
========== ===== ======================================================== ============

The error of the attitude is the rotation vector phi with C = exp(phi) C_hat; all others are true minus
estimate. With the gyroscope's reading w_m, the accelerometer's f_m, w = w_m - b_w and f = f_m - b_f:

.. math::
    \dot C = C [w], \quad \dot v = C f + g, \quad \dot r = v, \quad
    \dot p_i = \rho \, (C w_i) \times e_z

where w_i is the angular velocity of shank i in the body frame and rho the radius of its foot: a foot that
rolls on level ground without slipping has its contact point at rest, not its centre. The measurement of a
foot that stands, with s_i its centre by kinematics, seen from the IMU, is

.. math::
    0 = C s_i + r - p_i

Feet that do not stand are kept out: their covariance is 1 m^2, uncorrelated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deploy import so3
from deploy.kinematics import FOOT_RADIUS
from deploy.so3 import Array, skew

Flags = NDArray[np.bool_]
N = 27
PHI, V, R, BW, BF = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
GRAVITY = 9.81
_I3 = np.eye(3)
_DIAGONAL = np.arange(N)
_UP = skew(np.array([0.0, 0.0, 1.0]))
_ROLL = FOOT_RADIUS * _UP  # rows w to rho w x e_z
_ROWS = np.array([[3 * leg, 3 * leg + 1, 3 * leg + 2, 12 + leg] for leg in range(4)])


def foot(leg: int) -> slice:
    """Where the error of a foot's position is."""
    return slice(15 + 3 * leg, 18 + 3 * leg)


@dataclass(frozen=True)
class NoiseCfg:
    """Standard deviations, all of them of one axis.

    Those of readings are the simulated sensors'. Walks of the biases are half as large again as theirs, and
    those of the feet were chosen so that the errors are as large as the filter says (docs/estimator.md).

    Attributes:
        gyro: of a reading [rad/s].
        acc: of a reading [m/s^2].
        scale: of a reading, relative to what it reads beyond rest: coning, timing, scale factors.
        gyro_walk: of the gyroscope's bias [rad/s/sqrt(s)].
        acc_walk: of the accelerometer's bias [m/s^2/sqrt(s)].
        gyro_bias: of the gyroscope's bias before the first reading [rad/s].
        acc_bias: of the accelerometer's, likewise [m/s^2].
        turn: of the angular acceleration that a gap between readings hides [rad/s^2].
        jerk: of the change of acceleration that it hides [m/s^3].
        foot: of a standing foot's random walk [m/sqrt(s)]: yielding ground, creep.
        roll: of the walk that comes with the shank's turning [m/sqrt(rad)]: wrong links and joint zeros,
            feet that are not quite spheres.
        joint: of a joint angle that changes from reading to reading [rad].
        kinematics: of a foot's place by kinematics, likewise [m].
        ground: of the ground's height at a foothold [m].
        ground_time: for how long its errors stay the same [s].
    """

    gyro: float = 0.01
    acc: float = 0.1
    scale: float = 0.01
    gyro_walk: float = 1.5e-4
    acc_walk: float = 1.5e-3
    gyro_bias: float = 0.003
    acc_bias: float = 0.03
    turn: float = 20.0
    jerk: float = 100.0
    foot: float = 0.0015
    roll: float = 0.0045
    joint: float = 0.002
    kinematics: float = 0.0005
    ground: float = 0.01
    ground_time: float = 1.0


class Ekf:
    """The filter's state and its two steps; `deploy.estimator.Estimator` decides what it is fed.

    Attributes:
        q: attitude (w, x, y, z), (4,); C its matrix, (3, 3).
        v, r, bw, bf, p: see the module; p is (4, 3).
        P: covariance of the error, (27, 27).
        stands: which feet are anchored, (4,) bool.
    """

    def __init__(self, cfg: NoiseCfg):
        self.cfg = cfg
        self.q = np.array([1.0, 0.0, 0.0, 0.0])
        self.C = np.eye(3)
        self.v, self.r, self.bw, self.bf = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
        self.p = np.zeros((4, 3))
        self.stands = np.zeros(4, dtype=bool)
        self.P = np.eye(N)
        self._F, self._Q = np.eye(N), np.zeros(N)
        # residuals: rows 3 i of foot i's place, then the heights of the four
        self._e, self._H = np.zeros(16), np.zeros((16, N))
        self._PHt, self._S = np.zeros((N, 16)), np.zeros((16, 16))
        for leg in range(4):
            self._H[3 * leg : 3 * leg + 3, R] = _I3
            self._H[3 * leg : 3 * leg + 3, foot(leg)] = -_I3
            self._H[12 + leg, foot(leg).stop - 1] = 1.0

    def transition(self, w: Array, f: Array, roll: Array, dt: float) -> Array:
        """Jacobian of the error after a step by the error before it, (27, 27), to first order in dt.

        Args:
            w, f: angular velocity [rad/s] and specific force [m/s^2] without their biases, (3,).
            roll: rotation of each shank in the world frame over the step [rad], (4, 3).
            dt: [s].
        """
        F, C = self._F, self.C
        push = skew(C @ (f * dt))
        F[PHI, BW] = -dt * C
        F[V, PHI], F[R, PHI] = -push, (-0.5 * dt) * push
        F[V, BF], F[R, BF] = -dt * C, (-0.5 * dt * dt) * C
        F[R, V] = dt * _I3
        lift = FOOT_RADIUS * self.stands[:, None, None] * _UP
        F[15:, PHI] = (lift @ skew(roll)).reshape(12, 3)
        F[15:, BW] = (lift @ (dt * C)).reshape(12, 3)
        return F

    def predict(self, gyro: Array, acc: Array, turn: Array, dt: float, gap: float = 0.0) -> None:
        """Move on by dt.

        Args:
            gyro, acc: readings over the step [rad/s], [m/s^2], (3,).
            turn: rotation of each shank relative to the base over the step, in the body frame [rad], (4, 3).
            dt: [s].
            gap: how much of dt no reading covers [s].
        """
        w, f = gyro - self.bw, acc - self.bf
        phi = w * dt
        roll = (turn + phi) @ self.C.T
        F = self.transition(w, f, roll, dt)
        cfg, Q = self.cfg, self._Q
        hidden = 0.5 * gap * dt
        shake = abs(math.sqrt(float(f @ f)) - GRAVITY)
        Q[PHI] = (cfg.gyro**2 + cfg.scale**2 * float(w @ w)) * dt * dt + (cfg.turn * hidden) ** 2
        Q[V] = (cfg.acc**2 + (cfg.scale * shake) ** 2) * dt * dt + (cfg.jerk * hidden) ** 2
        Q[R] = Q[3] * dt * dt / 3.0
        Q[BW], Q[BF] = cfg.gyro_walk**2 * dt, cfg.acc_walk**2 * dt
        rolled = np.sqrt((roll * roll).sum(1))
        Q[15:].reshape(4, 3)[:] = (self.stands * (cfg.foot**2 * dt + cfg.roll**2 * rolled))[:, None]
        P = F @ self.P @ F.T
        self.P = 0.5 * (P + P.T)
        self.P[_DIAGONAL, _DIAGONAL] += Q

        first, second = so3.integrals(phi)
        self.r = self.r + self.v * dt + self.C @ (second @ f) * (dt * dt)
        self.r[2] -= 0.5 * GRAVITY * dt * dt
        self.v = self.v + self.C @ (first @ f) * dt
        self.v[2] -= GRAVITY * dt
        self.p += self.stands[:, None] * (roll @ _ROLL)
        self.q = so3.multiply(self.q, so3.quaternion(phi))
        self.C = so3.matrix(self.q)

    def anchor(self, leg: int, s: Array, noise: Array) -> None:
        """A foot touches down: its position becomes what kinematics say.

        Args:
            leg: 0 to 3.
            s: foot centre from the IMU in the body frame [m], (3,).
            noise: covariance of C s [m^2], (3, 3).
        """
        self.release(leg)
        arm = self.C @ s
        self.p[leg] = self.r + arm
        # error of p: that of r, and phi x C s
        rows = self.P[R] - skew(arm) @ self.P[PHI]
        at, P = foot(leg), self.P
        P[at], P[:, at] = rows, rows.T
        block = rows[:, R] - rows[:, PHI] @ skew(arm).T
        P[at, at] = 0.5 * (block + block.T) + noise
        self.stands[leg] = True

    def release(self, leg: int) -> None:
        """A foot lifts off, or cannot be trusted."""
        at = foot(leg)
        self.P[at], self.P[:, at] = 0.0, 0.0
        self.P[at, at] = _I3
        self.stands[leg] = False

    def innovation(self, s: Array, noise: Array) -> tuple[Array, Array]:
        """What kinematics say of the anchored feet against what the filter does.

        Args:
            s: foot centres from the IMU in the body frame [m], (4, 3).
            noise: their covariances in the world frame [m^2], (4, 3, 3).

        Returns:
            Residual 0 - (C s_i + r - p_i) of each foot [m], (4, 3), and its covariance [m^2], (4, 3, 3).
        """
        arm = s @ self.C.T
        self._e[:12] = (self.p - self.r - arm).reshape(12)
        self._e[12:] = FOOT_RADIUS - self.p[:, 2]
        self._H[:12, PHI] = skew(-arm).reshape(12, 3)
        np.matmul(self.P, self._H.T, out=self._PHt)
        np.matmul(self._H, self._PHt, out=self._S)
        blocks: Array = np.einsum("iaib->iab", self._S[:12, :12].reshape(4, 3, 4, 3))  # a view
        blocks += noise
        return self._e[:12].reshape(4, 3), blocks

    def correct(self, used: Flags, ground: float | None) -> None:
        """One update with the last innovation of some feet.

        Args:
            used: which, (4,) bool.
            ground: variance of the ground's height under a foot in this update [m^2]; None: unknown.
        """
        legs = np.flatnonzero(used)
        rows = _ROWS[legs, : 3 if ground is None else 4].reshape(-1)
        if ground is not None:
            self._S.reshape(-1)[12 * 17 :: 17] += ground  # on the diagonal
        S = self._S[rows[:, None], rows]
        self._update(self._e[rows], self._H[rows], self._PHt[:, rows], S)

    def observe_force(self, acc: Array, noise: Array) -> None:
        """One update with the mean specific force of a body that stands still: acc = b_f - C^T g.

        Args:
            acc: [m/s^2], (3,).
            noise: its variances [m^2/s^4], (3,).
        """
        up = self.C[2] * GRAVITY
        H = np.zeros((3, N))
        H[:, PHI] = self.C.T @ (GRAVITY * _UP)
        H[:, BF] = _I3
        PHt = self.P @ H.T
        self._update(acc - self.bf - up, H, PHt, H @ PHt + np.diag(noise))

    def observe_rate(self, gyro: Array, noise: Array) -> None:
        """One update with the mean angular velocity of a body that stands still: gyro = b_w."""
        H = np.zeros((3, N))
        H[:, BW] = _I3
        PHt = self.P @ H.T
        self._update(gyro - self.bw, H, PHt, H @ PHt + np.diag(noise))

    def _update(self, e: Array, H: Array, PHt: Array, S: Array) -> None:
        """Kalman update with residual e = H error + noise, whose covariance is S = H P H^T + noise."""
        K = np.linalg.solve(S, PHt.T).T
        # equal to Joseph's form for this K; what rounding leaves of asymmetry, `predict` takes out
        self.P = self.P - K @ PHt.T
        d = K @ e
        self.q = so3.multiply(so3.quaternion(d[PHI]), self.q)
        self.C = so3.matrix(self.q)
        self.v, self.r = self.v + d[V], self.r + d[R]
        self.bw, self.bf = self.bw + d[BW], self.bf + d[BF]
        self.p += d[15:].reshape(4, 3)
