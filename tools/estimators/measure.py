"""How well a filter does on a log: errors, consistency, rejected updates, time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from deploy import so3
from deploy.estimate import Estimate
from deploy.estimator import Estimator, EstimatorCfg
from deploy.so3 import Array
from tools.estimators.cheetah import Cheetah
from tools.estimators.invariant import Invariant
from tools.estimators.reference import Reference, run
from tools.estimators.sensors import Readings, SensorCfg, sense
from tools.estimators.simulate import Log, simulate

FILTERS = ("ours", "cheetah", "invariant")
NEES = {"velocity": 3, "gravity": 2, "biases": 6}  # degrees of freedom
SETTLE = 1.0  # s at the start that no figure counts: filters begin at rest with what one reading tells
COUNT = 0.1  # s after it, at least: a look at consistency is among them, even where a tick or two are lost
_EVERY = 10  # ticks between the samples of NEES


@dataclass(frozen=True)
class Job:
    """One filter on one log.

    Attributes:
        motion: of the robot.
        seconds: length of the log [s].
        seed: of the robot.
        filter: one of FILTERS.
    """

    motion: str
    seconds: float
    seed: int
    filter: str


@dataclass(frozen=True)
class Score:
    """How well it did.

    Attributes:
        job: what was measured.
        kept: whether the robot did what it should.
        velocity: RMSE of the base velocity in the body frame [m/s].
        tilt: RMSE of the gravity direction [deg].
        height: error of the base height at the end [m].
        worst: largest velocity error [m/s].
        nees_velocity, nees_gravity, nees_biases: means over the log, of `NEES`; NaN for the references, like
            the next two.
        rejected: share of updates with a foot that carries and does not slip that were not made.
        used_slip: share of feet that slip by more than 0.2 m/s under load and were used all the same.
        us: median time of a tick [us].
        falls: how often the estimator began anew; 0 for the references.
    """

    job: Job
    kept: bool
    velocity: float
    tilt: float
    height: float
    worst: float
    nees_velocity: float
    nees_gravity: float
    nees_biases: float
    rejected: float
    used_slip: float
    us: float
    falls: int


def truth(log: Log, row: np.ndarray) -> Array:
    """Body velocity, gravity direction and base height of ticks `row`, (n, 7)."""
    x = log.x[row]
    C = np.array([so3.matrix(q) for q in x[:, 3:7]])
    return np.column_stack([np.einsum("nij,ni->nj", C, x[:, 19:22]), -C[:, 2], x[:, 2]])


def play(
    readings: Readings, cfg: EstimatorCfg | None = None, estimator: Estimator | None = None
) -> tuple[list[Estimate | None], Array]:
    """The estimator's output at each reading, and what each took [s], (n,)."""
    estimator, out, took = estimator or Estimator(cfg), [], []
    for reading in readings:
        began = time.perf_counter()
        out.append(estimator.update(*reading))
        took.append(time.perf_counter() - began)
    return out, np.array(took)


def outputs(estimates: list[Estimate | None]) -> Array:
    """Body velocity, gravity direction and base height, (n, 7); NaN before the estimator is ready."""
    blank = np.full(7, np.nan)
    return np.array(
        [blank if e is None else [*e.velocity_body, *e.gravity, e.position[2]] for e in estimates]
    )


def consistency(estimates: list[Estimate | None], log: Log, readings: Readings) -> tuple[float, ...]:
    """Mean normalised squared errors of `NEES` over the log; each would be its degrees of freedom."""
    rows, true = [], truth(log, readings.row)
    for i in range(0, len(estimates), _EVERY):
        e, at = estimates[i], readings.row[i]
        if e is None or log.t[at] < SETTLE:
            continue
        velocity = e.velocity_body - true[i, :3]
        # world z by the true attitude, seen in the estimate's world: z - phi x z
        up = -(e.C @ true[i, 3:6])
        tilt = np.array([up[1], -up[0]])
        bias = np.concatenate([readings.gyro_bias[at] - e.gyro_bias, readings.acc_bias[at] - e.acc_bias])
        parts = [(velocity, e.velocity_covariance()), (tilt, e.tilt_covariance()), (bias, e.P[9:15, 9:15])]
        rows.append([error @ np.linalg.solve(P, error) for error, P in parts])
    return tuple(np.mean(rows, 0).tolist())


def gates(estimates: list[Estimate | None], log: Log, readings: Readings) -> tuple[float, float]:
    """Shares of good updates that were not made, and of slipping feet that were used; see `Score`."""
    good = refused = slips = missed = 0
    before = np.zeros(4, dtype=bool)
    for e, at in zip(estimates, readings.row, strict=True):
        if e is None or log.t[at] < SETTLE:
            continue
        # the tick of a touchdown anchors the foot, it makes no update
        stands = e.contact & before & (log.force[at] > 10.0)
        fine, slipping = stands & (log.slip[at] < 0.05), stands & (log.slip[at] > 0.2)
        good, refused = good + int(fine.sum()), refused + int((fine & ~e.used).sum())
        slips, missed = slips + int(slipping.sum()), missed + int((slipping & e.used).sum())
        before = e.contact
    return refused / max(good, 1), missed / max(slips, 1)


@lru_cache(maxsize=1)
def _recorded(motion: str, seconds: float, seed: int) -> Log:
    """A motion; where one filter after the other reads it, it is simulated once."""
    return simulate(motion, seconds, seed)


def measure(job: Job, cfg: EstimatorCfg, sensors: SensorCfg) -> Score:
    """Simulate one robot and run the filter on what its sensors say."""
    log = _recorded(job.motion, job.seconds, job.seed)
    readings = sense(log, job.seed, sensors)
    true = truth(log, readings.row)
    references: dict[str, Callable[[], Reference]] = {"cheetah": Cheetah, "invariant": Invariant}
    velocity = gravity = biases = np.nan
    rejected, used_slip, falls = np.nan, np.nan, 0
    if job.filter in references:
        began = time.perf_counter()
        out = run(references[job.filter](), readings)
        us = (time.perf_counter() - began) / len(out)
    else:
        estimator = Estimator(cfg)
        estimates, took = play(readings, estimator=estimator)
        falls = estimator.falls
        out, us = outputs(estimates), float(np.median(took))
        velocity, gravity, biases = consistency(estimates, log, readings)
        rejected, used_slip = gates(estimates, log, readings)
    # a robot that sways at the start is waited for
    known = (log.t[readings.row] >= SETTLE) & np.isfinite(out[:, 0])
    error = np.linalg.norm(out[known, :3] - true[known, :3], axis=1)
    cosine = np.clip((out[known, 3:6] * true[known, 3:6]).sum(1), -1.0, 1.0)
    return Score(
        job,
        bool(log.kept),
        float(np.sqrt(np.mean(error**2))),
        float(np.degrees(np.sqrt(np.mean(np.arccos(cosine) ** 2)))),
        float(abs(out[-1, 6] - true[-1, 6])),
        float(error.max()),
        velocity,
        gravity,
        biases,
        rejected,
        used_slip,
        1e6 * us,
        falls,
    )
