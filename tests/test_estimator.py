"""The estimator on exact stands and under faults."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from deploy import so3
from deploy.estimate import Estimate
from deploy.estimator import Estimator, EstimatorCfg
from deploy.kinematics import FOOT_RADIUS, IMU, legs
from deploy.start import Start, StartCfg
from tests.legged import DT, STANDS, Stand, stand


def tilt(estimate: Estimate, robot: Stand) -> float:
    """Angle between the estimated and the true gravity direction [deg]."""
    return math.degrees(math.acos(min(1.0, float(-estimate.gravity @ robot.C[2]))))


@pytest.mark.parametrize("name", STANDS)
def test_an_exact_stand_is_known_exactly(name):
    robot = stand(name)
    e = robot.run(Estimator(), 1.0)
    assert tilt(e, robot) < 1e-4
    assert e.position[2] == pytest.approx(robot.height, abs=2e-3)
    np.testing.assert_allclose(e.velocity, 0.0, atol=1e-6)
    np.testing.assert_allclose(e.C, robot.C, atol=1e-6)
    assert e.contact.tolist() == [leg in robot.feet for leg in range(4)]
    assert e.used.tolist() == e.contact.tolist()


def test_the_state_is_mujocos():
    robot = stand("footstand", gyro_bias=np.array([0.001, 0.0, 0.0]))
    e = robot.run(Estimator(), 0.5)
    np.testing.assert_array_equal(e.x[:3], e.position)
    np.testing.assert_array_equal(so3.matrix(e.x[3:7]), e.C)
    np.testing.assert_array_equal(e.x[7:19], robot.q)
    np.testing.assert_allclose(e.x[19:22], e.C @ e.velocity_body, atol=1e-12)
    np.testing.assert_allclose(e.x[22:25], robot.gyro_bias - e.gyro_bias, atol=1e-12)
    np.testing.assert_array_equal(e.x[25:], 0.0)


@pytest.mark.parametrize("name", STANDS)
def test_biases_are_found_where_they_can_be(name):
    bias = np.array([0.004, -0.003, 0.002])
    robot = stand(name, gyro_bias=bias, acc_bias=0.04 * stand(name).C[2], noise=1.0)
    e = robot.run(Estimator(), 2.0)
    sigma = np.sqrt(np.diag(e.P)[9:15])
    np.testing.assert_array_less(np.abs(bias - e.gyro_bias), 3.5 * sigma[:3])
    across = np.abs(robot.C[2]) < 0.5  # rates that turn gravity; about the vertical only the feet tell
    assert (np.abs(bias - e.gyro_bias)[across] < 0.002).all()
    assert e.acc_bias @ robot.C[2] == pytest.approx(0.04, abs=0.02)
    assert tilt(e, robot) < 0.3


@pytest.mark.parametrize("name", STANDS)
def test_wrong_velocity_and_attitude_are_mended(name):
    robot, estimator = stand(name, noise=1.0), Estimator()
    robot.run(estimator, 0.5)
    ekf = estimator.ekf
    ekf.v = ekf.v + np.array([0.3, -0.2, 0.1])
    ekf.q = so3.multiply(so3.quaternion(np.radians([4.0, -4.0, 0.0])), ekf.q)
    ekf.C = so3.matrix(ekf.q)
    ekf.P[:3, :3] += 0.1**2 * np.diag([1.0, 1.0, 0.0])
    ekf.P[3:6, 3:6] += 0.3**2 * np.eye(3)
    for leg in robot.feet:
        ekf.release(leg)  # an anchor would remember how the body stood
    assert math.degrees(math.acos(ekf.C[2] @ robot.C[2])) > 5.0
    e = robot.run(estimator, 1.5)
    assert tilt(e, robot) < 0.6
    assert np.linalg.norm(e.velocity) < 0.02


def swing(t: float) -> np.ndarray:
    """Attitude of a handstand that rocks by 0.05 rad at 2 Hz about its feet, body to world, (3, 3)."""
    return so3.exp(np.array([0.0, np.pi / 2 + 0.05 * math.sin(4.0 * math.pi * t), 0.0]))


def test_a_start_that_sways_gives_gravity_and_velocity():
    """A body that rocks on its rolling feet: position, velocity and acceleration by differences."""
    robot, h, dt = stand("handstand"), 1e-4, 0.002
    s = legs(robot.q).foot[0] - IMU

    def place(t: float) -> np.ndarray:
        rolled = 0.05 * math.sin(4.0 * math.pi * t)
        return np.array([FOOT_RADIUS * rolled, 0.0, FOOT_RADIUS]) - swing(t) @ s

    start, stood, t = Start(StartCfg(), 0.01), None, 0.03
    while stood is None:
        t += dt
        C, middle = swing(t), t - 0.5 * dt
        acc = (place(middle + h) - 2.0 * place(middle) + place(middle - h)) / h**2 + [0.0, 0.0, 9.81]
        gyro = np.array([0.0, 0.2 * math.pi * math.cos(4.0 * math.pi * middle), 0.0])
        imu = np.concatenate([gyro, swing(middle).T @ acc])
        stood = start.take(imu, dt, robot.q.tolist(), [0.0] * 12, [True, True, False, False])
    np.testing.assert_allclose(stood.force, C.T @ [0.0, 0.0, 9.81], atol=0.05)
    np.testing.assert_allclose(C @ stood.velocity, (place(t + h) - place(t - h)) / (2 * h), atol=5e-3)
    assert np.linalg.norm(stood.velocity) > 0.1, "it was moving"


def test_a_body_that_lies_has_a_start_and_one_that_tumbles_has_none():
    up, q = np.array([0.0, 0.0, 9.81]), stand("home").q.tolist()
    for push, found in ((np.zeros(3), True), (np.array([6.0, 0.0, 0.0]), False)):
        start, out = Start(StartCfg(), 0.01), []
        for k in range(130):
            imu = np.concatenate([np.zeros(3), up + push * math.sin(0.05 * k)])
            out.append(start.take(imu, 0.002, q, [0.0] * 12, [False] * 4))
        stood = [item for item in out if item is not None]
        assert bool(stood) is found
        if stood:
            np.testing.assert_allclose(stood[0].force, up, atol=1e-9)
            np.testing.assert_allclose(stood[0].velocity, 0.0, atol=1e-9)


def test_a_steady_turn_at_the_start_is_no_bias():
    start, stood = Start(StartCfg(), 0.01), None
    while stood is None:
        imu = np.array([0.0, 0.0, 0.4, 0.0, 0.0, 9.81])
        stood = start.take(imu, 0.002, stand("home").q.tolist(), [0.0] * 12, [False] * 4)
    error = np.sqrt(stood.rate_variance)
    assert error[2] > 0.4
    assert (error[:2] < 0.006).all(), "about the other axes it stands still"


def test_a_duplicate_and_an_old_tick_change_nothing():
    robot, estimator = stand("home", noise=1.0), Estimator()
    e = robot.run(estimator, 0.5)
    P = estimator.ekf.P.copy()
    for t in (e.t, e.t - 0.1, math.nan):
        assert estimator.update(t=t, **robot.readings()) is e
    np.testing.assert_array_equal(estimator.ekf.P, P)


@pytest.mark.parametrize("sensor", ["gyro", "acc", "q", "qd", "tau", "force"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_frame_without_numbers_does_no_harm(sensor, value):
    robot, estimator = stand("handstand", noise=1.0), Estimator()
    before = robot.run(estimator, 0.6)
    e = robot.run(estimator, 0.02, **{sensor: np.full(len(robot.readings()[sensor]), value)})
    assert np.isfinite(e.x).all()
    assert np.isfinite(e.P).all()
    np.testing.assert_allclose(e.velocity, before.velocity, atol=0.02)
    assert tilt(robot.run(estimator, 0.2), robot) < 0.5


def test_a_leg_without_joints_waits_and_the_others_go_on():
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.5)
    q = robot.q.copy()
    q[3:6] = math.nan
    assert robot.run(estimator, DT, q=q).used.tolist() == [True, False, True, True]
    assert robot.run(estimator, 2 * DT).used.all()


def test_a_reading_beyond_the_sensors_range_is_left_out():
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.5)
    e = robot.run(estimator, DT, gyro=np.array([0.0, 500.0, 0.0]), acc=np.array([0.0, 0.0, 9999.0]))
    assert tilt(e, robot) < 0.5
    assert np.linalg.norm(e.velocity) < 0.02


def test_a_blow_beyond_the_range_in_flight_widens_the_velocity():
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.5)
    none = {"force": np.zeros(4), "tau": np.zeros(12)}
    before = robot.run(estimator, 0.02, acc=np.zeros(3), **none)
    e = robot.run(estimator, DT, acc=np.array([0.0, 0.0, 400.0]), **none)
    assert math.sqrt(np.trace(before.velocity_covariance())) < 0.05
    # what it did is missing: 390 m/s^2 for 2 ms, 0.78 m/s
    assert 0.4 < math.sqrt(e.velocity_covariance()[2, 2]) < 0.8


def test_a_stall_widens_the_covariance_and_the_feet_mend_it():
    robot, estimator = stand("footstand", noise=1.0), Estimator()
    before = robot.run(estimator, 0.5)
    robot.t += 0.1
    during = robot.run(estimator, DT)
    assert during.t - before.t == pytest.approx(0.102)
    assert np.trace(during.tilt_covariance()) > np.trace(before.tilt_covariance())
    e = robot.run(estimator, 0.5)
    assert tilt(e, robot) < 0.6
    assert np.linalg.norm(e.velocity) < 0.02


def test_a_long_silence_begins_anew():
    robot, estimator = stand("home"), Estimator()
    robot.run(estimator, 0.5)
    robot.t += 2.0
    assert estimator.update(t=robot.t, **robot.readings()) is None
    assert robot.run(estimator, 0.5).position[2] == pytest.approx(robot.height, abs=2e-3)


def test_it_does_not_begin_on_a_turning_robot():
    robot, estimator = stand("home"), Estimator()
    for _ in range(300):
        robot.t += DT
        assert estimator.update(**{"t": robot.t, **robot.readings(), "gyro": np.array([0, 0, 2.0])}) is None
    assert robot.run(estimator, 0.6) is not None


def test_a_stuck_force_sensor():
    """One sensor reads nothing from the start: the torques show the foot, and nothing else changes."""
    robot, estimator = stand("handstand", noise=1.0), Estimator()
    force = robot.readings()["force"]
    force[0] = 0.0
    assert robot.run(estimator, 0.4, force=force).contact.tolist() == [False, True, False, False]
    e = robot.run(estimator, 0.6, force=force)
    assert e.contact.tolist() == [True, True, False, False]
    assert e.used.tolist() == e.contact.tolist()


def test_a_slipping_foot_is_left_out():
    """One foot of a stand slides at 0.2 m/s; its neighbours keep the velocity."""
    for name in ("home", "handstand"):
        robot, estimator = stand(name, noise=1.0), Estimator()
        robot.run(estimator, 0.6)
        leg, q = robot.feet[0], robot.q.copy()
        way = robot.C.T @ np.array([0.0, 0.2, 0.0])  # sideways
        uses, worst = 0, 0.0
        for _ in range(100):
            rate = np.linalg.solve(legs(q).jacobian[leg], way)
            q[3 * leg : 3 * leg + 3] += rate * DT
            qd = np.zeros(12)
            qd[3 * leg : 3 * leg + 3] = rate
            qd += 0.05 * robot.rng.normal(size=12)
            e = robot.run(estimator, DT, q=q, qd=qd)
            uses += int(e.used[leg])
            worst = max(worst, float(np.linalg.norm(e.velocity)))
        assert uses <= 10, "of 100 ticks"
        assert worst < 0.03
        robot.q = q
        e = robot.run(estimator, 0.1)
        assert e.used.tolist() == [i in robot.feet for i in range(4)], "it stands again"


def test_flight_and_landing():
    """Half a second without contact: the body is carried by the IMU, a thrown body's; then it stands."""
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.6)
    none = {"force": np.zeros(4), "tau": np.zeros(12)}
    start, speed = estimator.ekf.r[2], 0.5 * 9.81 * 0.5
    estimator.ekf.v = np.array([0.0, 0.0, speed])
    e = robot.run(estimator, 0.25, acc=np.zeros(3), **none)
    assert not e.contact.any()
    assert estimator.ekf.r[2] - start == pytest.approx(speed * 0.25 - 0.5 * 9.81 * 0.25**2, abs=0.02)
    wide = np.trace(e.velocity_covariance())
    e = robot.run(estimator, 0.24, acc=np.zeros(3), **none)
    assert np.trace(e.velocity_covariance()) > wide
    fall = 9.81 * 0.49 - speed
    assert e.velocity[2] == pytest.approx(-fall, abs=0.05)
    # the ground stops it within 20 ms, where it began
    robot.run(estimator, 0.02, acc=np.array([0.0, 0.0, 9.81 + fall / 0.02]), **none)
    e = robot.run(estimator, 0.3)
    assert e.used.all()
    assert np.linalg.norm(e.velocity) < 0.03
    assert e.position[2] == pytest.approx(robot.height, abs=0.01)


@pytest.mark.parametrize("count", [16.0, 75.0])
def test_a_sensor_that_still_tells_a_load_in_flight(count):
    """Its zero is off, or it has stuck: a foot in the air that seems to carry tells no velocity."""
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.6)
    speed = 1.0
    estimator.ekf.v = np.array([0.0, 0.0, speed])
    start = estimator.ekf.r[2]
    air = {"force": np.array([0.0, 0.0, count, 0.0]), "tau": np.zeros(12), "acc": np.zeros(3)}
    e = robot.run(estimator, 0.2, **air)
    assert e.velocity[2] == pytest.approx(speed - 9.81 * 0.2, abs=0.05)
    assert estimator.ekf.r[2] - start == pytest.approx(speed * 0.2 - 0.5 * 9.81 * 0.2**2, abs=0.02)
    assert math.sqrt(np.trace(e.velocity_covariance())) < 0.1, "and it is still sure of it"


def test_a_lost_velocity_is_found_again():
    """All feet contradict the filter, for a wrong and overconfident velocity: it widens and gives in."""
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.6)
    estimator.ekf.v = np.array([2.0, 0.0, 0.0])
    assert not robot.run(estimator, 0.02).used.any()
    e = robot.run(estimator, 1.0)
    assert e.used.all()
    assert np.linalg.norm(e.velocity) < 0.05


def test_the_same_readings_give_the_same_estimates_to_the_bit():
    ends = [stand("footstand", noise=1.0, seed=3).run(Estimator(), 0.6) for _ in range(2)]
    np.testing.assert_array_equal(ends[0].x, ends[1].x)
    np.testing.assert_array_equal(ends[0].P, ends[1].P)


def test_an_estimate_is_not_changed_by_later_ticks():
    robot, estimator = stand("home", noise=1.0), Estimator()
    e = robot.run(estimator, 0.5)
    kept = [np.copy(part) for part in (e.x, e.C, e.gyro_bias, e.acc_bias, e.contact, e.used, e.P)]
    robot.run(estimator, 0.1)
    for before, after in zip(kept, (e.x, e.C, e.gyro_bias, e.acc_bias, e.contact, e.used, e.P), strict=True):
        np.testing.assert_array_equal(before, after)


def test_without_flat_ground_the_height_is_free():
    free = stand("home", noise=1.0).run(Estimator(EstimatorCfg(flat=False)), 0.6)
    tied = stand("home", noise=1.0).run(Estimator(), 0.6)
    assert tied.P[8, 8] < 0.9 * free.P[8, 8]


def test_a_reset_does_not_forget_the_falls():
    estimator = Estimator()
    estimator.falls = 2
    estimator.reset()
    assert estimator.falls == 2


def test_a_tick_is_fast():
    """`bench.py estimator` has the bound of 0.4 ms; here only a tick that is several times slower fails."""
    robot, estimator = stand("home", noise=1.0), Estimator()
    robot.run(estimator, 0.4)
    took = []
    for _ in range(200):
        readings = robot.readings()
        began = time.thread_time()
        estimator.update(t=robot.t, **readings)
        took.append(time.thread_time() - began)
    assert np.median(took) < 2e-3
