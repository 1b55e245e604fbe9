"""A heading that nothing tells: the filter's claims of it grow as its errors do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from deploy.ekf import BF, BW, GIVE, GRAVITY, LATE, PHI, SPIN, Ekf, R, V
from deploy.noise import NoiseCfg

UP = np.array([0.0, 0.0, GRAVITY])
FEET = np.array([[0.2, 0.15, -0.3], [0.2, -0.15, -0.3], [-0.2, 0.15, -0.3], [-0.2, -0.15, -0.3]])
DT = 0.01  # s


def started(cfg: NoiseCfg) -> Ekf:
    """As after a stand at the start: a gyroscope's bias to 0.5 mrad/s, a tilt to 2 mrad."""
    ekf = Ekf(cfg)
    spread = np.full(len(ekf.P), 1.0)
    spread[PHI], spread[V], spread[R] = (2e-3, 2e-3, 1e-4), 1e-2, 1e-4
    spread[BW], spread[BF] = 5e-4, cfg.acc_bias
    spread[GIVE], spread[LATE], spread[SPIN] = cfg.give, cfg.late, cfg.spin
    ekf.P = np.diag(spread**2)
    return ekf


def turned(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def stand(ekf: Ekf, seconds: float, slide: float = 0.0, turn: float = 0.0) -> float:
    """A body that turns at `turn`, on feet that slide round it at `slide` [rad/s].

    All are set down anew every half second, and read to half a millimetre. Returns the heading's error in the
    end [rad].
    """
    rng, legs, gyro = np.random.default_rng(0), (0, 1, 2, 3), np.array([0.0, 0.0, turn])
    for leg in legs:
        ekf.anchor(leg, FEET[leg])
    places = FEET.copy()  # in the world, around the body
    for k in range(1, round(seconds / DT) + 1):
        ekf.predict(gyro, UP, [[0.0, 0.0, -DT * turn]] * 4, DT)
        places = places @ turned(slide * DT).T
        if k % 50 == 0:
            places = FEET @ turned(turn * k * DT).T
        s = places @ turned(turn * k * DT)
        if k % 50 == 0:
            for leg in legs:
                ekf.anchor(leg, s[leg])
            continue
        ekf.innovation(legs, (s + 5e-4 * rng.normal(size=(4, 3))).tolist())
        ekf.correct(0.1)
    found = math.atan2(ekf.C[1, 0], ekf.C[0, 0]) - turn * seconds
    return math.remainder(found, 2.0 * math.pi)


def test_feet_that_slide_round_the_body_do_not_pass_for_knowledge_of_the_gyroscope():
    cfg = NoiseCfg()
    ekf = started(cfg)
    error = stand(ekf, 30.0, slide=cfg.spin)
    assert abs(error) < 2.0 * math.sqrt(ekf.P[2, 2])
    assert ekf.spin == pytest.approx(cfg.spin, rel=0.3)

    sure = started(replace(cfg, spin=1e-9))
    error = stand(sure, 30.0, slide=cfg.spin)
    assert abs(error) > 5.0 * math.sqrt(sure.P[2, 2]), "else this is no test"


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_an_unknown_heading_stays_unknown(turn):
    """What is not known of it at the start is not less later, and goes with none of what feet can tell."""
    unknown, known = started(NoiseCfg()), started(NoiseCfg())
    unknown.P[2, 2] += 1.0
    assert stand(unknown, 10.0, turn=turn) == pytest.approx(stand(known, 10.0, turn=turn), abs=1e-9)
    assert unknown.P[2, 2] - known.P[2, 2] == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(unknown.P[:2, :2], known.P[:2, :2], atol=1e-12)
