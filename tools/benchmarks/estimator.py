"""What a tick costs the estimator, on logs of simulated robots with all their sensors' errors."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from deploy import estimator as deployed
from tools.benchmarks.figures import Common, Figures
from tools.estimators.sensors import Readings, sense
from tools.estimators.simulate import simulate


@dataclass(frozen=True)
class Estimator(Common):
    """The estimator's tick, on one core, at the robot's 500 Hz.

    Attributes:
        seconds: length of each log [s].
        seed: of the robot.
        repeats: times that each log is run through; the fastest counts.
    """

    seconds: float = 3.0
    seed: int = 0
    repeats: int = 5


def estimator(args: Estimator) -> Figures:
    """Measure."""
    if args.seconds < 1.0:
        raise ValueError(f"seconds must be at least 1, since it begins with a stand, got {args.seconds:g}")
    figures = Figures()
    for motion, suffix, name in (("flip", "", "flip, on two feet or none"), ("stand", "_four", "four feet")):
        readings = sense(simulate(motion, args.seconds, args.seed), args.seed)
        step, ahead = np.min([medians(readings) for _ in range(args.repeats)], axis=0)
        figures.add(f"estimator_step{suffix}_us", 1e6 * step, f"an update, median of a log: {name} [us]")
        figures.add(f"estimator_ahead{suffix}_us", 1e6 * ahead, "the state moved on by the IMU alone [us]")
    return figures


def medians(readings: Readings) -> tuple[float, float]:
    """Of an update and of a look ahead, while there is an estimate [s]."""
    ours, updates, looks = deployed.Estimator(), [], []
    for reading in readings:
        began = time.perf_counter()
        ahead = ours.ahead(*reading[:5])
        looked = time.perf_counter()
        estimate = ours.update(*reading)
        ended = time.perf_counter()
        if estimate is not None:
            updates.append(ended - looked)
        if ahead is not None:
            looks.append(looked - began)
    return float(np.median(updates)), float(np.median(looks))
