"""The robot's state from its own sensors, tick by tick: contacts, gates, faults, and the ekf."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from deploy import so3
from deploy.contact import ContactCfg, FootContact
from deploy.ekf import BF, BW, GRAVITY, PHI, Ekf, Flags, NoiseCfg, R, V
from deploy.estimate import Estimate
from deploy.kinematics import FOOT_RADIUS, IMU, Legs, legs
from deploy.so3 import Array, skew

_I3 = np.eye(3)
_UP = np.array([0.0, 0.0, 1.0])
_ALL: Flags = np.ones(4, dtype=bool)
# rows w to rows -rho w x e_z
_LEVER = FOOT_RADIUS * skew(_UP).T


@dataclass(frozen=True)
class StartCfg:
    """The still stand at the start.

    Attributes:
        time: its length [s].
        speed: of the body then, standard deviation [m/s].
        rate: mean angular velocity, likewise [rad/s].
        acc: mean acceleration, likewise [m/s^2].
        max_rate: mean angular speed beyond which the robot is not standing still [rad/s].
        max_acc: difference of the mean specific force from gravity, likewise [m/s^2].
    """

    time: float = 0.25
    speed: float = 0.1
    rate: float = 0.005
    acc: float = 0.2
    max_rate: float = 0.5
    max_acc: float = 2.0


@dataclass(frozen=True)
class EstimatorCfg:
    """Settings of the estimator.

    Attributes:
        noise: standard deviations.
        contact: contact detection.
        start: the still stand at the start.
        flat: whether all footholds are at height 0, which keeps the height from drifting.
        period: of the readings [s]; longer steps have a gap that no reading covers.
        max_gap: without readings for longer, the estimator starts anew [s].
        gate: squared Mahalanobis distance beyond which a foot's place is an outlier; chi-square with 3
            degrees of freedom passes 99.9 % at 16.3.
        slip_gate: the same for the speed of a foot's contact point.
        creep: speed at which the contact point of a standing foot may move, standard deviation [m/s].
        joint_speed: standard deviation of a reading [rad/s].
        patience: a foot left out for longer loses its anchor [s].
        lost: when all feet with contact are left out for this long, the velocity counts as lost [s].
        lost_speed: standard deviation added to it then [m/s].
        max_gyro: range of the gyroscope, 2000 deg/s [rad/s].
        max_acc: range of the accelerometer, 16 g [m/s^2].
    """

    noise: NoiseCfg = field(default_factory=NoiseCfg)
    contact: ContactCfg = field(default_factory=ContactCfg)
    start: StartCfg = field(default_factory=StartCfg)
    flat: bool = True
    period: float = 0.002
    max_gap: float = 0.5
    gate: float = 16.3
    slip_gate: float = 16.3
    creep: float = 0.035
    joint_speed: float = 0.05
    patience: float = 0.01
    lost: float = 0.05
    lost_speed: float = 0.5
    max_gyro: float = 35.0
    max_acc: float = 157.0


class Estimator:
    """Body state of the Go2 from IMU, joint encoders, joint torques and foot forces.

    It begins with a still stand at any attitude, on two feet or four: the mean specific force gives the
    gravity direction, the mean angular velocity the gyroscope's bias, both with honest covariances. The
    heading there is 0, and x and y are 0.

    Args:
        cfg: settings.

    Attributes:
        ekf: the Kalman ekf.
        detectors: contact detection of each foot.
        contact: what it says, (4,) bool.
    """

    def __init__(self, cfg: EstimatorCfg | None = None):
        self.cfg = cfg or EstimatorCfg()
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next readings must come from a still stand."""
        self.ekf = Ekf(self.cfg.noise)
        self.detectors = [FootContact(self.cfg.contact) for _ in range(4)]
        self.contact = np.zeros(4, dtype=bool)
        self._t = self._good = -math.inf  # of the last tick, of the last with an IMU
        self._still: list[Array] = []
        self._imu = np.full(6, np.nan)  # of the last good tick
        self._q, self._qd = np.full((4, 3), np.nan), np.zeros((4, 3))
        self._refused = np.zeros(4)  # for how long each foot has been left out [s]
        self._lost = 0.0
        self._A, self._b = np.zeros((3, 4, 3, 3)), np.zeros((3, 4, 3))
        self._ready = False
        self._estimate: Estimate | None = None

    def update(
        self, t: float, gyro: Array, acc: Array, q: Array, qd: Array, tau: Array, force: Array
    ) -> Estimate | None:
        """Take one tick's readings; None until the still stand at the start is over.

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
            self.reset()
        dt, self._t = t - self._t, t
        last, good, blind = self._imu, self._readable(gyro, acc), t - self._good
        if good:
            self._imu, self._good, blind = np.concatenate([gyro, acc]), t, blind - self.cfg.period
        angles, speeds = q.reshape(4, 3), qd.reshape(4, 3)
        if math.isfinite(angles.sum() + speeds.sum()):
            known, turned = _ALL, angles - self._q
            self._q, self._qd = angles.copy(), speeds.copy()
        else:
            known = np.asarray(np.isfinite(angles + speeds).all(1))
            turned = np.where(known[:, None], angles - self._q, 0.0)
            self._q = np.where(known[:, None], angles, self._q)
            self._qd = np.where(known[:, None], speeds, self._qd)
        if not self._ready:
            self._start(good)
            return self._estimate

        leg = legs(self._q.reshape(12))
        imu = 0.5 * (last + self._imu) if blind > 0.1 * self.cfg.period else self._imu
        self.ekf.predict(imu[:3], imu[3:], (leg.axis @ turned[:, :, None])[:, :, 0], dt, max(0.0, blind))
        used = self._feet(leg, tau, force, known, dt)
        self._estimate = self._output(used)
        return self._estimate

    def _readable(self, gyro: Array, acc: Array) -> bool:
        """Whether the IMU's readings are finite and within the sensor's range."""
        cfg = self.cfg
        # comparisons with NaN are false
        return bool(np.abs(gyro).max() < cfg.max_gyro and np.abs(acc).max() < cfg.max_acc)

    def _start(self, good: bool) -> None:
        """Collect the still stand; at its end, set the filter."""
        cfg, ekf = self.cfg.start, self.ekf
        if good and np.isfinite(self._q).all():
            self._still.append(self._imu)
        if len(self._still) * self.cfg.period < cfg.time:
            return
        readings = np.array(self._still)
        self._still = []
        mean, spread = readings.mean(0), readings.var(0)
        size = float(np.linalg.norm(mean[3:]))
        if np.linalg.norm(mean[:3]) > cfg.max_rate or abs(size - GRAVITY) > cfg.max_acc:
            return
        ekf.q = so3.aligning(mean[3:] / size, _UP)
        ekf.C = so3.matrix(ekf.q)
        arms = (legs(self._q.reshape(12)).foot - IMU) @ ekf.C[2]
        ekf.r[2] = FOOT_RADIUS - arms.min()

        # all but unknown before the update with the mean specific force, which ties the tilt to the bias
        noise, variance = self.cfg.noise, np.ones(len(ekf.P))
        variance[PHI], variance[V] = (1.0, 1.0, 1e-8), cfg.speed**2
        variance[R] = 1e-8, 1e-8, noise.ground**2
        variance[BW], variance[BF] = noise.gyro_bias**2, noise.acc_bias**2
        ekf.P = np.diag(variance)
        white = np.repeat([noise.gyro**2, noise.acc**2], 3)
        sway = np.repeat([cfg.rate**2, cfg.acc**2], 3)
        # what moves more than noise is a stand that sways, slower than the mean could tell
        error = white / len(readings) + 4.0 * np.maximum(spread - white, 0.0) + sway
        ekf.observe_rate(mean[:3], error[:3])
        ekf.observe_force(mean[3:], error[3:])
        self._ready = True

    def _feet(self, leg: Legs, tau: Array, force: Array, known: Flags, dt: float) -> Flags:
        """Tell contacts, use feet, anchor and release them; which were used, (4,) bool."""
        cfg, ekf = self.cfg, self.ekf
        s, spread = leg.foot - IMU, ekf.C @ leg.jacobian
        gram = spread @ spread.transpose(0, 2, 1)
        noise = cfg.noise.joint**2 * gram + cfg.noise.kinematics**2 * _I3
        # three systems a foot, solved at once: its place, its contact point's velocity, its force
        A, b = self._A, self._b
        b[0], A[0] = ekf.innovation(s, noise)
        b[1], A[1] = self._slip(leg, s), cfg.joint_speed**2 * gram + (ekf.P[V, V] + cfg.creep**2 * _I3)
        b[2], A[2] = tau.reshape(4, 3), leg.jacobian.transpose(0, 2, 1)
        x = np.linalg.solve(A, b[..., None])[..., 0]
        place, speed = (b[:2] * x[:2]).sum(2)
        readings = zip(self.detectors, force.tolist(), (x[2] @ -ekf.C[2]).tolist(), strict=True)
        self.contact = contact = np.array([foot.update(f, load, dt) for foot, f, load in readings])

        still = contact & known & (speed < cfg.slip_gate)
        used: Flags = ekf.stands & still & (place < cfg.gate)
        if used.any():
            ekf.correct(used, cfg.noise.ground**2 * cfg.noise.ground_time / dt if cfg.flat else None)
        for i in range(4):
            if not ekf.stands[i]:
                self._refused[i] = 0.0
                if still[i]:
                    ekf.anchor(i, s[i], noise[i])
                continue
            self._refused[i] = 0.0 if used[i] else self._refused[i] + dt
            if not contact[i] or self._refused[i] > cfg.patience:
                ekf.release(i)

        self._lost = self._lost + dt if contact.any() and not ekf.stands.any() else 0.0
        if self._lost > cfg.lost:
            ekf.P[V, V] += cfg.lost_speed**2 * _I3
            self._lost = 0.0
        return used

    def _slip(self, leg: Legs, s: Array) -> Array:
        r"""Velocity of each foot's contact point in the world frame [m/s], (4, 3).

        .. math:: u_i = v + C (w \times s_i + J_i \dot q_i) - \rho \, (C w_i) \times e_z
        """
        C, qd = self.ekf.C, self._qd[:, :, None]
        w = self._imu[:3] - self.ekf.bw
        rel = s @ skew(w).T + (leg.jacobian @ qd)[:, :, 0]
        shank = w + (leg.axis @ qd)[:, :, 0]
        return np.asarray(self.ekf.v + rel @ C.T + shank @ (C.T @ _LEVER))

    def _output(self, used: Flags) -> Estimate:
        """The estimate of the base, from that of the IMU."""
        ekf, x = self.ekf, np.empty(37)
        w = self._imu[:3] - ekf.bw
        x[:3] = ekf.r - ekf.C @ IMU
        x[3:7], x[7:19] = ekf.q, self._q.reshape(12)
        x[19:22] = ekf.v - ekf.C @ (skew(w) @ IMU)
        x[22:25], x[25:] = w, self._qd.reshape(12)
        return Estimate(
            self._t,
            x,
            ekf.C,
            ekf.bw,
            ekf.bf,
            self.contact,
            used,
            ekf.P.copy(),
            self.cfg.noise.gyro,
        )
