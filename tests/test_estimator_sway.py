"""How much a leg sways, and what the estimator makes of a robot that does not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from deploy.estimator import Estimator
from deploy.noise import NoiseCfg
from deploy.sway import Sway
from tests.legged import DT, stand

STILL, LEVEL = [0.0] * 12, [0.0] * 3


def rest(sway: Sway, seconds: float) -> list[float]:
    """What legs sway after they have been still for so long."""
    for _ in range(round(seconds / DT)):
        sway.update(STILL, LEVEL, DT)
    return sway.legs


def test_stillness_has_to_last():
    cfg = NoiseCfg()
    sway = Sway(cfg, DT)
    assert sway.legs == [1.0] * 4, "nothing is known at the start"
    assert rest(sway, cfg.calm_time) == pytest.approx([math.exp(-1.0)] * 4, rel=0.01)


def test_a_leg_that_moves_sways_at_once_and_the_body_moves_all():
    cfg = NoiseCfg()
    sway = Sway(cfg, DT)
    rest(sway, 3.0)
    sway.update([0.0] * 4 + [-1.1 * cfg.sway] + [0.0] * 7, LEVEL, DT)
    assert sway.legs[1] == 1.0
    assert max(sway.legs[0], *sway.legs[2:]) < 1e-3
    sway.update(STILL, [0.0, 0.8 * cfg.sway / DT, 0.0], DT)
    assert min(sway.legs) >= 0.6


def test_a_gap_is_no_stillness_and_a_step_without_numbers_tells_nothing():
    sway = Sway(NoiseCfg(), DT)
    sway.update(STILL, LEVEL, 0.4)
    assert min(sway.legs) > 0.99
    nothing = ([math.nan] * 12, LEVEL, DT), (STILL, [math.nan] * 3, DT), (STILL, LEVEL, math.inf)
    for turned, rate, dt in nothing:
        before = sway.legs.copy()
        sway.update(turned, rate, dt)
        assert sway.legs == before


def test_how_far_a_leg_has_turned_is_remembered_for_a_while():
    cfg = NoiseCfg()
    sway = Sway(cfg, DT)
    sway.update([0.0] * 4 + [0.3] + [0.0] * 7, LEVEL, DT)
    assert sway.far == pytest.approx([0.0, 0.3, 0.0, 0.0])
    rest(sway, cfg.calm_time)
    assert sway.far == pytest.approx([0.0, 0.3 * math.exp(-1.0), 0.0, 0.0], rel=0.01)


def test_noise_of_the_gyroscope_and_steps_of_the_encoders_are_no_sway():
    cfg, rng = NoiseCfg(), np.random.default_rng(0)
    sway, step = Sway(cfg, DT), 2.0 * math.pi / 2**15
    for k in range(1000):
        sway.update([step if k % 50 == 0 else 0.0] * 12, (cfg.gyro * rng.normal(size=3)).tolist(), DT)
    assert max(sway.legs) < 0.05


@pytest.mark.parametrize(("jitter", "taken"), [(0.0, 0.998), (1e-4, 0.97)])
def test_a_still_stand_is_known_to_a_millimetre_a_second(jitter, taken):
    """What joints that jitter by half an encoder's step say is believed all the same."""
    robot, estimator, rng = stand("home", noise=1.0), Estimator(), np.random.default_rng(1)
    errors, sigmas, used = [], [], []
    for _ in range(round(4.0 / DT)):
        readings = {**robot.readings(), "q": robot.q + jitter * rng.normal(size=12)}
        e = estimator.update(robot.t, **readings)
        if e is not None and robot.t > 12.0:
            errors.append(e.velocity_body)
            sigmas.append(np.diag(e.velocity_covariance()))
            used.append(e.used)
    error, sigma = np.sqrt(np.mean(np.square(errors), 0)), np.sqrt(np.mean(sigmas, 0))
    assert (error < 0.001).all()
    assert (error < 1.3 * sigma).all()
    assert np.mean(used) >= taken
