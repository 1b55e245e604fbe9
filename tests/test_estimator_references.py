"""The reference filters are fair: exact on exact readings, their covariances those of their own equations."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest

from deploy import so3
from deploy.ekf import GRAVITY
from deploy.kinematics import FOOT_RADIUS, IMU, Legs, legs
from tests.legged import DT, STANDS, Stand, stand
from tools.estimators.cheetah import Cheetah, CheetahCfg
from tools.estimators.invariant import Invariant, InvariantCfg, N
from tools.estimators.reference import Frame, Reference

REFERENCES = {"cheetah": Cheetah, "invariant": Invariant}
UP = np.array([0.0, 0.0, 1.0])
PHI, V, R, D, BW = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 21), slice(21, 24)
QUIET = InvariantCfg(gyro=0.0, acc=0.0, gyro_walk=0.0, acc_walk=0.0, contact=0.0)


def frame_of(robot: Stand) -> Frame:
    """The next tick of a still robot."""
    told = robot.readings()
    return Frame(
        DT, told["gyro"], told["acc"], legs(told["q"]), told["qd"].reshape(4, 3), told["tau"], told["force"]
    )


def begun(reference: Reference, robot: Stand, C: np.ndarray) -> Reference:
    """A reference that begins at the robot's place with attitude C."""
    s = legs(robot.q).foot - IMU
    reference.start(C, np.zeros(3), np.array([0.0, 0.0, FOOT_RADIUS - (s @ robot.C[2]).min()]), s)
    return reference


def tilt(reference: Reference, robot: Stand) -> float:
    """Angle between the estimated and the true gravity direction [deg]."""
    return math.degrees(math.acos(min(1.0, float(reference.C[2] @ robot.C[2]))))


@pytest.mark.parametrize("name", STANDS)
@pytest.mark.parametrize("kind", REFERENCES)
def test_an_exact_stand_stays_exact(kind, name):
    robot = stand(name)
    reference = begun(REFERENCES[kind](), robot, robot.C)
    contact = np.array([leg in robot.feet for leg in range(4)])
    for _ in range(250):
        reference.step(frame_of(robot), contact)
    assert tilt(reference, robot) < 1e-5
    np.testing.assert_allclose(reference.v, 0.0, atol=1e-9)
    assert (reference.r - reference.C @ IMU)[2] == pytest.approx(robot.height, abs=1e-6)


@pytest.mark.parametrize("name", STANDS)
@pytest.mark.parametrize("kind", REFERENCES)
def test_wrong_velocity_and_attitude_are_mended(kind, name):
    robot = stand(name, noise=1.0)
    reference = begun(REFERENCES[kind](), robot, so3.exp(np.radians([4.0, -4.0, 0.0])) @ robot.C)
    if isinstance(reference, Cheetah):
        reference.x[3:6] = 0.3, -0.2, 0.1
    elif isinstance(reference, Invariant):
        reference.v = np.array([0.3, -0.2, 0.1])
        reference.P[:2, :2] += 0.1**2 * np.eye(2)
        reference.P[V, V] += 0.3**2 * np.eye(3)
    assert tilt(reference, robot) > 5.0
    contact = np.array([leg in robot.feet for leg in range(4)])
    for _ in range(1500 if kind == "cheetah" else 500):  # whose attitude comes back by 1 a second
        reference.step(frame_of(robot), contact)
    assert tilt(reference, robot) < 0.6
    assert np.linalg.norm(reference.v) < 0.04


@pytest.mark.parametrize(("kind", "off"), [("cheetah", 0.005), ("invariant", 1e-9)])
def test_an_exact_motion_is_followed(kind, off):
    """A body that turns and speeds up over feet that rest; the Cheetah's attitude by its gyroscope alone."""
    exact = Cheetah(CheetahCfg(kp=0.0, ki=0.0)) if kind == "cheetah" else Invariant()
    place, v, C = np.array([0.0, 0.0, 0.3]), np.zeros(3), so3.exp(np.array([0.1, 0.2, 0.0]))
    feet = np.array([[0.2, 0.1, 0.022], [0.2, -0.1, 0.022], [-0.2, 0.1, 0.022], [-0.2, -0.1, 0.022]])
    exact.start(C, np.zeros(3), place, (feet - place) @ C)
    for k in range(400):
        w = np.array([0.5, -0.3, 0.4]) * math.cos(0.01 * k)
        f = C.T @ [0.8 * math.cos(0.01 * k), -0.5, GRAVITY]
        first, second = so3.integrals(w * DT)
        place = place + v * DT + (C @ second @ f - 0.5 * GRAVITY * UP) * DT * DT
        v = v + (C @ first @ f - GRAVITY * UP) * DT
        C = C @ so3.exp(w * DT)
        s = (feet - place) @ C
        swing = -(v @ C) - np.cross(w, s)  # joints of which each moves the foot along an axis
        leg = Legs(s + IMU, np.broadcast_to(np.eye(3), (4, 3, 3)))
        exact.step(Frame(DT, w, f, leg, swing, np.zeros(12), np.full(4, 40.0)), np.ones(4, dtype=bool))
        np.testing.assert_allclose(exact.v, v, atol=off)
        np.testing.assert_allclose(exact.C, C, atol=1e-9)
    assert np.linalg.norm(v) > 0.3
    np.testing.assert_allclose(exact.r, place, atol=max(off, 1e-9))


def test_the_attitude_of_the_cheetah_is_a_damped_oscillator():
    r"""Without noise, :math:`\ddot\theta + k_p \dot\theta + k_i \theta = 0` for a small tilt."""
    robot, cfg = stand("home"), CheetahCfg(kp=2.0, ki=0.6)
    reference = begun(Cheetah(cfg), robot, so3.exp(np.array([0.05, 0.0, 0.0])) @ robot.C)
    slow, fast = np.roots([1.0, cfg.kp, cfg.ki])
    assert np.isreal(slow), "overdamped"
    for k in range(1, 1001):
        reference.step(frame_of(robot), np.ones(4, dtype=bool))
        # theta(0) = 0.05, theta'(0) = -kp theta(0)
        t, share = k * DT, (-cfg.kp - fast) / (slow - fast)
        theta = 0.05 * (share * math.exp(slow * t) + (1.0 - share) * math.exp(fast * t))
        assert math.atan2(-reference.C[1, 2], reference.C[2, 2]) == pytest.approx(theta, abs=5e-4)


def test_the_covariance_of_the_cheetah_by_its_information():
    """A step of the published matrices in information form: P^-1 = P-^-1 + H^T R^-1 H."""
    rng, robot, reference = np.random.default_rng(0), stand("home", noise=1.0), Cheetah()
    begun(reference, robot, robot.C)
    cfg, contact = reference.cfg, np.array([True, True, False, True])
    root = rng.normal(size=(18, 18))
    P = reference.P = 0.01 * root @ root.T + 1e-3 * np.eye(18)
    doubt = np.repeat(np.where(contact, 1.0, cfg.suspect), 3)
    F, H = np.eye(18), np.zeros((28, 18))
    F[:3, 3:6] = DT * np.eye(3)
    H[:12, :3], H[:12, 6:] = np.tile(-np.eye(3), (4, 1)), np.eye(12)
    H[12:24, 3:6], H[24:, 6:] = np.tile(np.eye(3), (4, 1)), np.kron(np.eye(4), UP)
    spread = cfg.p * DT / 20, cfg.v * DT * 9.81 / 20
    Q = np.concatenate([np.repeat(spread, 3), cfg.foot * DT * doubt])
    noise = np.concatenate([cfg.place * doubt, cfg.speed * doubt, cfg.height * doubt[::3]])
    before = np.linalg.inv(F @ P @ F.T + np.diag(Q))
    reference.step(frame_of(robot), contact)
    expected = np.linalg.inv(before + H.T @ np.diag(1.0 / noise) @ H)
    np.testing.assert_allclose(reference.P, expected, rtol=1e-6, atol=1e-12)


def random_invariant(seed: int, cfg: InvariantCfg) -> Invariant:
    """Any state, all feet standing; a covariance that ties all of it."""
    rng, out = np.random.default_rng(seed), Invariant(cfg)
    out.C = so3.exp(rng.normal(size=3))
    out.v, out.r, out.d = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(4, 3))
    out.gyro_bias, out.acc_bias = 0.01 * rng.normal(size=3), 0.1 * rng.normal(size=3)
    out.stands[:] = True
    root = 0.1 * rng.normal(size=(N, N))
    out.P = root @ root.T + 1e-3 * np.eye(N)
    return out


def plus(state: Invariant, xi: np.ndarray) -> Invariant:
    """exp(xi) X, biases added: the truth if xi is the right-invariant error of a state."""
    out, turn, (left, _) = copy.deepcopy(state), so3.exp(xi[PHI]), so3.integrals(xi[PHI])
    out.C, out.v, out.r = turn @ state.C, turn @ state.v + left @ xi[V], turn @ state.r + left @ xi[R]
    out.d = state.d @ turn.T + xi[D].reshape(4, 3) @ left.T
    out.gyro_bias, out.acc_bias = state.gyro_bias + xi[BW], state.acc_bias + xi[24:]
    return out


def minus(a: Invariant, b: Invariant) -> np.ndarray:
    """The error xi (27,) of b if a is true, to first order in the rotation."""
    turn = a.C @ b.C.T
    phi = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    back = np.linalg.inv(so3.integrals(phi)[0])
    d = (a.d - b.d @ turn.T) @ back.T
    biases = a.gyro_bias - b.gyro_bias, a.acc_bias - b.acc_bias
    return np.concatenate([phi, back @ (a.v - turn @ b.v), back @ (a.r - turn @ b.r), d.reshape(12), *biases])


def reading(gyro: np.ndarray, acc: np.ndarray, dt: float, foot: np.ndarray) -> Frame:
    leg = Legs(foot, np.broadcast_to(0.2 * np.eye(3), (4, 3, 3)))
    return Frame(dt, gyro, acc, leg, np.zeros((4, 3)), np.zeros(12), np.full(4, 40.0))


@pytest.mark.parametrize("seed", range(3))
def test_the_invariant_covariance_by_finite_differences(seed):
    rng, state = np.random.default_rng(seed + 10), random_invariant(seed, QUIET)
    gyro, acc, dt, h = 2.0 * rng.normal(size=3), 10.0 * rng.normal(size=3), 1e-4, 1e-5

    def moved(start: Invariant, w: np.ndarray = gyro, f: np.ndarray = acc) -> Invariant:
        out = copy.deepcopy(start)
        out._propagate(reading(w, f, dt, np.zeros((4, 3))))
        return out

    ways = h * np.eye(N)
    F = np.array([minus(moved(plus(state, xi)), moved(plus(state, -xi))) for xi in ways]).T / (2 * h)
    np.testing.assert_allclose(moved(state).P, F @ state.P @ F.T, atol=2e-6)
    assert np.abs(F - np.eye(N)).max() > 1e-4, "it moves"

    # a reading that is high by its noise is an error the other way
    sure = copy.deepcopy(state)
    sure.cfg, sure.P = replace(QUIET, gyro=0.3, acc=2.0), np.zeros((N, N))
    by_gyro = np.array([minus(moved(state), moved(state, w=gyro + e)) for e in h * np.eye(3)]).T / h
    by_acc = np.array([minus(moved(state), moved(state, f=acc + e)) for e in h * np.eye(3)]).T / h
    expected = 0.3**2 * by_gyro @ by_gyro.T + 2.0**2 * by_acc @ by_acc.T
    np.testing.assert_allclose(moved(sure).P, expected, atol=2e-3 * expected.max())


@pytest.mark.parametrize("seed", range(3))
def test_the_invariant_update_is_the_general_one(seed):
    """One foot's kinematics against Kalman's equations with a jacobian by finite differences."""
    state, h = random_invariant(seed, QUIET), 1e-6
    state.stands[:] = [False, True, False, False]
    s = (state.d - state.r) @ state.C + 1e-5 * np.random.default_rng(seed).normal(size=(4, 3))

    def residual(at: Invariant) -> np.ndarray:
        return at.C @ s[1] + at.r - at.d[1]

    pairs = [(residual(plus(state, xi)), residual(plus(state, -xi))) for xi in h * np.eye(N)]
    H = np.array([low - high for high, low in pairs]).T / (2 * h)
    jacobian = 0.2 * state.C
    noise = QUIET.joint**2 * jacobian @ jacobian.T + 1e-8 * np.eye(3)
    K = state.P @ H.T @ np.linalg.inv(H @ state.P @ H.T + noise)
    expected, P = plus(state, K @ residual(state)), state.P - K @ H @ state.P
    state.step(reading(np.zeros(3), np.zeros(3), 0.0, s + IMU), state.stands.copy())
    np.testing.assert_allclose(minus(state, expected), 0.0, atol=1e-7)
    np.testing.assert_allclose(state.P, P, atol=1e-4 * P.max())


def test_the_invariant_filter_learns_nothing_of_its_heading():
    robot = stand("home", noise=1.0)
    reference = Invariant()
    begun(reference, robot, robot.C)
    reference.P[2, 2] = 0.1**2
    for _ in range(250):
        reference.step(frame_of(robot), np.ones(4, dtype=bool))
    assert 0.1**2 - 1e-9 < reference.P[2, 2] < 0.1**2 + 1e-3
