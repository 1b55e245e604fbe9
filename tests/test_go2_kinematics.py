"""Kinematics, motor law, observation and stances of the Go2 against MuJoCo and hand-computed values."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.facts import OBS_SIZE
from hmc.go2.observe import anchor_of, observe, pitch
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STANCES


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return go2.load_model()


def random_states(n: int, seed: int = 0) -> torch.Tensor:
    """States anywhere: any orientation, joints within their range, any speed, (n, 37) float64."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 37))
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    x[:, 7:19] = rng.uniform(go2.Q_LOWER, go2.Q_UPPER, (n, 12))
    x[:, 25:37] *= 12.0
    return torch.from_numpy(x)


def turned(x: torch.Tensor, yaw: float, shift: tuple[float, float] = (0.0, 0.0)) -> torch.Tensor:
    """The same motion (n, 37) with another heading, elsewhere on the floor."""
    c, s = math.cos(yaw), math.sin(yaw)
    turn = torch.tensor([[c, -s], [s, c]], dtype=x.dtype)
    y = x.clone()
    y[:, :2] = x[:, :2] @ turn.T + torch.tensor(shift, dtype=x.dtype)
    y[:, 19:21] = x[:, 19:21] @ turn.T
    a, b = math.cos(yaw / 2), math.sin(yaw / 2)
    w, i, j, k = x[:, 3:7].unbind(1)
    y[:, 3:7] = torch.stack([a * w - b * k, a * i - b * j, a * j + b * i, a * k + b * w], 1)
    return y


def at(model: mujoco.MjModel, x: torch.Tensor, u: torch.Tensor | None = None) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = x[:19], x[19:]
    if u is not None:
        data.ctrl[:] = u
    mujoco.mj_forward(model, data)
    return data


def lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: str) -> float:
    """Height of a geom's lowest point [m]."""
    i, turn = model.geom(geom).id, data.geom(geom).xmat.reshape(3, 3)
    z, size = data.geom(geom).xpos[2], model.geom_size[model.geom(geom).id]
    kind = model.geom_type[i]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return z - size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return z - abs(turn[2, 2]) * size[1] - size[0]
    assert kind == mujoco.mjtGeom.mjGEOM_BOX
    return z - np.abs(turn[2]) @ size


def test_points_of_the_legs(model):
    for x in random_states(20):
        data = at(model, x)
        base, turn = data.body("base").xpos, data.body("base").xmat.reshape(3, 3)
        points = go2.leg_points(x[None, 7:19])[0].numpy() @ turn.T + base
        for i, leg in enumerate(go2.LEGS):
            places = [data.body(f"{leg}_thigh"), data.body(f"{leg}_calf"), data.geom(f"{leg}_foot")]
            np.testing.assert_allclose(points[i], [place.xpos for place in places], atol=1e-9)


def test_clearances_are_those_of_the_geoms(model):
    x = random_states(50, seed=1)
    ours = go2.clearances(x)
    for row in range(len(x)):
        data = at(model, x[row])
        for link in ("hip", "thigh", "calf", "foot"):
            theirs = [lowest(model, data, f"{leg}_{link}") for leg in go2.LEGS]
            np.testing.assert_allclose(ours[link][row], theirs, atol=1e-6, err_msg=link)
        trunk = min(lowest(model, data, geom) for geom in ("trunk", "head", "chin"))
        assert float(ours["trunk"][row]) == pytest.approx(trunk, abs=1e-6)


def test_a_clearance_below_zero_is_a_contact(model):
    """Dropped to every height, the links that touch are those that MuJoCo finds in contact."""
    floor = model.geom("floor").id
    for x in random_states(30, seed=2):
        x[2] = float(torch.rand(1)) * 0.4
        data, gap = at(model, x), go2.clearances(x[None])
        hit = {model.geom(g).name for pair in data.contact.geom for g in pair if g != floor}
        for link in ("hip", "thigh", "calf", "foot"):
            for i, leg in enumerate(go2.LEGS):
                assert (f"{leg}_{link}" in hit) == (float(gap[link][0, i]) < 0)
        assert bool(hit & {"trunk", "head", "chin"}) == (float(gap["trunk"]) < 0)


def test_rotation_and_vertical(model):
    x = random_states(20)
    for row, turn in zip(x, go2.rotation(x[:, 3:7]), strict=True):
        np.testing.assert_allclose(turn, at(model, row).body("base").xmat.reshape(3, 3), atol=1e-12)
    assert torch.equal(go2.vertical(x[:, 3:7]), go2.rotation(x[:, 3:7])[:, 2])


def test_motor_torque_is_the_engines(model):
    x = random_states(200, seed=3)
    u = torch.from_numpy(np.random.default_rng(4).uniform(go2.Q_LOWER - 1, go2.Q_UPPER + 1, (200, 12)))
    ours = go2.motor_torque(x[:, 7:19], x[:, 25:37], u)
    theirs = np.stack([at(model, state, target).actuator_force for state, target in zip(x, u, strict=True)])
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    peak = go2.PEAK * go2.GEAR.double()
    assert (ours.abs() <= peak + 1e-6).all()
    assert (ours.abs() >= peak - 1e-4).any()
    assert (ours.abs() < peak - 1).any()


def test_motor_torque_by_hand():
    q, qd, u = torch.zeros(5, 12), torch.zeros(5, 12), torch.zeros(5, 12)
    u[0] = 0.1  # 35 x 0.1
    u[1], qd[1] = 0.1, 2.0  # - 0.5 x 2
    u[2] = 5.0  # saturated
    u[3], qd[3] = 5.0, 20.0  # on the driving line of the hip: 20.2 (30 - 20) / (30 - 13.5)
    u[4], qd[4] = -5.0, 20.0  # braking: full torque
    torque = go2.motor_torque(q, qd, u)
    assert torque[:, 0].tolist() == pytest.approx([3.5, 2.5, 20.2, 20.2 * 10 / 16.5, -20.2], rel=1e-5)
    assert torque[2, 2] == pytest.approx(20.2 * 1.917, rel=1e-5)


@pytest.mark.parametrize("stance", STANCES.values(), ids=STANCES)
def test_stances_are_balanced(model, stance):
    x = stance.state()
    data = at(model, x)
    feet = np.mean([data.geom(f"{go2.LEGS[leg]}_foot").xpos for leg in stance.support], axis=0)
    centre = data.body("base").subtree_com
    np.testing.assert_allclose(centre[:2], feet[:2], atol=2e-3)
    gap = go2.clearances(x[None])
    assert gap["foot"][0, list(stance.support)].abs().max() < 2e-3, "the supporting feet are on the floor"
    assert ((x[7:19] > go2.Q_LOWER) & (x[7:19] < go2.Q_UPPER)).all()


def test_stances_by_name():
    assert list(STANCES) == ["handstand", "footstand"]
    assert (HANDSTAND.support, HANDSTAND.free) == ((0, 1), (2, 3))
    assert (FOOTSTAND.support, FOOTSTAND.free) == ((2, 3), (0, 1))


def tilted(stance, degrees: float) -> torch.Tensor:
    """The stance pitched further by some degrees, at its height, (1, 37)."""
    x = stance.state()[None]
    half = stance.sign * math.pi / 4 + math.radians(degrees) / 2
    x[:, 3], x[:, 5] = math.cos(half), math.sin(half)
    x[:, 2] += 0.1
    return x


@pytest.mark.parametrize("stance", STANCES.values(), ids=STANCES)
def test_held(stance):
    other = HANDSTAND if stance is FOOTSTAND else FOOTSTAND
    x = stance.state()[None]
    assert stance.held(x)
    assert not other.held(x)
    assert stance.uprightness(x) == pytest.approx(1.0)
    assert other.uprightness(x) == pytest.approx(-1.0)
    assert stance.held(turned(x, 2.0, (3.0, -1.0))), "wherever it stands"
    assert not stance.held(tilted(stance, 21))
    assert not stance.held(tilted(stance, -21))
    assert stance.held(tilted(stance, 19))
    assert stance.held(tilted(stance, -19))
    crouch = x.clone()
    crouch[:, 2] = 0.449
    assert not stance.held(crouch)


@pytest.mark.parametrize("stance", STANCES.values(), ids=STANCES)
def test_a_robot_on_its_shins_does_not_stand(stance):
    """Shins flat on the floor, body upright: the local optimum that a careless reward finds."""
    x = stance.state()[None]
    # the body's x axis points down (handstand) or up (foot stand); a thigh along it, the shin square to it
    thigh = -math.pi / 2 if stance is HANDSTAND else math.pi / 2
    for leg in stance.support:
        x[:, 7 + 3 * leg + 1], x[:, 7 + 3 * leg + 2] = thigh, -math.pi / 2
    x[:, 2] -= go2.clearances(x)["foot"].min() + 1e-4
    low = go2.clearances(x)["calf"][:, list(stance.support)]
    assert (low < go2.FOOT_RADIUS).all(), "the feet are thicker than the shins"
    assert x[0, 2] < 0.45
    assert stance.uprightness(x) > 0.99
    assert not stance.held(x)


@pytest.mark.parametrize("stance", STANCES.values(), ids=STANCES)
def test_every_touch_ends_a_stance(stance):
    x = stance.state()[None]
    clear = {key: torch.full_like(gap, 0.1) for key, gap in go2.clearances(x).items()}
    clear["foot"][:, list(stance.support)] = -0.001
    assert stance.held(x, clear), "standing on the two feet that it should stand on"
    for link in ("trunk", "thigh", "calf"):
        touching = {key: gap.clone() for key, gap in clear.items()}
        touching[link].view(-1)[-1] = 0.0
        assert not stance.held(x, touching), link
    for leg in stance.free:
        touching = {key: gap.clone() for key, gap in clear.items()}
        touching["foot"][:, leg] = 0.0
        assert not stance.held(x, touching), "another foot on the ground"


def test_gravity_and_pitch_in_the_stances():
    x = torch.stack([HANDSTAND.state(), FOOTSTAND.state()])
    x = torch.cat([x, torch.zeros(1, 37, dtype=x.dtype)])
    x[2, 3] = 1.0  # upright on four legs
    gravity = observe(x, torch.zeros(3, 12), anchor_of(x))[:, :3]
    expected = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, -1.0]], dtype=x.dtype)
    torch.testing.assert_close(gravity, expected)
    torch.testing.assert_close(pitch(x), torch.tensor([math.pi / 2, -math.pi / 2, 0], dtype=x.dtype))


def test_observation_by_hand():
    """Level, heading along world y, at (2, 3, 0.5) with the anchor half a metre behind it."""
    x = torch.zeros(1, 37, dtype=torch.float64)
    x[0, :3] = torch.tensor([2.0, 3.0, 0.5])
    x[0, 3], x[0, 6] = math.cos(math.pi / 4), math.sin(math.pi / 4)
    x[0, 7:19], x[0, 25:37] = torch.arange(12), torch.arange(12) + 20
    x[0, 19:22] = torch.tensor([0.3, 0.7, -0.1])
    x[0, 22:25] = torch.tensor([1.0, 2.0, 3.0])
    anchor = torch.tensor([[2.1, 2.5, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(anchor_of(x)[:, 2:], anchor[:, 2:])
    obs = observe(x, torch.arange(12.0)[None].double() + 40, anchor)
    assert obs.shape == (1, OBS_SIZE)
    expected = [0, 0, -1, 0.5, 0.1, 0.5, 0.7, -0.3, -0.1, 1, 2, 3, *range(12), *range(20, 32), *range(40, 52)]
    torch.testing.assert_close(obs[0], torch.tensor(expected, dtype=torch.float64))


def test_observation_does_not_depend_on_place_and_heading():
    """The anchor goes where the robot went; what it sees since then is the same."""
    x = random_states(30)
    later = random_states(30, seed=5)
    u = torch.zeros(30, 12, dtype=x.dtype)
    for yaw, shift in [(0.7, (0.0, 0.0)), (-2.5, (10.0, -4.0)), (math.pi, (0.0, 1.0))]:
        moved = observe(turned(later, yaw, shift), u, anchor_of(turned(x, yaw, shift)))
        torch.testing.assert_close(moved, observe(later, u, anchor_of(x)), atol=1e-9, rtol=0)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -3.0])
def test_heading_survives_the_vertical(yaw):
    """A robot that pitches from a foot stand over four legs to a handstand keeps its heading."""
    x = torch.zeros(37, 37, dtype=torch.float64)
    half = torch.linspace(-math.pi / 2, math.pi / 2, 37, dtype=torch.float64) / 2
    x[:, 3], x[:, 5] = half.cos(), half.sin()
    heading = anchor_of(turned(x, yaw))[:, 2:]
    expected = torch.tensor([math.cos(yaw), math.sin(yaw)], dtype=torch.float64).expand(37, 2)
    torch.testing.assert_close(heading, expected)


def test_one_row_or_many_is_the_same_to_the_bit():
    """Costs and plans must not depend on the size of a batch."""
    x, u = random_states(64), torch.randn(64, 12, dtype=torch.float64)
    anchor = anchor_of(x)
    whole, gap = observe(x, u, anchor), go2.clearances(x)
    for row in range(64):
        one = slice(row, row + 1)
        assert torch.equal(observe(x[one], u[one], anchor[one]), whole[one])
        assert torch.equal(anchor_of(x[one]), anchor[one])
        assert all(torch.equal(value, gap[key][one]) for key, value in go2.clearances(x[one]).items())
