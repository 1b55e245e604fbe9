"""The robot's state from its own sensors, tick by tick: contacts, gates, faults, and the ekf."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from deploy import so3
from deploy.contact import ContactCfg, Fall, FallCfg, FootContact
from deploy.ekf import BF, BW, GIVE, GRAVITY, LATE, PHI, SPIN, Ekf, Flags, R, V, distance
from deploy.estimate import Estimate
from deploy.footing import Footing, FootingCfg
from deploy.kinematics import FOOT_RADIUS, IMU, Chain, Vector, chains, lowest
from deploy.noise import NoiseCfg
from deploy.so3 import Array
from deploy.start import Start, StartCfg
from deploy.sway import Sway

_I3 = np.eye(3)
_UP = np.array([0.0, 0.0, 1.0])
_IMU = (float(IMU[0]), float(IMU[1]), float(IMU[2]))
_LYING = 0.03  # m, of the height of a body that lies: its outline is not all that well known
_CALM_RATE, _CALM_ACC = 0.1, 0.6  # rad/s, m/s^2: several times the noise of a reading
_SELDOM = 10  # ticks from one look at the body's height to the next
_ARM = 0.3  # m, of a joint about the foot: a stance's leg is between 0.2 and 0.42 long


@dataclass(frozen=True)
class EstimatorCfg:
    """Settings of the estimator.

    Attributes:
        noise: standard deviations.
        contact: contact detection.
        footing: how feet with contact move.
        start: the stand at the start.
        fall: when the estimate counts as lost.
        flat: whether all footholds are at height 0, which keeps the height from drifting.
        period: of the readings [s]; longer steps have a gap that no reading covers.
        max_gap: without readings for longer, the estimator starts anew [s].
        gate: squared Mahalanobis distance beyond which a foot's place is an outlier; chi-square with 3
            degrees of freedom passes 99.9 % at 16.3.
        slip_gate: the same for the speed of a foot's contact point.
        slip: speed at which the contact point of a standing foot may move, standard deviation [m/s].
        joint_speed: standard deviation of a reading [rad/s].
        patience: a foot left out for longer loses its anchor [s].
        lost: when all feet with contact are left out for this long, the velocity counts as lost [s].
        lost_speed: standard deviation added to it then [m/s].
        rest: a body that neither turns nor accelerates for so long, without a foot on the ground, lies [s].
        rest_speed: of such a body, standard deviation [m/s].
        max_gyro: range of the gyroscope, 2000 deg/s [rad/s].
        max_acc: range of the accelerometer, 16 g [m/s^2].
    """

    noise: NoiseCfg = field(default_factory=NoiseCfg)
    contact: ContactCfg = field(default_factory=ContactCfg)
    footing: FootingCfg = field(default_factory=FootingCfg)
    start: StartCfg = field(default_factory=StartCfg)
    fall: FallCfg = field(default_factory=FallCfg)
    flat: bool = True
    period: float = 0.002
    max_gap: float = 0.5
    gate: float = 16.3
    slip_gate: float = 16.3
    slip: float = 0.035
    joint_speed: float = 0.05
    patience: float = 0.01
    lost: float = 0.05
    lost_speed: float = 0.5
    rest: float = 0.2
    rest_speed: float = 0.03
    max_gyro: float = 35.0
    max_acc: float = 157.0


class Estimator:
    """Body state of the Go2 from IMU, joint encoders, joint torques and foot forces.

    It begins with a stand at any attitude, on two feet or four, or with a body that lies still: they give
    gravity direction, velocity, height and the gyroscope's bias, with honest covariances (`deploy.start`).
    The heading there is 0, and x and y are 0. After a fall that it cannot follow it begins anew by itself.

    Args:
        cfg: settings.

    Attributes:
        ekf: the Kalman ekf.
        detectors: contact detection of each foot.
        contact: what it says, (4,) bool.
        falls: how often the estimate was lost and begun anew.
        anew: time of the readings after which it was told to begin anew [s]; -inf: never.
    """

    def __init__(self, cfg: EstimatorCfg | None = None):
        self.cfg = cfg or EstimatorCfg()
        self.falls, self.anew = 0, -math.inf
        self._forget()

    def reset(self) -> None:
        """Forget everything; the next readings must come from a still stand."""
        self.anew = self._t
        self._forget()

    def _forget(self) -> None:
        self.ekf = Ekf(self.cfg.noise)
        self.detectors = [FootContact(self.cfg.contact) for _ in range(4)]
        self.contact, self._carried = np.zeros(4, dtype=bool), False
        self._t = self._good = -math.inf  # of the last tick, of the last with an IMU
        self._start = Start(self.cfg.start, self.cfg.noise.gyro)
        self._sway = Sway(self.cfg.noise, self.cfg.period)
        self._imu = np.full(6, np.nan)  # of the last good tick
        self._q, self._qd = [math.nan] * 12, [0.0] * 12
        self._refused = [0.0] * 4  # for how long each foot has been left out [s]
        self._lost = self._calm = 0.0
        self._footing = [Footing(self.cfg.footing) for _ in range(4)]
        self._fall, self._ticks, self._lowest = Fall(self.cfg.fall), 0, 0.0
        self._ready = False
        self._estimate: Estimate | None = None

    def update(
        self, t: float, gyro: Array, acc: Array, q: Array, qd: Array, tau: Array, force: Array
    ) -> Estimate | None:
        """Take one tick's readings; None until the stand at the start is over, and again after a fall.

        A tick that is not newer than the last changes nothing. Readings that are not finite, or out of the
        sensor's range, count as missing: the motion goes on as before, and feet with missing joints wait.

        Args:
            t: time of the readings, by the robot's clock [s].
            gyro: angular velocity in the body frame [rad/s], (3,).
            acc: specific force in the body frame at the IMU [m/s^2], (3,).
            q, qd, tau: joint angles [rad], speeds [rad/s], torques [N m], (12,).
            force: foot force sensors [counts, about 1 N], (4,).
        """
        if not t > self._t:
            return self._estimate
        if t - self._t > self.cfg.max_gap or (self._ready and t - self._good > self.cfg.max_gap):
            self._forget()
        dt, self._t = t - self._t, t
        last, good, blind = self._imu, self._readable(gyro, acc), t - self._good
        if good:
            self._imu, self._good, blind = np.concatenate([gyro, acc]), t, blind - self.cfg.period
        known, turned = self._joints(q.tolist(), qd.tolist())
        self._sway.update(turned, (self._imu[:3] - self.ekf.bw).tolist(), dt)
        self.ekf.sway, self.ekf.far = self._sway.legs, self._sway.far
        if not self._ready:
            self._begin(good, force.tolist(), dt)
            return self._estimate

        leg = chains(self._q)
        imu, jump, change = self._imu, None, self._imu - last
        if good and blind > 0.1 * self.cfg.period:
            # the gap gets the mean of the readings around it, the rest of the step its own
            jump = imu - last
            imu = imu - 0.5 * min(1.0, blind / dt) * jump
        turns = [chain.shank(*turned[3 * i : 3 * i + 3]) for i, chain in enumerate(leg)]
        gap, give = max(0.0, blind), self.ekf.give**2 + float(self.ekf.P[GIVE, GIVE])
        loose = [footing.loose(give, dt) for footing in self._footing]
        self.ekf.predict(imu[:3], imu[3:], turns, dt, gap, jump, loose, change)
        if not (good or self._carried) and math.isfinite(float(acc.sum())):
            # a blow beyond the accelerometer's range, and no feet to tell what it did to the velocity
            self.ekf.P[V, V] += (2.0 * self.cfg.max_acc * dt) ** 2 * _I3
        used = self._feet(leg, tau.tolist(), force.tolist(), known, dt)
        if self._fallen(leg, self._lies(dt) or bool(used.any()), dt):
            self.falls += 1
            self._forget()
            self._t = self._good = t
            return None
        self._estimate = self._output(used)
        return self._estimate

    def ahead(self, t: float, gyro: Array, acc: Array, q: Array, qd: Array) -> Array | None:
        """The state (37,) at readings that `update` has yet to take, from the last estimate by the IMU alone.

        It takes a fraction of the time. None where `update` would not move on by one period from readings
        to readings: arguments as there.
        """
        dt, period = t - self._t, self.cfg.period
        if self._estimate is None or self._good != self._t or abs(dt - period) > 0.1 * period:
            return None
        if not (self._readable(gyro, acc) and math.isfinite(float(q.sum() + qd.sum()))):
            return None
        place, v, quat, C = self.ekf.ahead(gyro, acc, dt, np.concatenate([gyro, acc]) - self._imu)
        return self._state(place, v, quat, C, gyro - self.ekf.bw, q.tolist(), qd.tolist())

    def _lies(self, dt: float) -> bool:
        """Whether the body rests on something else than its feet; then its velocity is 0."""
        if self._carried:
            self._calm = 0.0
            return False
        cfg, (x, y, z) = self.cfg, (self._imu[:3] - self.ekf.bw).tolist()
        size = math.sqrt(float(self._imu[3:] @ self._imu[3:]))
        calm = x * x + y * y + z * z < _CALM_RATE**2 and abs(size - GRAVITY) < _CALM_ACC
        self._calm = self._calm + dt if calm else 0.0
        if self._calm < cfg.rest:
            return False
        self.ekf.observe_rest(cfg.rest_speed**2)
        return True

    def _fallen(self, leg: list[Chain], used: bool, dt: float) -> bool:
        """Whether the estimate has lost the robot."""
        if self._ticks % _SELDOM == 0:
            x, y, z = up = self.ekf.C[2].tolist()
            height, _ = lowest(leg, self._q, up)
            base = float(self.ekf.r[2]) - (x * _IMU[0] + y * _IMU[1] + z * _IMU[2])
            self._lowest = base + height if self.cfg.flat else 0.0
        self._ticks += 1
        return self._fall.update(used, self._carried, self._lowest, dt)

    def _readable(self, gyro: Array, acc: Array) -> bool:
        """Whether the IMU's readings are finite and within the sensor's range."""
        cfg = self.cfg
        # comparisons with NaN are false
        return all(abs(w) < cfg.max_gyro for w in gyro.tolist()) and all(
            abs(f) < cfg.max_acc for f in acc.tolist()
        )

    def _joints(self, q: list[float], qd: list[float]) -> tuple[list[bool], list[float]]:
        """Take the joints' readings; which legs have all of theirs, and how far each joint turned [rad]."""
        known = [True] * 4
        if not math.isfinite(sum(q) + sum(qd)):
            for i in range(4):
                at = slice(3 * i, 3 * i + 3)
                known[i] = math.isfinite(sum(q[at]) + sum(qd[at]))
                if not known[i]:
                    q[at], qd[at] = self._q[at], self._qd[at]
        turned = [new - old for new, old in zip(q, self._q, strict=True)]
        self._q, self._qd = q, qd
        return known, turned

    def _begin(self, good: bool, force: list[float], dt: float) -> None:
        """Collect the stand at the start; at its end, set the filter."""
        if not (good and math.isfinite(sum(self._q))):
            return
        loaded = [f > self.cfg.contact.on for f in force]
        stood = self._start.take(
            self._imu, dt if dt < self.cfg.max_gap else self.cfg.period, self._q, self._qd, loaded
        )
        if stood is None:
            return
        ekf, noise = self.ekf, self.cfg.noise
        ekf.q = so3.aligning(stood.force / np.linalg.norm(stood.force), _UP)
        ekf.C = so3.matrix(ekf.q)
        height, foot = lowest(chains(self._q), self._q, ekf.C[2].tolist())
        ekf.r[2], ekf.v = float(ekf.C[2] @ IMU) - height, ekf.C @ stood.velocity

        # all but unknown before the update with the mean specific force, which ties the tilt to the bias
        variance = np.ones(len(ekf.P))
        variance[PHI], variance[V] = (1.0, 1.0, 1e-8), stood.velocity_error**2
        variance[R] = 1e-8, 1e-8, noise.ground**2 if foot else _LYING**2
        variance[BW], variance[BF] = noise.gyro_bias**2, noise.acc_bias**2
        variance[GIVE], variance[LATE], variance[SPIN] = noise.give**2, noise.late**2, noise.spin**2
        ekf.P = np.diag(variance)
        ekf.observe_rate(stood.rate, stood.rate_variance)
        ekf.observe_force(stood.force, np.full(3, stood.force_error**2))
        self._ready = True

    def _feet(
        self, leg: list[Chain], tau: list[float], force: list[float], known: list[bool], dt: float
    ) -> Flags:
        """Tell contacts, use feet, anchor and release them; which were used, (4,) bool."""
        cfg, ekf = self.cfg, self.ekf
        C, contact, still = ekf.C.tolist(), [False] * 4, [False] * 4
        load = [so3.rotated(C, chain.force(*tau[3 * i : 3 * i + 3]))[2] for i, chain in enumerate(leg)]
        for i, chain in enumerate(leg):
            contact[i] = self.detectors[i].update(force[i], load[i], dt)
            if not contact[i]:
                load[i] = 0.0
                continue
            u, footing = self._slip(i, chain, C), self._footing[i]
            if not self.contact[i]:
                footing.touch_down(u[2])
            doubt = float(ekf.P[3, 3] + ekf.P[4, 4])
            footing.slide(u[0], u[1], doubt, (cfg.joint_speed * _ARM) ** 2, dt)
            still[i] = known[i] and self._rests(i, u)
        mean = sum(load) / max(sum(contact), 1)
        for i, footing in enumerate(self._footing):
            footing.bear(load[i], mean, dt)
            ekf.load[i] = footing.load

        stands, used = ekf.stands.tolist(), np.zeros(4, dtype=bool)
        s = [(x - _IMU[0], y - _IMU[1], z - _IMU[2]) for x, y, z in (chain.foot for chain in leg)]
        legs = tuple(i for i in range(4) if still[i] and stands[i])
        if legs:
            far = ekf.innovation(legs, s)
            if max(far) > cfg.gate:
                legs = tuple(i for i, place in zip(legs, far, strict=True) if place < cfg.gate)
                if legs:
                    ekf.innovation(legs, s)
            if legs:
                ekf.correct(cfg.noise.ground**2 * cfg.noise.ground_time / dt if cfg.flat else None)
                used[list(legs)] = True
        for i in range(4):
            if not stands[i]:
                self._refused[i] = 0.0
                if still[i]:
                    ekf.anchor(i, np.array(s[i]))
                continue
            self._refused[i] = 0.0 if used[i] else self._refused[i] + dt
            if not contact[i] or self._refused[i] > cfg.patience:
                ekf.release(i)

        self._carried = any(contact)
        # by one sense alone a foot in the air may seem to carry, and what it does is no velocity to believe
        firm = any(detector.firm for detector in self.detectors)
        self._lost = self._lost + dt if firm and not ekf.stands.any() else 0.0
        if self._lost > cfg.lost:
            ekf.P[V, V] += cfg.lost_speed**2 * _I3
            self._lost = 0.0
        self.contact = np.array(contact)
        return used

    def _slip(self, i: int, chain: Chain, C: list[list[float]]) -> Vector:
        r"""Velocity of a foot's contact point in the world frame [m/s].

        .. math:: u_i = v + C (w \times s_i + J_i \dot q_i) - \rho \, (C w_i) \times e_z
        """
        ekf, (a, b, c) = self.ekf, self._qd[3 * i : 3 * i + 3]
        p, q, r = (self._imu[:3] - ekf.bw).tolist()
        x, y, z = chain.foot
        x, y, z = x - _IMU[0], y - _IMU[1], z - _IMU[2]
        j, k, m = chain.rows
        foot = so3.rotated(
            C,
            (
                q * z - r * y + j[0] * a + j[1] * b + j[2] * c,
                r * x - p * z + k[0] * a + k[1] * b + k[2] * c,
                p * y - q * x + m[0] * a + m[1] * b + m[2] * c,
            ),
        )
        d, e, f = chain.shank(a, b, c)
        d, e, _ = so3.rotated(C, (p + d, q + e, r + f))
        vx, vy, vz = ekf.v.tolist()
        return vx + foot[0] - FOOT_RADIUS * e, vy + foot[1] + FOOT_RADIUS * d, vz + foot[2]

    def _rests(self, i: int, u: Vector) -> bool:
        """Whether the contact point of a foot with contact rests, by its velocity u [m/s]."""
        cfg, A = self.cfg, self.ekf.P[V, V].tolist()
        noise = cfg.slip**2 + (cfg.joint_speed * _ARM) ** 2
        A[0][0] += noise
        A[1][1] += noise
        A[2][2] += noise + self._footing[i].bounces
        return distance(A, u) < cfg.slip_gate

    def _output(self, used: Flags) -> Estimate:
        """The estimate at the last tick."""
        ekf = self.ekf
        return Estimate(
            self._t,
            self._state(ekf.r, ekf.v, ekf.q, ekf.C, self._imu[:3] - ekf.bw, self._q, self._qd),
            ekf.C,
            ekf.bw,
            ekf.bf,
            self.contact,
            used,
            ekf.P.copy(),
            self.cfg.noise.gyro,
        )

    def _state(
        self, r: Array, v: Array, quat: Array, C: Array, w: Array, q: list[float], qd: list[float]
    ) -> Array:
        """The base's state (37,) from place and velocity of the IMU, attitude, rate and joints."""
        a, b, c = w.tolist()
        x, y, z = _IMU
        arm = np.array([(x, b * z - c * y), (y, c * x - a * z), (z, a * y - b * x)])
        base = C @ arm  # the IMU and its velocity, seen from the base
        place, velocity = r - base[:, 0], v - base[:, 1]
        return np.array([*place.tolist(), *quat.tolist(), *q, *velocity.tolist(), a, b, c, *qd])
