"""The stand-in's sensors: noise, biases that walk, quantised encoders, uncalibrated feet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from deploy.codec import Floats, Ints

COUNTS = -(2**15), 2**15 - 1  # that a foot can tell


@dataclass(frozen=True)
class Sensors:
    """Errors of the sensors. Zero turns each off; the rate is none.

    The orders of magnitude are assumptions: no Allan deviations of this robot's IMU are published, and its
    feet's counts are known to be raw, different from foot to foot, and to drift.

    Attributes:
        rate: at which the IMU renews its values, up to the state's [Hz].
        gyro: noise [rad/s].
        gyro_bias: at first, up to [rad/s].
        gyro_walk: of that bias [rad/s/sqrt(s)].
        acc: noise [m/s^2].
        acc_bias: at first, up to [m/s^2].
        acc_walk: of that bias [m/s^2/sqrt(s)].
        yaw_drift: of the attitude, constant, up to [rad/s].
        encoder: angle of one count [rad].
        speed: noise of joint speeds [rad/s].
        torque: noise of joint torques [N m].
        foot_scale: relative spread of counts per newton around 1.
        foot_offset: counts of a foot in the air, up to.
        foot_drift: walk of that offset [counts/sqrt(s)].
        foot_noise: [counts].
    """

    rate: float = 500.0
    gyro: float = 0.01
    gyro_bias: float = 0.005
    gyro_walk: float = 1e-4
    acc: float = 0.1
    acc_bias: float = 0.05
    acc_walk: float = 1e-3
    yaw_drift: float = math.radians(0.1)
    encoder: float = 2 * math.pi / 2**16
    speed: float = 0.05
    torque: float = 0.2
    foot_scale: float = 0.3
    foot_offset: float = 15.0
    foot_drift: float = 0.3
    foot_noise: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} of the sensors must be 0 or more and finite, got {value}")
        if self.rate == 0:
            raise ValueError(f"rate of the sensors must be more than 0, got {self.rate}")


CLEAN = Sensors(**{name: 0.0 for name in Sensors.__dataclass_fields__ if name != "rate"})


class Imu:
    """Angular velocity, specific force and attitude, with their errors.

    Attributes:
        gyro_bias, acc_bias: of the last reading [rad/s], [m/s^2], (3,); truth, for judging only.
    """

    def __init__(self, cfg: Sensors, rng: np.random.Generator):
        self._cfg, self._rng = cfg, rng
        self.gyro_bias = rng.uniform(-cfg.gyro_bias, cfg.gyro_bias, 3)
        self.acc_bias = rng.uniform(-cfg.acc_bias, cfg.acc_bias, 3)
        self._yaw_drift = rng.uniform(-cfg.yaw_drift, cfg.yaw_drift)
        self._next = 0.0
        self._last: tuple[Floats, Floats, Floats] | None = None

    def read(
        self, time: float, dt: float, quat: Floats, gyro: Floats, acc: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """What it tells of the truth, dt [s] after the last call: (4,), (3,), (3,)."""
        cfg, rng = self._cfg, self._rng
        walk = rng.normal(size=(2, 3)) * math.sqrt(dt)
        self.gyro_bias = self.gyro_bias + cfg.gyro_walk * walk[0]
        self.acc_bias = self.acc_bias + cfg.acc_walk * walk[1]
        noise = rng.normal(size=(2, 3))
        if self._last is not None and time < self._next - 1e-9:
            return self._last
        self._next += 1 / cfg.rate
        half = 0.5 * self._yaw_drift * time
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, np.array([math.cos(half), 0.0, 0.0, math.sin(half)]), quat)
        self._last = (
            turned,
            gyro + self.gyro_bias + cfg.gyro * noise[0],
            acc + self.acc_bias + cfg.acc * noise[1],
        )
        return self._last


class Encoders:
    """Joint angles and speeds as they are measured.

    Args:
        cfg: errors.
        zeros: what each encoder reads at the joint's zero [rad], (12,).
        rng: of the noise.
    """

    def __init__(self, cfg: Sensors, zeros: Floats, rng: np.random.Generator):
        self._cfg, self._zeros, self._rng = cfg, zeros, rng

    def angle(self, q: Floats) -> Floats:
        """What the encoders read at these joint angles [rad], (12,)."""
        read = q + self._zeros
        count = self._cfg.encoder
        return count * np.rint(read / count) if count else read

    def told(self, q: Floats, dq: Floats, torque: Floats) -> tuple[Floats, Floats, Floats]:
        """Angles, speeds and torques as the motors tell them, (12,) each."""
        speed, current = self._rng.normal(size=(2, len(dq)))
        return self.angle(q), dq + self._cfg.speed * speed, torque + self._cfg.torque * current


class Feet:
    """Counts of the force sensors in the feet: scale times force, an offset that drifts, noise.

    Attributes:
        stuck: COUNTS that a foot tells whatever happens, by its index.
    """

    def __init__(self, cfg: Sensors, rng: np.random.Generator):
        self._cfg, self._rng = cfg, rng
        self._scale = 1 + rng.uniform(-cfg.foot_scale, cfg.foot_scale, 4)
        self._offset = rng.uniform(-cfg.foot_offset, cfg.foot_offset, 4)
        self.stuck: dict[int, int] = {}

    def read(self, force: Floats, dt: float) -> Ints:
        """Counts for these normal forces [N], (4,), dt [s] after the last call."""
        walk, noise = self._rng.normal(size=(2, 4))
        self._offset = self._offset + self._cfg.foot_drift * math.sqrt(dt) * walk
        counts = self._scale * force + self._offset + self._cfg.foot_noise * noise
        counts = np.minimum(np.maximum(np.rint(counts), COUNTS[0]), COUNTS[1]).astype(np.int64)
        for foot, value in self.stuck.items():
            counts[foot] = value
        return counts


def roll_pitch_yaw(quat: Floats) -> Floats:
    """Roll, pitch, yaw [rad], (3,), of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


class Battery:
    """Eight lithium cells, 15 A h, that the motors and the computers draw from."""

    IDLE, COPPER, CAPACITY = 60.0, 0.25, 15.0 * 3600  # W, W per (N m)^2 of joint torque, A s. Assumed.

    def __init__(self, charge: float = 90.0):
        self._charge = charge
        self.current = 0.0  # A, negative while it discharges

    @property
    def charge(self) -> int:
        """What is left [%]."""
        return int(self._charge)

    @property
    def voltage(self) -> float:
        """Under load [V]: eight cells from 3.3 to 4.1 V, 0.1 ohm."""
        return 8 * (3.3 + 0.8 * self._charge / 100) + 0.1 * self.current

    def draw(self, torque: Floats, dq: Floats, dt: float) -> None:
        """Drive the motors for dt [s] at these torques and speeds, (12,) each."""
        power = self.IDLE + self.COPPER * float(torque @ torque) + max(0.0, float(torque @ dq))
        self.current = -power / self.voltage
        self._charge = max(0.0, self._charge + 100 * self.current * dt / self.CAPACITY)
