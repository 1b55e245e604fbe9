"""Numpy leg kinematics of the deployed part against MuJoCo, finite differences and the planning part's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from deploy import kinematics
from deploy.kinematics import legs
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
        ours = (legs(q).axis @ data.qvel[6:].reshape(4, 3, 1))[:, :, 0]
        for leg, name in enumerate(go2.LEGS):
            body = model.body(f"{name}_calf").id
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            np.testing.assert_allclose(ours[leg], velocity[:3], atol=1e-12)


def test_a_leg_by_hand():
    """All joints at zero: the leg hangs straight down, its foot 2 mm behind the shank."""
    foot = legs(np.zeros(12)).foot
    np.testing.assert_allclose(foot[0], [0.1934 - 0.002, 0.0465 + 0.0955, -0.426], atol=1e-15)
    np.testing.assert_allclose(foot[3], [-0.1934 - 0.002, -0.0465 - 0.0955, -0.426], atol=1e-15)
