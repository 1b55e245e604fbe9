"""The filter's two steps against finite differences, closed forms and the general Kalman update."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from deploy import so3
from deploy.ekf import BF, BW, GRAVITY, PHI, Ekf, N, NoiseCfg, R, V, foot
from deploy.kinematics import FOOT_RADIUS

DOWN = np.array([0.0, 0.0, -GRAVITY])


def random_filter(seed: int = 0, stands=(True, True, False, True)) -> Ekf:
    """Any attitude, velocity, position, biases and feet; a covariance that ties all of them."""
    rng, ekf = np.random.default_rng(seed), Ekf(NoiseCfg())
    ekf.q = so3.quaternion(rng.normal(size=3))
    ekf.C = so3.matrix(ekf.q)
    ekf.v, ekf.r, ekf.p = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(4, 3))
    ekf.bw, ekf.bf = 0.01 * rng.normal(size=3), 0.1 * rng.normal(size=3)
    root = 0.1 * rng.normal(size=(N, N))
    ekf.P = root @ root.T + 1e-3 * np.eye(N)
    for leg in range(4):
        ekf.stands[leg] = stands[leg]
        if not stands[leg]:
            ekf.release(leg)
    return ekf


def plus(ekf: Ekf, d: np.ndarray) -> Ekf:
    """The filter with its state moved by an error (27,)."""
    out = copy.deepcopy(ekf)
    out.q = so3.multiply(so3.quaternion(d[PHI]), ekf.q)
    out.C = so3.matrix(out.q)
    out.v, out.r = ekf.v + d[V], ekf.r + d[R]
    out.bw, out.bf, out.p = ekf.bw + d[BW], ekf.bf + d[BF], ekf.p + d[15:].reshape(4, 3)
    return out


def minus(a: Ekf, b: Ekf) -> np.ndarray:
    """Error (27,) of filter b if a is true."""
    phi = so3.log(so3.multiply(a.q, b.q * [1, -1, -1, -1]))
    parts = (phi, a.v - b.v, a.r - b.r, a.bw - b.bw, a.bf - b.bf, (a.p - b.p).reshape(12))
    return np.concatenate(parts)


def symmetric_positive(P: np.ndarray) -> bool:
    return bool(np.allclose(P, P.T, rtol=0, atol=1e-12) and np.linalg.eigvalsh(P).min() > 0)


@pytest.mark.parametrize("seed", range(3))
def test_transition_by_finite_differences(seed):
    rng, ekf = np.random.default_rng(seed + 10), random_filter(seed)
    gyro, acc = 2.0 * rng.normal(size=3), 10.0 * rng.normal(size=3)
    dt, h = 1e-4, 1e-5
    turn = dt * rng.normal(size=(4, 3))
    numeric = np.zeros((N, N))
    for j in range(N):
        up, down = (plus(ekf, sign * h * np.eye(N)[j]) for sign in (1, -1))
        for side in (up, down):
            side.predict(gyro, acc, turn, dt)
        numeric[:, j] = minus(up, down) / (2 * h)
    w = gyro - ekf.bw
    F = ekf.transition(w, acc - ekf.bf, (turn + w * dt) @ ekf.C.T, dt)
    # to first order in dt: what is left is of the second
    np.testing.assert_allclose((F - np.eye(N)) / dt, (numeric - np.eye(N)) / dt, atol=5e-3)


def test_foot_jacobian_by_finite_differences():
    ekf, h = random_filter(stands=(True,) * 4), 1e-6
    s = np.random.default_rng(1).normal(size=(4, 3))
    none = np.zeros((4, 3, 3))
    numeric = np.zeros((16, N))
    for j in range(N):
        up, down = (plus(ekf, sign * h * np.eye(N)[j]) for sign in (1, -1))
        for side in (up, down):
            side.innovation(s, none)
        numeric[:, j] = (up._e - down._e) / (2 * h)
    ekf.innovation(s, none)
    np.testing.assert_allclose(-ekf._H, numeric, atol=1e-8)


def test_innovation_covariance_holds_the_noise():
    ekf, rng = random_filter(stands=(True,) * 4), np.random.default_rng(2)
    root = rng.normal(size=(4, 3, 3))
    s, noise = rng.normal(size=(4, 3)), root @ root.transpose(0, 2, 1)
    e, S = ekf.innovation(s, noise)
    for leg in range(4):
        H = ekf._H[3 * leg : 3 * leg + 3]
        np.testing.assert_allclose(S[leg], H @ ekf.P @ H.T + noise[leg], atol=1e-12)
        np.testing.assert_allclose(e[leg], ekf.p[leg] - ekf.r - ekf.C @ s[leg], atol=1e-12)


def test_a_thrown_body_flies_a_parabola():
    ekf = Ekf(NoiseCfg())
    ekf.v, gyro = np.array([1.0, -0.5, 3.0]), np.array([1.0, 5.0, -2.0])
    for _ in range(250):
        ekf.predict(gyro, np.zeros(3), np.zeros((4, 3)), 0.002)
    np.testing.assert_allclose(ekf.r, [0.5, -0.25, 1.5 - 0.5 * GRAVITY * 0.25], atol=1e-12)
    np.testing.assert_allclose(ekf.v, [1.0, -0.5, 3.0 - GRAVITY * 0.5], atol=1e-12)
    np.testing.assert_allclose(ekf.C, so3.exp(0.5 * gyro), atol=1e-12)


def test_a_body_on_a_carousel_comes_round():
    """Constant rotation and constant acceleration in the body frame: a circle of radius a / w^2."""
    w, radius, steps = 3.0, 0.7, 500
    period = 2 * math.pi / w
    ekf = Ekf(NoiseCfg())
    ekf.r, ekf.v = np.array([radius, 0.0, 1.0]), np.array([0.0, w * radius, 0.0])
    acc = np.array([-w * w * radius, 0.0, GRAVITY])
    for k in range(steps):
        if k == steps // 4:
            np.testing.assert_allclose(ekf.r, [0.0, radius, 1.0], atol=1e-9)
        ekf.predict(np.array([0.0, 0.0, w]), acc, np.zeros((4, 3)), period / steps)
    np.testing.assert_allclose(ekf.r, [radius, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(ekf.v, [0.0, w * radius, 0.0], atol=1e-9)


def test_steps_of_any_length_agree():
    one, many = random_filter(3), random_filter(3)
    gyro, acc = np.array([1.0, -2.0, 0.5]), np.array([0.3, 8.0, 5.0])
    one.predict(gyro, acc, np.zeros((4, 3)), 0.1)
    for _ in range(50):
        many.predict(gyro, acc, np.zeros((4, 3)), 0.002)
    np.testing.assert_allclose(minus(one, many)[:9], 0.0, atol=1e-12)


def test_a_standing_foot_rolls_and_a_hanging_one_does_not():
    ekf = Ekf(NoiseCfg())
    ekf.stands[:] = [True, False, True, False]
    ekf.bw[:] = 0.0
    turn = np.zeros((4, 3))
    turn[:, 1] = 0.3  # about the body's y axis, left: forward
    ekf.predict(np.zeros(3), -DOWN, turn, 0.002)
    np.testing.assert_allclose(ekf.p[[0, 2]], [[0.3 * FOOT_RADIUS, 0, 0]] * 2, atol=1e-15)
    np.testing.assert_array_equal(ekf.p[[1, 3]], 0.0)


def test_an_anchor_is_an_update_of_a_foot_of_which_nothing_was_known():
    ekf, s = random_filter(4, stands=(True, False, False, False)), np.array([0.2, -0.1, -0.3])
    root = 0.01 * np.random.default_rng(5).normal(size=(3, 3))
    noise = root @ root.T + 1e-6 * np.eye(3)
    other = copy.deepcopy(ekf)
    ekf.anchor(2, s, noise)
    other.P[foot(2), foot(2)] = 1e4 * np.eye(3)
    other.stands[2] = True
    arms, noises = np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))
    arms[2], noises[2] = s, noise
    other.innovation(arms, noises)
    other.correct(np.array([False, False, True, False]), None)
    np.testing.assert_allclose(ekf.p[2], other.p[2], atol=1e-3)
    np.testing.assert_allclose(ekf.P, other.P, atol=1e-4)


def test_standing_still_ties_tilt_to_the_accelerometers_bias():
    """Level, of unknown tilt: what the accelerometer's bias may be in g is what the tilt may be."""
    cfg = NoiseCfg()
    ekf = Ekf(cfg)
    ekf.P[BF, BF] = cfg.acc_bias**2 * np.eye(3)
    ekf.observe_force(-DOWN, np.full(3, 1e-8))
    tilt = np.sqrt(np.diag(ekf.P)[:2])
    np.testing.assert_allclose(tilt, cfg.acc_bias / GRAVITY, rtol=1e-3)
    # tilted by phi about x, the body's y axis points up and reads g phi: a bias of the other sign
    assert ekf.P[0, 13] / (tilt[0] * math.sqrt(ekf.P[13, 13])) == pytest.approx(-1.0, abs=1e-3)
    assert ekf.P[1, 12] / (tilt[1] * math.sqrt(ekf.P[12, 12])) == pytest.approx(1.0, abs=1e-3)
    assert ekf.P[14, 14] < 1e-7, "the length of gravity is known"


def test_covariance_stays_symmetric_and_positive():
    ekf, rng = Ekf(NoiseCfg()), np.random.default_rng(6)
    s = np.array([[0.2, 0.15, -0.3], [0.2, -0.15, -0.3], [-0.2, 0.15, -0.3], [-0.2, -0.15, -0.3]])
    noise = np.tile(1e-7 * np.eye(3), (4, 1, 1))
    for k in range(1000):
        ekf.predict(rng.normal(size=3), rng.normal(size=3) - DOWN, 0.01 * rng.normal(size=(4, 3)), 0.002)
        leg = int(rng.integers(4))
        if k % 20 == 0:
            ekf.release(leg) if ekf.stands[leg] else ekf.anchor(leg, s[leg], noise[leg])
        if ekf.stands.any():
            ekf.innovation(s + 1e-3 * rng.normal(size=(4, 3)), noise)
            ekf.correct(ekf.stands, 1e-4)
        if k % 100 == 0:
            assert symmetric_positive(ekf.P)
    assert np.isfinite(ekf.P).all()
    assert np.linalg.norm(ekf.q) == pytest.approx(1.0)
