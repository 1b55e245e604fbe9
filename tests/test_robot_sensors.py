"""The stand-in's sensors: exact where they are told to be, and errors of the sizes that they are told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from deploy import so3
from deploy.kinematics import IMU
from deploy.remote import Button, Remote, unpack
from tests.robots import STAND, last, ready
from tools.robot.sensors import CLEAN, Battery, Feet, Imu, Sensors, roll_pitch_yaw
from tools.robot.standin import PERIOD, ideal


def test_clean_state_is_the_truth() -> None:
    robot = ready()
    state, truth = last(robot, [STAND], 100), robot.truth()
    assert state.crc_ok
    assert (state.tick, truth.tick) == (200, 200)
    assert state.q == pytest.approx(truth.qpos[7:], abs=1e-6)
    assert state.dq == pytest.approx(truth.qvel[6:], abs=1e-6)
    assert state.tau == pytest.approx(truth.torque, abs=1e-5)
    assert state.quat == pytest.approx(truth.qpos[3:7], abs=1e-6)
    assert state.gyro == pytest.approx(truth.qvel[3:6], abs=1e-3)
    assert state.foot_force.tolist() == np.round(truth.foot_force).tolist()
    assert truth.foot_force.sum() == pytest.approx(15.2 * 9.81, rel=0.1)
    assert state.acc == pytest.approx([0, 0, 9.81], abs=0.5)


def test_imu_adds_up_to_how_the_robot_turned_and_sped_up() -> None:
    """Also across a shock, which is over between two readings: the robot is dropped onto its feet."""
    robot = ready()
    robot.push([0.0, 0.0, 500.0], 0.1)
    last(robot, [STAND], 60)
    begin, place = robot.truth(), np.array([*IMU])
    turn, gained, peak = begin.qpos[3:7].copy(), np.zeros(3), 0.0
    for _ in range(300):
        state, C = last(robot, [STAND], 1), so3.matrix(turn)
        gained += PERIOD * (C @ state.acc - [0.0, 0.0, 9.81])
        turn, _ = so3.turned(turn, PERIOD * state.gyro)
        peak = max(peak, float(np.linalg.norm(state.acc)))
    end = robot.truth()
    velocity = [
        each.qvel[:3] + so3.matrix(each.qpos[3:7]) @ np.cross(each.qvel[3:6], place) for each in (begin, end)
    ]
    assert peak > 30.0, "no shock"
    assert np.abs(so3.log(so3.multiply(turn * [1, -1, -1, -1], end.qpos[3:7]))).max() < 1e-4
    assert gained == pytest.approx(velocity[1] - velocity[0], abs=0.02)


def test_imu_errors_have_their_sizes() -> None:
    cfg = replace(CLEAN, gyro=0.01, acc=0.1, gyro_bias=0.005, acc_bias=0.05, yaw_drift=0.01)
    imu = Imu(cfg, np.random.default_rng(0))
    level, zero = np.array([1.0, 0, 0, 0]), np.zeros(3)
    reads = [imu.read(i * PERIOD, PERIOD, level, zero, zero) for i in range(5000)]
    quat, gyro, acc = (np.array(part) for part in zip(*reads, strict=True))
    assert gyro.std(0) == pytest.approx(0.01, rel=0.05)
    assert acc.std(0) == pytest.approx(0.1, rel=0.05)
    assert 0.0005 < np.abs(gyro.mean(0)).max() < 0.0056
    assert 0.005 < np.abs(acc.mean(0)).max() < 0.056
    drift = roll_pitch_yaw(quat[-1])[2] / (4999 * PERIOD)
    assert 0.0005 < abs(drift) <= 0.01


def test_bias_walks() -> None:
    cfg, zero = replace(CLEAN, gyro_walk=0.1), np.zeros(3)
    ends = [
        [imu.read(i * 0.01, 0.01, np.array([1.0, 0, 0, 0]), zero, zero) for i in range(400)][-1][1]
        for imu in (Imu(cfg, np.random.default_rng(seed)) for seed in range(60))
    ]
    assert np.std(ends) == pytest.approx(0.1 * math.sqrt(4.0), rel=0.15)


def test_slow_imu_repeats_itself() -> None:
    imu = Imu(replace(Sensors(), rate=200.0), np.random.default_rng(0))
    level, zero = np.array([1.0, 0, 0, 0]), np.zeros(3)
    reads = [tuple(imu.read(i * PERIOD, PERIOD, level, zero, zero)[1]) for i in range(500)]
    assert len(set(reads)) == 200  # a second


def test_encoders_count() -> None:
    robot = ready(replace(ideal(), sensors=replace(CLEAN, encoder=0.01)))
    state = last(robot, [STAND], 10)
    assert state.q == pytest.approx(np.round(state.q / 0.01) * 0.01, abs=1e-6)
    assert np.abs(state.q - robot.truth().qpos[7:]).max() <= 0.005 + 1e-6


def test_feet() -> None:
    """Counts are linear in the force; stuck feet and the message's range hold whatever the force."""
    feet = Feet(replace(CLEAN, foot_scale=0.3, foot_offset=15.0), np.random.default_rng(0))
    air, low, high = (feet.read(np.full(4, force), PERIOD) for force in (0.0, 1000.0, 2000.0))
    assert (np.abs(air) <= 15).all()
    assert len(set(air)) > 1
    assert ((low - air >= 700) & (low - air <= 1300)).all()
    assert high - low == pytest.approx(low - air, abs=1)
    feet.stuck = {2: 33}
    assert feet.read(np.full(4, 500.0), PERIOD)[2] == 33
    assert feet.read(np.full(4, 1e9), PERIOD).max() == 2**15 - 1

    drifting = Feet(replace(CLEAN, foot_drift=2.0), np.random.default_rng(0))
    walked = [drifting.read(np.zeros(4), 1.0) for _ in range(100)]
    assert 5 < np.std(walked[-1]) < 60  # 2 counts/sqrt(s) for 100 s: 20


def test_roll_pitch_yaw_by_hand() -> None:
    half = math.sqrt(0.5)
    assert roll_pitch_yaw(np.array([half, half, 0, 0])) == pytest.approx([math.pi / 2, 0, 0])
    assert roll_pitch_yaw(np.array([half, 0, half, 0]))[1] == pytest.approx(math.pi / 2, abs=1e-7)
    assert roll_pitch_yaw(np.array([half, 0, 0, half])) == pytest.approx([0, 0, math.pi / 2])


def test_battery_by_hand() -> None:
    battery = Battery(charge=50.0)
    assert battery.voltage == pytest.approx(8 * 3.7)
    battery.draw(np.zeros(12), np.zeros(12), 3600.0)
    assert battery.current == pytest.approx(-60 / 29.6)
    assert battery.charge == int(50 - 100 * 60 / 29.6 / 15)


def test_remote_travels() -> None:
    robot = ready()
    robot.remote = Remote(Button.L2 | Button.B, lx=0.5)
    assert unpack(last(robot, []).remote) == robot.remote
