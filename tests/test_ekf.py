"""The filter's two steps against finite differences, closed forms and the general Kalman update."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest

from deploy import so3
from deploy.ekf import BF, BW, FEET, GIVE, GRAVITY, LATE, PHI, SPIN, Ekf, N, R, V, distance, foot
from deploy.kinematics import FOOT_RADIUS
from deploy.noise import NoiseCfg

DOWN = np.array([0.0, 0.0, -GRAVITY])
NO_TURN = [[0.0] * 3] * 4
ALL = (0, 1, 2, 3)


def random_filter(seed: int = 0, stands=(True, True, False, True)) -> Ekf:
    """Any attitude, velocity, position, biases and feet; a covariance that ties all of them."""
    rng, ekf = np.random.default_rng(seed), Ekf(NoiseCfg())
    ekf.q = so3.quaternion(rng.normal(size=3))
    ekf.C = so3.matrix(ekf.q)
    ekf.v, ekf.r, ekf.p = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(4, 3))
    ekf.bw, ekf.bf = 0.01 * rng.normal(size=3), 0.1 * rng.normal(size=3)
    ekf.give, ekf.late, ekf.spin = 1e-3 * rng.normal(size=3)
    ekf.load = [60.0, 90.0, 0.0, 20.0]
    root = 0.1 * rng.normal(size=(N, N))
    ekf.P = root @ root.T + 1e-3 * np.eye(N)
    for leg in range(4):
        ekf.stands[leg] = stands[leg]
        if not stands[leg]:
            ekf.release(leg)
    return ekf


def plus(ekf: Ekf, d: np.ndarray) -> Ekf:
    """The filter with its state moved by an error (30,)."""
    out = copy.deepcopy(ekf)
    out.q = so3.multiply(so3.quaternion(d[PHI]), ekf.q)
    out.C = so3.matrix(out.q)
    out.v, out.r = ekf.v + d[V], ekf.r + d[R]
    out.bw, out.bf, out.p = ekf.bw + d[BW], ekf.bf + d[BF], ekf.p + d[FEET].reshape(4, 3)
    out.give, out.late, out.spin = ekf.give + d[GIVE], ekf.late + d[LATE], ekf.spin + d[SPIN]
    return out


def minus(a: Ekf, b: Ekf) -> np.ndarray:
    """Error (30,) of filter b if a is true."""
    phi = so3.log(so3.multiply(a.q, b.q * [1, -1, -1, -1]))
    parts = (
        phi,
        a.v - b.v,
        a.r - b.r,
        a.bw - b.bw,
        a.bf - b.bf,
        (a.p - b.p).reshape(12),
        [a.give - b.give, a.late - b.late, a.spin - b.spin],
    )
    return np.concatenate(parts)


def symmetric_positive(P: np.ndarray) -> bool:
    return bool(np.allclose(P, P.T, rtol=0, atol=1e-12) and np.linalg.eigvalsh(P).min() > 0)


@pytest.mark.parametrize("seed", range(3))
def test_transition_by_finite_differences(seed):
    rng, ekf = np.random.default_rng(seed + 10), random_filter(seed)
    gyro, acc = 2.0 * rng.normal(size=3), 10.0 * rng.normal(size=3)
    dt, h = 5e-5, 1e-5
    turn = dt * rng.normal(size=(4, 3))
    change = 10.0 * dt * rng.normal(size=6)
    numeric = np.zeros((N, N))
    for j in range(N):
        up, down = (plus(ekf, sign * h * np.eye(N)[j]) for sign in (1, -1))
        for side in (up, down):
            side.predict(gyro, acc, turn.tolist(), dt, change=change)
        numeric[:, j] = minus(up, down) / (2 * h)
    w = gyro - ekf.bw
    roll = (turn + w * dt + ekf.late * change[:3]) @ ekf.C.T
    dv = ekf.C @ (acc - ekf.bf) * dt
    F = ekf.transition(dv, 0.5 * dt * dv, roll.tolist(), change[:3], dt)
    # to first order in dt: what is left is of the second
    np.testing.assert_allclose((F - np.eye(N)) / dt, (numeric - np.eye(N)) / dt, atol=5e-3)


def standing(ekf: Ekf) -> np.ndarray:
    """Foot centres from the IMU in the body frame where the filter has them, (4, 3)."""
    return (ekf.p - ekf.r - ekf.give * np.outer(ekf.load, [0.0, 0.0, 1.0])) @ ekf.C


def test_foot_jacobian_by_finite_differences():
    ekf, h = random_filter(stands=(True,) * 4), 1e-6
    s = standing(ekf).tolist()
    numeric = np.zeros((16, N))
    for j in range(N):
        up, down = (plus(ekf, sign * h * np.eye(N)[j]) for sign in (1, -1))
        for side in (up, down):
            side.innovation(ALL, s)
        numeric[:, j] = (up._e - down._e) / (2 * h)
    ekf.innovation(ALL, s)
    np.testing.assert_allclose(-ekf._rows(ALL), numeric, atol=1e-8)


def test_distance_is_mahalanobis():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    S, e = root @ root.T, rng.normal(size=6)
    for at in (0, 3):
        part = slice(at, at + 3)
        expected = e[part] @ np.linalg.solve(S[part, part], e[part])
        assert distance(S.tolist(), e.tolist(), at) == pytest.approx(expected)


def test_a_covariance_that_is_none_refuses():
    """As rounding may leave it: no error in the control loop, but a foot that is left out."""
    S = np.diag([1.0, 1.0, -1e-9])
    assert distance(S.tolist(), [0.0, 0.0, 0.1]) > 1e6


@pytest.mark.parametrize("legs", [(0,), (1, 3), (0, 1, 3)])
def test_an_update_is_kalmans_with_the_feet_it_takes(legs):
    ekf, rng = random_filter(stands=(True,) * 4), np.random.default_rng(2)
    s, ground = rng.normal(size=(4, 3)), 0.3
    given = ekf.give * np.outer(ekf.load, [0.0, 0.0, 1.0])
    residual = (ekf.p - ekf.r - s @ ekf.C.T - given)[list(legs)]
    e = np.concatenate([residual.reshape(-1), 0.022 - ekf.p[list(legs), 2]])
    H = np.zeros((len(e), N))
    for k, leg in enumerate(legs):
        at = slice(3 * k, 3 * k + 3)
        arm = ekf.C @ standing(ekf)[leg]  # by the filter's places, not by the reading
        H[at, PHI], H[at, R], H[at, foot(leg)] = -so3.skew(arm), np.eye(3), -np.eye(3)
        H[3 * k + 2, GIVE] = ekf.load[leg]
        H[3 * len(legs) + k, foot(leg).stop - 1] = 1.0
    curved = 0.5 * (0.4 * (ekf.P[0, 0] + ekf.P[1, 1])) ** 2
    place = ekf.cfg.kinematics**2 + ekf.cfg.encoder**2  # a random filter sways
    noise = np.repeat([place + curved, ground], [3 * len(legs), len(legs)])
    S = H @ ekf.P @ H.T + np.diag(noise)
    K = ekf.P @ H.T @ np.linalg.inv(S)
    other = plus(ekf, K @ e)
    far = ekf.innovation(legs, s.tolist())
    for k in range(len(legs)):
        at = slice(3 * k, 3 * k + 3)
        assert far[k] == pytest.approx(e[at] @ np.linalg.solve(S[at, at], e[at]))
    joseph = (np.eye(N) - K @ H) @ ekf.P @ (np.eye(N) - K @ H).T + K @ np.diag(noise) @ K.T
    carry, d = np.eye(N), K @ e
    for part in (V, R, *map(foot, ALL)):
        carry[part, PHI] = -so3.skew(d[part])
    ekf.correct(ground)
    np.testing.assert_allclose(ekf.P, carry @ joseph @ carry.T, atol=1e-9)
    np.testing.assert_allclose(minus(ekf, other), 0.0, atol=1e-9)


def unknowable(ekf: Ekf) -> np.ndarray:
    """Errors of a heading and a place that are not what they seem to be, (30, 3): no reading tells them."""
    out, up = np.zeros((N, 3)), np.array([0.0, 0.0, 1.0])
    out[PHI, 0], out[V, 0], out[R, 0] = up, np.cross(up, ekf.v), np.cross(up, ekf.r)
    for leg in range(4):
        if ekf.stands[leg]:
            out[foot(leg), 0], out[foot(leg), 1:] = np.cross(up, ekf.p[leg]), np.eye(3)[:, :2]
    out[R, 1:] = np.eye(3)[:, :2]
    return out


def test_steps_and_readings_tell_nothing_of_heading_and_place():
    """To the last digit, whatever the corrections: knowledge of them would come out of nothing."""
    rng, ekf, dt = np.random.default_rng(3), random_filter(3, (True,) * 4), 0.002
    for _ in range(20):
        gyro, acc, turn = 3.0 * rng.normal(size=3), 20.0 * rng.normal(size=3), 0.01 * rng.normal(size=(4, 3))
        before, change = unknowable(ekf), rng.normal(size=6)
        ekf.predict(gyro, acc, turn.tolist(), dt, change=change)
        np.testing.assert_allclose(ekf._F @ before, unknowable(ekf), atol=1e-12)
        after, P = unknowable(ekf), ekf.P
        ekf.innovation(ALL, (standing(ekf) + 0.01 * rng.normal(size=(4, 3))).tolist())
        np.testing.assert_allclose(ekf._rows(ALL) @ after, 0.0, atol=1e-12)
        ekf.correct(1e-4)
        corrected = unknowable(ekf)
        assert np.abs(corrected - after).max() > 1e-3  # it did move
        known, still = (
            of.T @ np.linalg.solve(covariance, of) for of, covariance in ((after, P), (corrected, ekf.P))
        )
        np.testing.assert_allclose(still, known, rtol=1e-6)


def test_feet_that_take_the_load_in_turns_tell_how_they_give_way():
    """60 N go from one foot to the other and back, five times a second: each sinks by 8 um a newton."""
    ekf, give, dt = Ekf(NoiseCfg()), 8e-6, 0.002
    ekf.P = np.diag(np.repeat([1e-4, 1e-4, 1e-6, 1e-6, 1e-4, 1.0], [3, 3, 3, 3, 3, N - 15]))
    ekf.P[GIVE, GIVE], ekf.P[LATE, LATE] = ekf.cfg.give**2, ekf.cfg.late**2
    ekf.sway = [0.0] * 4
    rest = np.array([[0.2, 0.1, -0.3], [0.2, -0.1, -0.3], [0.0] * 3, [0.0] * 3])
    for i in range(1000):
        swing = 60.0 * math.sin(10.0 * math.pi * i * dt)
        ekf.load, s = [60.0 + swing, 60.0 - swing, 0.0, 0.0], rest.copy()
        s[:2, 2] -= give * np.array(ekf.load[:2])  # the body stays where it is
        if i == 0:
            ekf.anchor(0, s[0])
            ekf.anchor(1, s[1])
        ekf.predict(np.zeros(3), -DOWN, NO_TURN, dt)
        ekf.innovation((0, 1), s.tolist())
        ekf.correct(None)
    assert ekf.give == pytest.approx(give, abs=2e-7)
    assert math.sqrt(ekf.P[GIVE, GIVE]) < 0.2 * ekf.cfg.give
    np.testing.assert_allclose(ekf.v, 0.0, atol=1e-4)


def test_a_late_gyroscope_is_set_right():
    """A swing about one axis, w = 3 sin(10 t), read 1 ms late: the angle is that of now."""
    right, wrong, dt, lag = Ekf(NoiseCfg()), Ekf(NoiseCfg()), 0.002, 0.001
    right.late, last = lag, np.zeros(3)
    for k in range(79):  # until the rate is at its largest, 3 rad/s
        w = np.array([0.3 * (math.cos(10 * (k * dt - lag)) - math.cos(10 * ((k + 1) * dt - lag))) / dt, 0, 0])
        w[0] = 0.0 if k == 0 else w[0]
        for ekf in (right, wrong):
            ekf.predict(w, -DOWN, NO_TURN, dt, change=np.concatenate([w - last, np.zeros(3)]))
        last = w.copy()
    angle = 0.3 * (1.0 - math.cos(10 * 79 * dt))
    found, lagging = (so3.log(ekf.q)[0] for ekf in (right, wrong))
    assert abs(found - angle) < 2e-4
    assert lagging - angle == pytest.approx(-3.0 * lag, abs=2e-4)


def test_shocks_between_readings_are_no_surprise():
    """Blows of 100 m/s^2 along a body's x for 2 to 10 ms, read as they are every 2 ms."""
    rng, dt, nees = np.random.default_rng(0), 0.002, []
    for _ in range(40):
        ekf, edges = Ekf(NoiseCfg()), np.sort(rng.uniform(0.0, 0.1, 6))
        ekf.q = so3.quaternion(np.array([0.0, 0.0, math.pi / 2]))  # its x is the world's y
        ekf.C, ekf.P = so3.matrix(ekf.q), 1e-12 * np.eye(N)
        last = -DOWN
        for k in range(1, 51):
            hit = bool(np.searchsorted(edges, k * dt) % 2)  # between every first and second edge
            acc = -DOWN + [100.0 * hit, 0.0, 0.0]
            ekf.predict(np.zeros(3), acc, NO_TURN, dt, change=np.concatenate([np.zeros(3), acc - last]))
            last = acc
        error = 100.0 * (edges[1::2] - edges[::2]).sum() - ekf.v[1]
        nees.append(error**2 / ekf.P[V, V][1, 1])
    assert 0.3 < np.mean(nees) < 6.0
    assert ekf.P[V, V][2, 2] < 0.1 * ekf.P[V, V][1, 1], "along the blows alone"


def test_a_thrown_body_flies_a_parabola():
    ekf = Ekf(NoiseCfg())
    ekf.v, gyro = np.array([1.0, -0.5, 3.0]), np.array([1.0, 5.0, -2.0])
    for _ in range(250):
        ekf.predict(gyro, np.zeros(3), NO_TURN, 0.002)
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
        ekf.predict(np.array([0.0, 0.0, w]), acc, NO_TURN, period / steps)
    np.testing.assert_allclose(ekf.r, [radius, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(ekf.v, [0.0, w * radius, 0.0], atol=1e-9)


def test_steps_of_any_length_agree():
    one, many = random_filter(3), random_filter(3)
    gyro, acc = np.array([1.0, -2.0, 0.5]), np.array([0.3, 8.0, 5.0])
    one.predict(gyro, acc, NO_TURN, 0.1)
    for _ in range(50):
        many.predict(gyro, acc, NO_TURN, 0.002)
    np.testing.assert_allclose(minus(one, many)[:9], 0.0, atol=1e-12)


def test_a_gap_between_unlike_readings_widens_the_covariance_by_half_of_what_they_differ():
    plain, wide = random_filter(), random_filter()
    gyro, acc, jump = np.zeros(3), -DOWN, np.array([1.0, 2.0, 3.0, 40.0, 50.0, 60.0])
    plain.predict(gyro, acc, NO_TURN, 0.004, 0.002)
    wide.predict(gyro, acc, NO_TURN, 0.004, 0.002, jump)
    more = np.diag(wide.P - plain.P)
    np.testing.assert_allclose(more[:6], (0.001 * jump) ** 2, atol=1e-12)
    np.testing.assert_array_equal(more[9:], 0.0)


def test_a_standing_foot_rolls_and_a_hanging_one_does_not():
    ekf = Ekf(NoiseCfg())
    ekf.stands[:] = [True, False, True, False]
    ekf.bw[:] = 0.0
    turn = [[0.0, 0.3, 0.0]] * 4  # about the body's y axis, left: forward
    ekf.predict(np.zeros(3), -DOWN, turn, 0.002)
    np.testing.assert_allclose(ekf.p[[0, 2]], [[0.3 * FOOT_RADIUS, 0, 0]] * 2, atol=1e-15)
    np.testing.assert_array_equal(ekf.p[[1, 3]], 0.0)


def test_a_foot_that_has_just_landed_walks_more():
    firm, fresh = random_filter(), random_filter()
    loose = [(1e-3, 4e-3), (1e-3, 4e-3), (1e-3, 4e-3), (0.0, 0.0)]
    firm.predict(np.zeros(3), -DOWN, NO_TURN, 0.002)
    fresh.predict(np.zeros(3), -DOWN, NO_TURN, 0.002, loose=loose)
    more = np.diag(fresh.P - firm.P)[FEET].reshape(4, 3)
    walked = [2e-6, 2e-6, 8e-6]
    np.testing.assert_allclose(more, [walked, walked, [0] * 3, [0] * 3], atol=1e-15)


def test_body_and_standing_feet_may_rise_together():
    plain, rising = random_filter(), random_filter()
    plain.cfg, rising.cfg = replace(plain.cfg, rise=0.0), replace(plain.cfg, rise=0.1)
    for ekf in (plain, rising):
        ekf.predict(np.zeros(3), -DOWN, NO_TURN, 0.002)
    up = np.zeros(N)
    up[[8, 17, 20, 26]] = 1.0  # of the third foot, which hangs, nothing is known
    np.testing.assert_allclose(rising.P - plain.P, 2e-5 * np.outer(up, up), atol=1e-15)


def test_a_shank_that_turns_widens_its_foot_by_how_far_from_where_it_was_and_once():
    """Out by 0.3 rad, back, and out by 0.4 rad: as a single turn of 0.4 rad."""
    cfg, there = NoiseCfg(), np.zeros((4, 3))
    once, often = (random_filter() for _ in range(2))
    for ekf in (once, often):
        ekf.C, ekf.q, ekf.bw = np.eye(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    there[:, 1] = 0.4
    still = copy.deepcopy(once)
    still.predict(np.zeros(3), -DOWN, NO_TURN, 0.002)
    for turn in (0.3, -0.3, 0.4):
        step = np.zeros((4, 3))
        step[:, 1] = turn
        often.P = random_filter().P
        often.predict(np.zeros(3), -DOWN, step.tolist(), 0.002)
    assert often._turned[0][3] == pytest.approx(0.4**2)
    once.predict(np.zeros(3), -DOWN, there.tolist(), 0.002)
    # in the vertical, which does not roll, the turn is all that is new
    vertical = [foot(leg).stop - 1 for leg in (0, 1, 3)]
    more = np.diag(once.P - still.P)[vertical]
    np.testing.assert_allclose(more, (cfg.bend * 0.4) ** 2, rtol=1e-9)
    np.testing.assert_allclose(
        np.diag(often.P - still.P)[vertical], cfg.bend**2 * (0.4**2 - 0.3**2), rtol=1e-9
    )


def test_an_anchor_is_an_update_of_a_foot_of_which_nothing_was_known():
    ekf, s = random_filter(4, stands=(True, False, False, False)), np.array([0.2, -0.1, -0.3])
    other = copy.deepcopy(ekf)
    ekf.anchor(2, s)
    # its Jacobian has the arm where the filter has the foot: about right
    other.P[foot(2), foot(2)], other.p[2] = 1e4 * np.eye(3), ekf.p[2] + 1e-3
    other.stands[2] = True
    other.innovation((2,), [[0.0] * 3, [0.0] * 3, s.tolist()])
    other.correct(None)
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
    ekf.P[SPIN, SPIN] = ekf.cfg.spin**2  # feet that might run round at 1 rad/s are beyond anything linear
    s = np.array([[0.2, 0.15, -0.3], [0.2, -0.15, -0.3], [-0.2, 0.15, -0.3], [-0.2, -0.15, -0.3]])
    for k in range(1000):
        ekf.predict(
            rng.normal(size=3), rng.normal(size=3) - DOWN, (0.01 * rng.normal(size=(4, 3))).tolist(), 0.002
        )
        leg = int(rng.integers(4))
        if k % 20 == 0:
            ekf.release(leg) if ekf.stands[leg] else ekf.anchor(leg, s[leg])
        if legs := tuple(np.flatnonzero(ekf.stands).tolist()):
            ekf.innovation(legs, (s + 1e-3 * rng.normal(size=(4, 3))).tolist())
            ekf.correct(1e-4)
        if k % 100 == 0:
            assert symmetric_positive(ekf.P)
    assert np.isfinite(ekf.P).all()
    assert np.linalg.norm(ekf.q) == pytest.approx(1.0)
