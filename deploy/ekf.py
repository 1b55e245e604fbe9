r"""Error-state Kalman filter of a legged body: IMU in, feet on the ground as measurements.

Base: M. Bloesch et al., "State estimation for legged robots: consistent fusion of leg kinematics and IMU",
RSS 2012, with the rotation error taken in the world frame, feet that roll, give way and slide round, and the
ground's height.

========== ===== ======================================================== ============
state      error meaning                                                  unit
========== ===== ======================================================== ============
q          0:3   attitude of the body, C = C(q) turns body into world     rad
v          3:6   velocity of the IMU in the world frame                   m/s
r          6:9   position of the IMU in the world frame                   m
b_w        9:12  bias of the gyroscope                                    rad/s
b_f        12:15 bias of the accelerometer                                m/s^2
p[0..3]    15:27 centres of the foot spheres without load, world frame    m
c          27    compliance of a foot and the ground under it             m/N
l          28    how late the gyroscope reads                             s
y          29    rate at which the feet slide round the body              rad/s
========== ===== ======================================================== ============

The error of the attitude is the rotation vector phi with C = exp(phi) C_hat; all others are true minus
estimate. With the gyroscope's reading w_m, the accelerometer's f_m, w = w_m - b_w and f = f_m - b_f:

.. math::
    \dot C = C [w + l \dot w], \quad \dot v = C f + g, \quad \dot r = v, \quad
    \dot p_i = \rho \, (C w_i) \times e_z + y \, e_z \times (p_i - r)

where w_i is the angular velocity of shank i in the body frame and rho the radius of its foot: a foot that
rolls on level ground without slipping has its contact point at rest, not its centre. How late the gyroscope
is, is found out by what a swing leaves. Feet that are set down again and again slide round the body, or seem
to, for minutes on end: y keeps apart from the gyroscope's bias what would pass for it. The measurement of a
foot that stands, with s_i its centre by kinematics, seen from the IMU, and n_i the load that it has given way
to, is

.. math::
    0 = C s_i + r + c \, n_i e_z - p_i

The compliance is found out, too: the feet of a stance take the load in turns. Feet that do not stand are kept
out: their covariance is 1 m^2, uncorrelated.

**What nobody can know.** No reading tells heading and place, so that nothing must be learnt of them: an error
phi = e_z goes with errors e_z x v, e_z x r and e_z x p of the rest, a direction that moves with the estimate
(Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators",
IJRR 2010). The transition therefore takes v, r and p as the step changes them, a foot's Jacobian its arm as
p - r, and a correction turns with the error that was there, as in an invariant filter (Hartley et al., IJRR
2020). Else the filter is sure of its heading to a degree however long it has drifted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deploy import so3
from deploy.kinematics import FOOT_RADIUS
from deploy.noise import NoiseCfg
from deploy.so3 import Array, skew

Flags = NDArray[np.bool_]
Rows = Sequence[Sequence[float]]
N = 30
PHI, V, R, BW, BF = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
FEET, GIVE, LATE, SPIN = slice(15, 27), 27, 28, 29
_SOLES = slice(FEET.start + 2, FEET.stop, 3)  # heights of the feet
GRAVITY = 9.81
_ARM = 0.4  # m, from the IMU to a foot
_TINY = 1e-12
_I3 = np.eye(3)
_UP = skew(np.array([0.0, 0.0, 1.0]))
_FIRM = ((0.0, 0.0),) * 4
_STEADY = np.zeros(6)


def foot(leg: int) -> slice:
    """Where the error of a foot's position is."""
    return slice(15 + 3 * leg, 18 + 3 * leg)


def distance(S: list[list[float]], e: Sequence[float], at: int = 0) -> float:
    """Squared Mahalanobis distance e^T S^-1 e of entries at to at + 3, by Cholesky's decomposition.

    In plain numbers: one call of numpy takes as long as all of it.
    """
    second, third = S[at + 1], S[at + 2]
    b, d, c, f, g = second[at], second[at + 1], third[at], third[at + 1], third[at + 2]
    # rounding must not make a root of what is negative: such a foot is far off, and refused
    k = math.sqrt(max(S[at][at], _TINY))
    m, n = b / k, c / k
    o = math.sqrt(max(d - m * m, _TINY))
    p = (f - m * n) / o
    x = e[at] / k
    y = (e[at + 1] - m * x) / o
    z = e[at + 2] - n * x - p * y
    return x * x + y * y + z * z / max(g - n * n - p * p, _TINY)


class Ekf:
    """The filter's state and its two steps; `deploy.estimator.Estimator` decides what it is fed.

    Attributes:
        q: attitude (w, x, y, z), (4,); C its matrix, (3, 3).
        v, r, bw, bf, p: see the module; p is (4, 3).
        give, late, spin: c, l and y of the module.
        load: n of the module, 4 [N].
        P: covariance of the error, (30, 30).
        stands: which feet are anchored, (4,) bool.
        sway, far: how much each leg sways, 0 to 1, and how far it has turned lately [rad], 4 each
            (`deploy.sway`).
    """

    def __init__(self, cfg: NoiseCfg):
        self.cfg = cfg
        self.q = np.array([1.0, 0.0, 0.0, 0.0])
        self.C = np.eye(3)
        self.v, self.r, self.bw, self.bf = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
        self.p = np.zeros((4, 3))
        self.give = self.late = self.spin = 0.0
        self.stands = np.zeros(4, dtype=bool)
        self.load, self.sway, self.far = [0.0] * 4, [1.0] * 4, [0.0] * 4
        # rotation of each shank since its foot touched down [rad], and the most of it, squared
        self._turned = [(0.0, 0.0, 0.0, 0.0)] * 4
        self.P = np.eye(N)
        self._F, self._still, self._FP = np.eye(N), np.eye(N), np.empty((N, N))
        self._H: dict[tuple[int, ...], Array] = {}  # by the feet that an update takes
        self._carry, self._heights = np.zeros((N, 3)), np.eye(N)[R.stop - 1]
        self._legs: tuple[int, ...] = ()
        self._e, self._PHt, self._S = np.empty(0), np.empty(0), np.empty(0)

    def transition(self, dv: Array, dr: Array, roll: Rows, change: Array, dt: float) -> Array:
        """Jacobian of the error after a step by the error before it, (30, 30), to first order in dt.

        Args:
            dv, dr: what the specific force adds to velocity and place over the step [m/s], [m], (3,).
            roll: rotation of each shank in the world frame over the step [rad], 4 of 3.
            change: of the gyroscope's reading over the step [rad/s], (3,).
            dt: [s].
        """
        F, back = self._F, self.C * -dt
        F[PHI, BW] = F[V, BF] = back
        lag = self.C @ change
        F[PHI, LATE] = lag
        lag_x, lag_y, _ = (FOOT_RADIUS * lag).tolist()
        for at, (x, y, z) in ((3, dv.tolist()), (6, dr.tolist())):
            F[at, 1], F[at, 2], F[at + 1, 0] = z, -y, -z
            F[at + 1, 2], F[at + 2, 0], F[at + 2, 1] = x, y, -x
        F[6, 3] = F[7, 4] = F[8, 5] = dt
        F[SPIN, SPIN] = math.exp(-dt / self.cfg.spin_time)
        slide = max(self.sway) * dt
        spin, arms = slide * self.spin, (self.p - self.r).tolist()
        # the lever of a rolling foot is rho e_z: entry by entry, for most are zero
        lever = FOOT_RADIUS * back[1::-1]
        lever[1] *= -1.0
        for leg, stands in enumerate(self.stands.tolist()):
            at = 15 + 3 * leg
            if not stands:
                F[at : at + 2] = self._still[at : at + 2]
                continue
            x, y, z = roll[leg]
            F[at, 0] = F[at + 1, 1] = -FOOT_RADIUS * z
            F[at, 2], F[at + 1, 2] = FOOT_RADIUS * x, FOOT_RADIUS * y
            F[at : at + 2, BW] = lever
            F[at, LATE], F[at + 1, LATE] = lag_y, -lag_x
            F[at, SPIN], F[at + 1, SPIN] = -slide * arms[leg][1], slide * arms[leg][0]
            F[at, 7] = F[at + 1, at] = spin
            F[at, at + 1] = F[at + 1, 6] = -spin
        return F

    def predict(
        self,
        gyro: Array,
        acc: Array,
        turn: Rows,
        dt: float,
        gap: float = 0.0,
        jump: Array | None = None,
        loose: Rows = _FIRM,
        change: Array = _STEADY,
    ) -> None:
        """Move on by dt.

        Args:
            gyro, acc: readings over the step [rad/s], [m/s^2], (3,).
            turn: rotation of each shank relative to the base over the step, in the body frame [rad], 4 of 3.
            dt: [s].
            gap: how much of dt no reading covers, or for how long none has come [s].
            jump: difference of the readings before and after the gap, gyroscope's then accelerometer's, (6,):
                what lies between is known to about half of it.
            loose: what a foot's place walks beyond a standing foot's, variance per time [m^2/s], 4 of
                (horizontal, vertical).
            change: of the readings since the last step, gyroscope's then accelerometer's, (6,).
        """
        w, f = gyro - self.bw, acc - self.bf
        phi, dv, dr = self._motion(w, f, dt, change)
        roll = (phi + turn) @ self.C.T
        rows = roll.tolist()
        F = self.transition(dv, dr, rows, change[:3], dt)
        np.matmul(F, self.P, out=self._FP)
        P = np.matmul(self._FP, F.T)
        P += P.T
        P *= 0.5
        diagonal = P.reshape(-1)[:: N + 1]
        diagonal += self._walk(w, f, rows, dt, 0.5 * gap * dt, loose)
        if (size := math.sqrt(float(change[3:] @ change[3:]))) > self.cfg.shock:  # along it, not across
            doubt = self.cfg.sample * (1.0 - self.cfg.shock / size) * dt
            diagonal[V] += (doubt * (self.C @ change[3:])) ** 2
        # together they may rise by what no reading tells, so that velocity and tilt have no part in it
        self._heights[_SOLES] = self.stands
        P += (self.cfg.rise**2 * dt) * (self._heights[:, None] * self._heights)
        if jump is not None:
            diagonal[:6] += (0.5 * gap * jump) ** 2
        self.P = P

        for leg, stands in enumerate(self.stands.tolist()):
            if stands:
                (x, y, _), at = rows[leg], foot(leg).start
                self.p[leg, 0] += FOOT_RADIUS * y + self.spin * F[at, SPIN]
                self.p[leg, 1] -= FOOT_RADIUS * x - self.spin * F[at + 1, SPIN]
        self.spin *= float(F[SPIN, SPIN])
        self.r, self.v, self.q, self.C = self._moved(phi, dv, dr, dt)

    def ahead(self, gyro: Array, acc: Array, dt: float, change: Array) -> tuple[Array, Array, Array, Array]:
        """r, v, q and C as `predict` will leave them; arguments as there."""
        return self._moved(*self._motion(gyro - self.bw, acc - self.bf, dt, change), dt)

    def _motion(self, w: Array, f: Array, dt: float, change: Array) -> tuple[Array, Array, Array]:
        """What rate and specific force turn in the body frame, speed up and shift in the world, (3,) each."""
        phi = w * dt + self.late * change[:3]
        first, second = so3.carried(phi, f)
        return phi, self.C @ (dt * first), self.C @ (dt * dt * second)

    def _moved(self, phi: Array, dv: Array, dr: Array, dt: float) -> tuple[Array, Array, Array, Array]:
        """r, v, q and C after a step of `_motion`; dv and dr are used up."""
        dv[2] -= GRAVITY * dt
        dr[2] -= 0.5 * GRAVITY * dt * dt
        return self.r + dr + dt * self.v, self.v + dv, *so3.turned(self.q, phi)

    def _walk(self, w: Array, f: Array, roll: Rows, dt: float, hidden: float, loose: Rows) -> list[float]:
        """Diagonal of the step's noise, 30; `hidden` is the time [s^2] in which changes went unseen."""
        cfg = self.cfg
        shake = abs(math.sqrt(float(f @ f)) - GRAVITY)
        hidden *= max(self.sway)
        speed = (cfg.acc**2 + (cfg.acc_scale * shake) ** 2) * dt * dt + (cfg.jerk * hidden) ** 2
        angle = (cfg.gyro**2 + cfg.scale**2 * float(w @ w)) * dt * dt + (cfg.turn * hidden) ** 2
        place, gyro, acc = speed * dt * dt / 3.0, cfg.gyro_walk**2 * dt, cfg.acc_walk**2 * dt
        Q = [angle] * 3 + [speed] * 3 + [place] * 3 + [gyro] * 3 + [acc] * 3
        for leg, stands in enumerate(self.stands.tolist()):
            if not stands:
                Q += (0.0, 0.0, 0.0)
                continue
            (dx, dy, dz), (across, down), (x, y, z, most) = roll[leg], loose[leg], self._turned[leg]
            x, y, z = x + dx, y + dy, z + dz
            turned = max(most, x * x + y * y + z * z)
            self._turned[leg] = x, y, z, turned
            foot = cfg.foot**2 * dt + cfg.bend**2 * (turned - most)
            Q += (foot + across * dt, foot + across * dt, foot + down * dt)
        Q += (cfg.give_walk**2 * dt, 0.0, cfg.spin**2 * (1.0 - math.exp(-2.0 * dt / cfg.spin_time)))
        return Q

    def anchor(self, leg: int, s: Array) -> None:
        """A foot touches down: its position becomes what kinematics say.

        Args:
            leg: 0 to 3.
            s: foot centre from the IMU in the body frame [m], (3,).
        """
        self.release(leg)
        arm, load = self.C @ s, self.load[leg]
        self.p[leg] = self.r + arm
        self.p[leg, 2] += self.give * load
        # error of p: that of r, phi x C s, and what the load makes of the compliance
        rows = self.P[R] - skew(arm) @ self.P[PHI]
        rows[2] += load * self.P[GIVE]
        at, P = foot(leg), self.P
        P[at], P[:, at] = rows, rows.T
        block = rows[:, R] - rows[:, PHI] @ skew(arm).T
        block[:, 2] += load * rows[:, GIVE]
        P[at, at] = 0.5 * (block + block.T) + self._place_variance(leg) * _I3
        self.stands[leg], self._turned[leg] = True, (0.0, 0.0, 0.0, 0.0)

    def _place_variance(self, leg: int) -> float:
        """Of a foot's place by kinematics, along an axis [m^2].

        What is of second order in the tilt's error, (1/2) phi^2 s, would pass for knowledge of it.
        """
        tilt = float(self.P[0, 0] + self.P[1, 1])
        cfg = self.cfg
        sways = (cfg.kinematics * self.sway[leg]) ** 2 + (cfg.swing * self.far[leg]) ** 2
        place = cfg.encoder**2 + sways
        return place + 0.5 * (_ARM * tilt) ** 2

    def release(self, leg: int) -> None:
        """A foot lifts off, or cannot be trusted."""
        at = foot(leg)
        self.P[at], self.P[:, at] = 0.0, 0.0
        self.P[at, at] = _I3
        self.stands[leg] = False

    def innovation(self, legs: tuple[int, ...], s: Rows) -> list[float]:
        """What kinematics say of some anchored feet against what the filter does.

        Args:
            legs: which.
            s: centres of all feet from the IMU in the body frame [m], 4 of 3.

        Returns:
            Squared Mahalanobis distance of each foot's residual 0 - (C s_i + r - p_i).
        """
        e: list[float] = []
        n, H = len(legs), self._rows(legs)
        C, r, p = self.C.tolist(), self.r.tolist(), self.p.tolist()
        for k, leg in enumerate(legs):
            x, y, z = so3.rotated(C, s[leg])
            q, load = p[leg], self.load[leg]
            a, b, c = q[0] - r[0], q[1] - r[1], q[2] - r[2] - self.give * load
            e += (a - x, b - y, c - z)
            H[3 * k + 2, GIVE] = load
            H[3 * k, 1], H[3 * k, 2], H[3 * k + 1, 0] = c, -b, -c
            H[3 * k + 1, 2], H[3 * k + 2, 0], H[3 * k + 2, 1] = a, b, -a
        e += [FOOT_RADIUS - p[leg][2] for leg in legs]
        PHt = self.P @ H.T
        S = H @ PHt
        diagonal = S.reshape(-1)[:: 4 * n + 1]
        for k, leg in enumerate(legs):
            diagonal[3 * k : 3 * k + 3] += self._place_variance(leg)
        self._legs, self._e, self._PHt, self._S = legs, np.array(e), PHt, S
        cells = S.tolist()
        return [distance(cells, e, 3 * k) for k in range(n)]

    def _rows(self, legs: tuple[int, ...]) -> Array:
        """Jacobian of the residuals of some feet, (4 n, 30): places first, then heights."""
        if legs not in self._H:
            n = len(legs)
            H = np.zeros((4 * n, N))
            for k, leg in enumerate(legs):
                H[3 * k : 3 * k + 3, R], H[3 * k : 3 * k + 3, foot(leg)] = _I3, -_I3
                H[3 * n + k, foot(leg).stop - 1] = 1.0
            self._H[legs] = H
        return self._H[legs]

    def correct(self, ground: float | None) -> None:
        """One update with the last innovation.

        Args:
            ground: variance of the ground's height under a foot in this update [m^2]; None: unknown.
        """
        n = len(self._legs)
        rows = 3 * n if ground is None else 4 * n
        S = self._S[:rows, :rows]
        if ground is not None:
            S.reshape(-1)[:: rows + 1][3 * n :] += ground
        self._update(self._e[:rows], self._PHt[:, :rows], S)

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
        self._update(acc - self.bf - up, PHt, H @ PHt + np.diag(noise))

    def observe_rate(self, gyro: Array, noise: Array) -> None:
        """One update with the mean angular velocity of a body that stands still: gyro = b_w."""
        H = np.zeros((3, N))
        H[:, BW] = _I3
        PHt = self.P @ H.T
        self._update(gyro - self.bw, PHt, H @ PHt + np.diag(noise))

    def observe_rest(self, variance: float) -> None:
        """One update with a velocity of 0, of such a variance [m^2/s^2]."""
        self._update(-self.v, self.P[:, V], self.P[V, V] + variance * _I3)

    def _update(self, e: Array, PHt: Array, S: Array) -> None:
        """Kalman update with residual e = H error + noise, whose covariance is S = H P H^T + noise."""
        K = np.linalg.solve(S, PHt.T).T
        # equal to Joseph's form for this K; what rounding leaves of asymmetry, `predict` takes out
        self.P = self.P - K @ PHt.T
        d = K @ e
        self.q, self.C = so3.turned(self.q, d[PHI], world=True)
        self.v, self.r = self.v + d[V], self.r + d[R]
        self.bw, self.bf = self.bw + d[BW], self.bf + d[BF]
        self.p += d[FEET].reshape(4, 3)
        self.give += float(d[GIVE])
        self.late += float(d[LATE])
        self.spin += float(d[SPIN])
        # an error phi that was there turns what was added to v, r and p
        turned = so3.skew(-d.reshape(-1, 3))
        carry, P = self._carry, self.P
        carry[3:9], carry[FEET] = turned[1:3].reshape(6, 3), turned[5:9].reshape(12, 3)
        P = P + carry @ P[PHI]
        self.P = P + P[:, PHI] @ carry.T
