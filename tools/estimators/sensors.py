"""The robot's sensors: clean readings in, what arrives at the computer out, faults included."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tools.estimators.simulate import SENSORS, Array, Log


@dataclass(frozen=True)
class SensorCfg:
    """Errors of the sensors. "Within" means a uniform draw per robot.

    Attributes:
        gyro: noise of a reading [rad/s].
        gyro_bias: within [rad/s].
        gyro_walk: of the bias [rad/s/sqrt(s)].
        acc: noise of a reading [m/s^2].
        acc_bias: within [m/s^2].
        acc_walk: of the bias [m/s^2/sqrt(s)].
        zero: joint zeros within [rad].
        step: of an encoder [rad], 15 bit.
        speed: noise of a joint speed [rad/s].
        torque: noise of a joint torque [N m].
        scale: of a foot force sensor within 1 plus or minus.
        offset: of a foot force sensor within [counts].
        drift: of that offset [counts/sqrt(s)].
        force: noise of a foot force [counts].
        drop, twice, nan: share of frames that are lost, arrive twice, or have a sensor without numbers.
        stall: stalls of 5 ms a second.
    """

    gyro: float = 0.01
    gyro_bias: float = 0.005
    gyro_walk: float = 1e-4
    acc: float = 0.1
    acc_bias: float = 0.05
    acc_walk: float = 1e-3
    zero: float = math.radians(0.5)
    step: float = 2.0 * math.pi / 2**15
    speed: float = 0.05
    torque: float = 0.2
    scale: float = 0.2
    offset: float = 5.0
    drift: float = 0.3
    force: float = 1.5
    drop: float = 0.01
    twice: float = 0.01
    nan: float = 0.001
    stall: float = 0.2


@dataclass(frozen=True)
class Readings:
    """What arrives, in order, n frames; and the truth about the sensors, for judging only.

    Attributes:
        row: which tick of the log each frame is, (n,).
        t, gyro, acc, q, qd, tau, force: as `deploy.estimator.Estimator.update` takes them, n rows.
        gyro_bias, acc_bias: true biases, of each tick of the log, (ticks, 3).
    """

    row: np.ndarray
    t: Array
    gyro: Array
    acc: Array
    q: Array
    qd: Array
    tau: Array
    force: Array
    gyro_bias: Array
    acc_bias: Array

    def __iter__(self) -> Iterator[tuple[float, Array, Array, Array, Array, Array, Array]]:
        """Arguments of an estimator's update, frame by frame."""
        return zip(self.t.tolist(), self.gyro, self.acc, self.q, self.qd, self.tau, self.force, strict=True)


def sense(log: Log, seed: int, cfg: SensorCfg | None = None) -> Readings:
    """Readings of a log by the sensors of robot `seed`."""
    cfg, rng, n = cfg or SensorCfg(), np.random.default_rng([seed, 1]), len(log.t)

    def walk(start: float, step: float, size: int) -> Array:
        """A bias within `start` that walks, (n, size)."""
        steps = step * math.sqrt(SENSORS) * rng.normal(size=(n, size))
        return rng.uniform(-start, start, size) + steps.cumsum(0)

    gyro_bias, acc_bias = walk(cfg.gyro_bias, cfg.gyro_walk, 3), walk(cfg.acc_bias, cfg.acc_walk, 3)
    gyro = log.gyro + gyro_bias + cfg.gyro * rng.normal(size=(n, 3))
    acc = log.acc + acc_bias + cfg.acc * rng.normal(size=(n, 3))
    q = log.x[:, 7:19] + rng.uniform(-cfg.zero, cfg.zero, 12)
    q = cfg.step * np.rint(q / cfg.step)
    qd = log.x[:, 25:] + cfg.speed * rng.normal(size=(n, 12))
    tau = log.tau + cfg.torque * rng.normal(size=(n, 12))
    scale = 1.0 + rng.uniform(-cfg.scale, cfg.scale, 4)
    force = scale * log.force + walk(cfg.offset, cfg.drift, 4) + cfg.force * rng.normal(size=(n, 4))
    force = np.rint(np.maximum(force, 0.0))

    row = _arrivals(n, cfg, rng)
    parts = [part[row] for part in (gyro, acc, q, qd, tau, force)]
    for frame in np.flatnonzero(rng.random(len(row)) < cfg.nan):
        parts[rng.integers(len(parts))][frame] = np.nan
    gyro, acc, q, qd, tau, force = parts
    return Readings(row, log.t[row], gyro, acc, q, qd, tau, force, gyro_bias, acc_bias)


def _arrivals(n: int, cfg: SensorCfg, rng: np.random.Generator) -> np.ndarray:
    """Which ticks arrive, in order; some are missing, some come twice."""
    count = np.ones(n, dtype=int)
    count[rng.random(n) < cfg.twice] = 2
    count[rng.random(n) < cfg.drop] = 0
    lost = round(0.005 / SENSORS)
    for start in np.flatnonzero(rng.random(n) < cfg.stall * SENSORS):
        count[start : start + lost] = 0
    count[: round(0.02 / SENSORS)] = 1
    return np.repeat(np.arange(n), count)
