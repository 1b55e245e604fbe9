"""The Go2 model against the published figures, compiled on their own without our XML.

Source: MuJoCo Menagerie's unitree_go2/go2.xml (BSD-3-Clause), from Unitree's URDF. The published inertia
is given by principal moments and axes; bodies, joints and limits are repeated here as printed.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from hmc.go2.model import load_model

# mass [kg], centre of mass [m] and principal axes (w, x, y, z), principal moments [kg m^2]
BASE = (6.921, [0.021112, 0, -0.005366], [-0.000543471, 0.713435, -0.00173769, 0.700719],
        [0.107027, 0.0980771, 0.0244531])  # fmt: skip
HIP = (0.678, {
    "FL": ([-0.0054, 0.00194, -0.000105], [0.497014, 0.499245, 0.505462, 0.498237]),
    "FR": ([-0.0054, -0.00194, -0.000105], [0.498237, 0.505462, 0.499245, 0.497014]),
    "RL": ([0.0054, 0.00194, -0.000105], [0.505462, 0.498237, 0.497014, 0.499245]),
    "RR": ([0.0054, -0.00194, -0.000105], [0.499245, 0.497014, 0.498237, 0.505462]),
}, [0.00088403, 0.000596003, 0.000479967])  # fmt: skip
THIGH = (1.152, {
    "L": ([-0.00374, -0.0223, -0.0327], [0.829533, 0.0847635, -0.0200632, 0.551623]),
    "R": ([-0.00374, 0.0223, -0.0327], [0.551623, -0.0200632, 0.0847635, 0.829533]),
}, [0.00594973, 0.00584149, 0.000878787])  # fmt: skip
CALF = (0.241352, {
    "L": ([0.00629595, -0.000622121, -0.141417], [0.710672, 0.00154099, -0.00450087, 0.703508]),
    "R": ([0.00629595, 0.000622121, -0.141417], [0.703508, -0.00450087, 0.00154099, 0.710672]),
}, [0.0014901, 0.00146356, 5.31397e-05])  # fmt: skip
LEGS = ("FL", "FR", "RL", "RR")
LIMITS = {  # [rad]
    "hip": dict.fromkeys("FR", (-1.0472, 1.0472)),
    "thigh": {"F": (-1.5708, 3.4907), "R": (-0.5236, 4.5379)},
    "calf": dict.fromkeys("FR", (-2.7227, -0.83776)),
}
ARMATURE = 0.01  # kg m^2
FOOT_OFFSET, FOOT_RADIUS = [-0.002, 0, -0.213], 0.022  # m, in the calf's frame
TOTAL_MASS = 6.921 + 4 * (0.678 + 1.152 + 0.241352)  # 15.2064 kg


def offset(leg: str, link: str) -> list[float]:
    """Published place of a link's frame in its parent's [m]."""
    front, left = 1 if leg[0] == "F" else -1, 1 if leg[1] == "L" else -1
    return {
        "hip": [front * 0.1934, left * 0.0465, 0.0],
        "thigh": [0.0, left * 0.0955, 0.0],
        "calf": [0.0, 0.0, -0.213],
    }[link]


def inertial(leg: str, link: str) -> tuple[float, list[float], list[float], list[float]]:
    """Published mass, centre of mass, axes and principal moments of a link."""
    mass, places, moments = {"hip": HIP, "thigh": THIGH, "calf": CALF}[link]
    place, axes = places[leg if link == "hip" else leg[1]]
    return mass, place, axes, moments


@pytest.fixture(scope="module")
def published() -> mujoco.MjModel:
    """The published figures as a model without geoms, actuators or losses."""

    def fill(body: mujoco.MjsBody, mass: float, place: list[float], axes: list[float], moments: list[float]):
        body.mass, body.ipos, body.iquat, body.inertia = mass, place, axes, moments
        body.explicitinertial = True

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    base = spec.worldbody.add_body(name="base", pos=[0, 0, 0.445])
    base.add_freejoint(name="base")
    fill(base, *BASE)
    for leg in LEGS:
        body = base
        for link in ("hip", "thigh", "calf"):
            body = body.add_body(name=f"{leg}_{link}", pos=offset(leg, link))
            fill(body, *inertial(leg, link))
            body.add_joint(
                name=f"{leg}_{link}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=[1, 0, 0] if link == "hip" else [0, 1, 0],
                range=LIMITS[link][leg[0]],
                armature=ARMATURE,
            )
    return spec.compile()


@pytest.fixture(scope="module")
def ours() -> mujoco.MjModel:
    return load_model()


def inertia_tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Inertia about the centre of mass, in the body's frame [kg m^2], (3, 3)."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, model.body(body).iquat)
    turn = flat.reshape(3, 3)
    return turn @ np.diag(model.body(body).inertia) @ turn.T


BODIES = ["base", *(f"{leg}_{link}" for leg in LEGS for link in ("hip", "thigh", "calf"))]


def test_sizes_and_order(ours):
    assert (ours.nq, ours.nv, ours.nu) == (19, 18, 12)
    joints = [ours.joint(i).name for i in range(1, 13)]
    assert joints == BODIES[1:]
    assert [ours.actuator(i).name for i in range(12)] == joints
    assert (ours.actuator_trnid[:, 0] == np.arange(1, 13)).all()


def test_total_mass(ours):
    assert ours.body_mass.sum() == pytest.approx(TOTAL_MASS, abs=1e-9)
    assert abs(TOTAL_MASS - 15.21) < 0.005


@pytest.mark.parametrize("body", BODIES)
def test_each_link(ours, published, body):
    mine, theirs = ours.body(body), published.body(body)
    assert mine.mass[0] == pytest.approx(theirs.mass[0], abs=1e-9)
    np.testing.assert_allclose(mine.ipos, theirs.ipos, atol=1e-9)
    np.testing.assert_allclose(inertia_tensor(ours, body), inertia_tensor(published, body), atol=1e-9)
    if body != "base":
        np.testing.assert_allclose(mine.pos, theirs.pos, atol=1e-9)
        np.testing.assert_allclose(mine.quat, [1, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("joint", BODIES[1:])
def test_each_joint(ours, published, joint):
    mine, theirs = ours.joint(joint), published.joint(joint)
    np.testing.assert_allclose(mine.range, theirs.range, atol=1e-9)
    np.testing.assert_allclose(mine.axis, theirs.axis, atol=1e-12)
    np.testing.assert_allclose(mine.pos, 0.0, atol=1e-12)
    assert ours.jnt_limited[ours.joint(joint).id]
    assert ours.dof_armature[mine.dofadr[0]] == pytest.approx(ARMATURE)


@pytest.mark.parametrize("leg", LEGS)
def test_each_foot(ours, leg):
    foot = ours.geom(f"{leg}_foot")
    assert ours.body(foot.bodyid[0]).name == f"{leg}_calf"
    np.testing.assert_allclose(foot.pos, FOOT_OFFSET, atol=1e-9)
    assert foot.size[0] == pytest.approx(FOOT_RADIUS)
    assert foot.friction[0] == pytest.approx(0.8)


@pytest.mark.parametrize("contacts", ["all", "body", "feet"])
def test_what_the_floor_holds_up(contacts):
    """Dropped on its back with its legs folded below it, a robot rests on what may touch the ground."""
    model = load_model(contacts=contacts)
    data = mujoco.MjData(model)
    data.qpos[2:7], data.qpos[7:] = [0.3, 0, 1, 0, 0], np.tile([0.0, 1.4, -2.7], 4)
    data.ctrl[:] = data.qpos[7:]
    mujoco.mj_step(model, data, 300)
    held = {model.geom(geom).name for contact in data.contact for geom in contact.geom} - {"floor"}
    assert (data.qpos[2] > 0.04) == (contacts != "feet"), "else its trunk is below the floor"
    assert ("trunk" in held) == (contacts != "feet")
    assert not any("thigh" in name or "calf" in name for name in held) or contacts == "all"


@pytest.mark.parametrize("contacts", ["all", "body", "feet"])
def test_feet_stand_whatever_else_may_touch(contacts):
    """Only what may touch differs: standing on four feet is the same to the bit."""
    whole, model = load_model(), load_model(contacts=contacts)
    ends = []
    for each in (whole, model):
        data = mujoco.MjData(each)
        data.qpos[2], data.qpos[7:] = 0.29, np.tile([0.0, 0.9, -1.8], 4)
        data.ctrl[:] = data.qpos[7:]
        mujoco.mj_step(each, data, 100)
        assert data.ncon == 4
        ends.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_array_equal(*ends)
    limbs = [model.geom(f"{leg}_{part}").conaffinity[0] for leg in LEGS for part in ("hip", "thigh", "calf")]
    body = [model.geom(name).conaffinity[0] for name in ("trunk", "head", "chin")]
    assert limbs == [int(contacts == "all")] * 12
    assert body == [int(contacts != "feet")] * 3


@pytest.mark.parametrize("seed", range(10))
def test_mass_matrix(ours, published, seed):
    """The whole 18 x 18 inertia matrix and the links' places at a random pose."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=4)
    low, high = published.jnt_range[1:].T
    q = np.concatenate([rng.normal(size=3), turn / np.linalg.norm(turn), rng.uniform(low, high)])
    both = []
    for model in (ours, published):
        data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        both.append((matrix, data.xpos[[model.body(b).id for b in BODIES]]))
    np.testing.assert_allclose(both[0][0], both[1][0], atol=1e-9)
    np.testing.assert_allclose(both[0][1], both[1][1], atol=1e-12)
