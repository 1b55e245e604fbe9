"""The stand-in robot's sensors on a log: clean readings in, what arrives at the computer out, with faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from tools.estimators.simulate import SENSORS, Array, Log
from tools.robot.body import Body
from tools.robot.sensors import Encoders, Feet, Imu, Sensors


@dataclass(frozen=True)
class SensorCfg:
    """Errors of the sensors, which are the stand-in robot's, and of the way to the computer.

    Attributes:
        robot: errors of the readings.
        zero: joint zeros within plus or minus, a uniform draw per robot [rad].
        drop, twice, nan: share of frames that are lost, arrive twice, or have a sensor without numbers.
        stall: stalls of 5 ms a second.
    """

    robot: Sensors = field(default_factory=Sensors)
    zero: float = Body.zero
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
    cfg, rng = cfg or SensorCfg(), np.random.default_rng([seed, 1])
    zeros = rng.uniform(-cfg.zero, cfg.zero, 12)
    imu, feet = Imu(cfg.robot, rng), Feet(cfg.robot, rng)
    encoders, rows, biases = Encoders(cfg.robot, zeros, rng), [], []
    ticks = zip(log.t.tolist(), log.gyro, log.acc, log.x, log.tau, log.force, strict=True)
    for t, gyro, acc, x, tau, force in ticks:
        _, *told = imu.read(t, SENSORS, x[3:7], gyro, acc)
        joints = encoders.told(x[7:19], x[25:], tau)
        rows.append(np.concatenate([*told, *joints, feet.read(force, SENSORS)]))
        biases.append(np.concatenate([imu.gyro_bias, imu.acc_bias]))

    row = _arrivals(len(log.t), cfg, rng)
    parts = np.split(np.array(rows)[row], [3, 6, 18, 30, 42], axis=1)
    for frame in np.flatnonzero(rng.random(len(row)) < cfg.nan):
        parts[rng.integers(len(parts))][frame] = np.nan
    gyro, acc, q, qd, tau, force = parts
    gyro_bias, acc_bias = np.split(np.array(biases), 2, axis=1)
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
