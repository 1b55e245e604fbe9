"""Numpy leg kinematics of the deployed part against MuJoCo, finite differences and the planning part's."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from deploy import kinematics
from deploy.kinematics import chains, legs, lowest
from hmc.go2 import model as go2


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    lower, upper = go2.Q_LOWER.double().numpy(), go2.Q_UPPER.double().numpy()
    return np.random.default_rng(0).uniform(lower, upper, (40, 12))


def test_constants_are_those_of_the_model():
    for name in ("HIP_X", "HIP_Y", "HIP_LENGTH", "LINK", "FOOT_RADIUS"):
        assert getattr(kinematics, name) == getattr(go2, name)
    np.testing.assert_array_equal(kinematics.IMU, go2.load_model().site("imu").pos)


def test_feet_are_where_mujoco_has_them(poses):
    model = go2.load_model()
    data = mujoco.MjData(model)
    data.qpos[:3] = 0.0
    for q in poses:
        data.qpos[7:] = q
        mujoco.mj_kinematics(model, data)
        feet = [data.geom(f"{leg}_foot").xpos for leg in go2.LEGS]
        np.testing.assert_allclose(legs(q).foot, feet, atol=1e-12)


def test_feet_are_those_of_the_planning_part(poses):
    points = go2.leg_points(torch.from_numpy(poses))[:, :, 2].numpy()
    np.testing.assert_allclose([legs(q).foot for q in poses], points, atol=1e-12)


def test_jacobian_by_finite_differences(poses):
    h = 1e-6
    for q in poses[:10]:
        numeric = np.zeros((4, 3, 3))
        for j in range(12):
            step = np.zeros(12)
            step[j] = h
            change = (legs(q + step).foot - legs(q - step).foot) / (2 * h)
            numeric[j // 3, :, j % 3] = change[j // 3]
            np.testing.assert_array_equal(np.delete(change, j // 3, 0), 0.0)
        np.testing.assert_allclose(legs(q).jacobian, numeric, atol=1e-9)


def test_axes_turn_the_shank_as_mujoco_does(poses):
    model = go2.load_model()
    data, velocity = mujoco.MjData(model), np.zeros(6)
    rng = np.random.default_rng(1)
    for q in poses[:10]:
        data.qpos[7:], data.qvel[6:] = q, rng.normal(size=12)
        mujoco.mj_forward(model, data)
        for leg, name in enumerate(go2.LEGS):
            ours = chains(q.tolist())[leg].shank(*data.qvel[6 + 3 * leg : 9 + 3 * leg])
            body = model.body(f"{name}_calf").id
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            np.testing.assert_allclose(ours, velocity[:3], atol=1e-12)


def test_a_leg_by_hand():
    """All joints at zero: the leg hangs straight down, its foot 2 mm behind the shank."""
    foot = legs(np.zeros(12)).foot
    np.testing.assert_allclose(foot[0], [0.1934 - 0.002, 0.0465 + 0.0955, -0.426], atol=1e-15)
    np.testing.assert_allclose(foot[3], [-0.1934 - 0.002, -0.0465 - 0.0955, -0.426], atol=1e-15)


def test_force_is_what_the_joint_torques_balance(poses):
    """In the leg's plane; across it, less by what the foot's height below the hip does to it."""
    rng = np.random.default_rng(2)
    for q in poses:
        tau = rng.normal(size=(4, 3))
        jacobian = legs(q).jacobian
        for leg, chain in enumerate(chains(q.tolist())):
            if abs(np.linalg.det(jacobian[leg])) < 1e-3:
                continue
            exact = np.linalg.solve(jacobian[leg].T, -tau[leg])
            axis, d = np.array([0.0, *chain.hip]), chain.thigh[1]
            part = np.outer(axis, axis) * (1.0 - d * d / (d * d + 0.03**2))
            np.testing.assert_allclose(chain.force(*tau[leg]), exact - part @ exact, atol=1e-6)


def test_a_leg_level_with_its_hip_tells_no_force_across():
    """Thigh and shank at opposite slopes: the hip's torque of a force across is 0 there."""
    angle = np.pi / 2 + 0.45 + 0.5 * (0.002 / go2.LINK)
    leg = chains([0.0, angle, -0.9] * 4)[0]
    assert abs(leg.thigh[1]) < 5e-3
    ahead, across, up = leg.force(1.0, 1.0, 1.0)
    assert abs(across) < 8.0, "0.005 m / (0.03 m)^2 of what the torque asks for"
    assert math.hypot(ahead, up) > 3.0


def test_a_calf_of_a_newton():
    """A leg bent to a right angle at the knee, the shank level: a newton upward at the foot, by hand."""
    (leg, *_) = chains([0.0, 0.0, -np.pi / 2] * 4)
    up = (0.0, 0.0, 1.0)
    # lever arms of an upward force about thigh and calf, both 0.213 m behind; across: the lateral offset
    tau = [-(legs(np.tile([0.0, 0.0, -np.pi / 2], 4)).jacobian[0].T @ up)[i] for i in range(3)]
    assert tau == pytest.approx([-0.0955, 0.213, 0.213], abs=1e-12)
    np.testing.assert_allclose(leg.force(*tau), up, atol=0.02)


def test_the_lowest_point_is_about_that_of_the_planning_part(poses):
    """By feet, knees and a box around trunk and head: the exact outline is at most 12 cm higher."""
    rng = np.random.default_rng(3)
    for q in poses:
        x = np.zeros(37)
        quat = rng.normal(size=4)
        x[3:7], x[7:19] = quat / np.linalg.norm(quat), q
        gap = go2.clearances(torch.from_numpy(x)[None])
        exact = min(float(part.min()) for part in gap.values())
        up = go2.vertical(torch.from_numpy(x)[None, 3:7])[0].tolist()
        found, foot = lowest(chains(q.tolist()), q.tolist(), tuple(up))
        assert -0.12 < found - exact < 0.05
        if foot:
            assert found == pytest.approx(float(gap["foot"].min()), abs=1e-9)


def test_the_lowest_point_of_a_stand_is_a_foot():
    for pose in (go2.HOME, go2.HANDSTAND, go2.FOOTSTAND):
        q = pose.double().tolist()
        up = (0.0, 0.0, 1.0) if pose is go2.HOME else (-1.0 if pose is go2.HANDSTAND else 1.0, 0.0, 0.0)
        assert lowest(chains(q), q, up)[1]
