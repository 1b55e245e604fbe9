"""The state moved on by the IMU alone, against what filter and estimator make of it."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from deploy.estimator import Estimator
from tests.legged import DT, stand
from tests.test_ekf import NO_TURN, random_filter
from tools.estimators.sensors import sense
from tools.estimators.simulate import simulate


@pytest.mark.parametrize("seed", range(3))
def test_ahead_is_what_predict_makes_to_the_bit(seed):
    rng, ekf = np.random.default_rng(seed + 20), random_filter(seed)
    gyro, acc, change = 2.0 * rng.normal(size=3), 10.0 * rng.normal(size=3), 0.1 * rng.normal(size=6)
    before = copy.deepcopy(ekf)
    found = ekf.ahead(gyro, acc, 0.002, change)
    for name in ("r", "v", "q", "C", "p", "P"):
        np.testing.assert_array_equal(getattr(ekf, name), getattr(before, name), err_msg="it changes nothing")
    ekf.predict(gyro, acc, NO_TURN, 0.002, change=change)
    for part, name in zip(found, ("r", "v", "q", "C"), strict=True):
        np.testing.assert_array_equal(part, getattr(ekf, name))


def test_ahead_is_the_next_estimate_less_what_the_feet_say():
    log = simulate("flip", 3.0, 0)
    readings, estimator = sense(log, 0), Estimator()
    flights, off = 0, []
    for i, t in enumerate(readings.t):
        told = (readings.gyro[i], readings.acc[i], readings.q[i], readings.qd[i])
        ahead = estimator.ahead(t, *told)
        e = estimator.update(t, *told, readings.tau[i], readings.force[i])
        if ahead is None or e is None:
            continue
        np.testing.assert_array_equal(ahead[7:19], e.x[7:19])
        np.testing.assert_array_equal(ahead[25:], e.x[25:])
        off.append(np.abs(ahead - e.x).max())
        if not e.contact.any():
            flights += 1
            np.testing.assert_array_equal(ahead, e.x)
    assert flights > 50
    assert len(off) > 1000
    assert np.median(off) < 0.005


def test_ahead_is_for_whole_readings_one_period_on():
    robot, estimator = stand("footstand", noise=1.0), Estimator()
    readings = robot.readings()
    told = {name: readings[name] for name in ("gyro", "acc", "q", "qd")}
    assert estimator.ahead(robot.t, **told) is None, "nothing is known yet"
    robot.run(estimator, 0.6)
    assert estimator.ahead(robot.t + DT, **told) is not None
    for t in (robot.t, robot.t + 2 * DT, robot.t - DT):
        assert estimator.ahead(t, **told) is None
    for name, value in told.items():
        bad = value.copy()
        bad[1] = math.nan
        assert estimator.ahead(robot.t + DT, **{**told, name: bad}) is None
    robot.run(estimator, DT, gyro=np.full(3, math.nan))
    assert estimator.ahead(robot.t + DT, **told) is None, "the readings before these are missing"
    robot.run(estimator, DT)
    assert estimator.ahead(robot.t + DT, **told) is not None
