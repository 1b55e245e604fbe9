"""Reward terms against values worked out by hand."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.stances import FOOTSTAND, HANDSTAND, Stance
from train.rewards import RewardCfg, stage_rewards

ONES = RewardCfg(**{field.name: 1.0 for field in fields(RewardCfg)})
DT = 0.02


def terms(stance: Stance = HANDSTAND, x=None, before=None, u=None, u_prev=None, cfg: RewardCfg = ONES):
    """Terms of one world; what is not given is the stance at rest."""
    rest = stance.state()
    x = rest if x is None else x
    before = x if before is None else before
    u = x[7:19] if u is None else u
    u_prev = u if u_prev is None else u_prev
    x, before, u, u_prev = (row[None].double() for row in (x, before, u, u_prev))
    anchor = torch.zeros(1, 4, dtype=torch.float64)
    found = stage_rewards(cfg, stance, x, before, u, u_prev, anchor, DT, go2.clearances(x))
    return {name: float(value[0]) for name, value in found.items()}


def moved(stance: Stance = HANDSTAND, **entries: float) -> torch.Tensor:
    """The stance at rest with entries (x7=..., by index) set."""
    x = stance.state().clone()
    for name, value in entries.items():
        x[int(name[1:])] = value
    return x


@pytest.mark.parametrize("stance", [HANDSTAND, FOOTSTAND])
def test_the_stance_at_rest_earns_all_and_costs_nothing(stance):
    found = terms(stance)
    earned = {"height": 1.0, "orientation": 1.0, "stillness": 1.0, "held": 1.0}
    costs = {name: 0.0 for name in found if name not in earned}
    assert found == pytest.approx(earned | costs, abs=1e-9)
    assert set(found) == {field.name for field in fields(RewardCfg)} - {"termination", "pace"}


def test_weights_scale_their_terms():
    busy = moved(x2=0.45, x19=1.0, x25=2.0, x8=0.0)
    plain, scaled = terms(x=busy), terms(x=busy, cfg=RewardCfg())
    for name, value in scaled.items():
        assert value == pytest.approx(getattr(RewardCfg(), name) * plain[name], rel=1e-9), name


def test_height_falls_by_e_every_ten_centimetres():
    assert terms(x=moved(x2=0.45))["height"] == pytest.approx(math.exp(-1))
    assert terms(x=moved(x2=0.9))["height"] == 1.0


@pytest.mark.parametrize(("tilt", "earned"), [(0.0, 1.0), (math.pi / 3, 0.75**2), (math.pi / 2, 0.25)])
def test_orientation(tilt, earned):
    half = (math.pi / 2 - tilt) / 2
    assert terms(x=moved(x3=math.cos(half), x5=math.sin(half)))["orientation"] == pytest.approx(earned)


def test_stillness_is_height_and_orientation_at_rest():
    fast = moved(x2=0.45, x19=0.6, x21=0.8, x23=2.0)
    assert terms(x=fast)["stillness"] == pytest.approx(math.exp(-1) * math.exp(-1 - 0.4))
    strict = replace(ONES, pace=0.5)
    assert terms(x=fast, cfg=strict)["stillness"] == pytest.approx(math.exp(-1) * math.exp(-4 - 0.4))


@pytest.mark.parametrize(("lean", "held"), [(0.0, 1.0), (19.0, 1.0), (21.0, 0.0)])
def test_held_is_earned_up_to_a_lean_of_20_degrees(lean, held):
    half = math.radians(90 - lean) / 2
    assert terms(x=moved(x3=math.cos(half), x5=math.sin(half)))["held"] == held


def test_free_feet_on_the_ground_are_counted():
    """Lying flat at a height where all four feet touch, the two free ones cost."""
    flat = moved(x2=0.26, x3=1.0, x5=0.0)
    flat[7:19] = go2.HOME
    assert terms(x=flat)["contact"] == -2.0


def test_limits_begin_at_95_percent_of_the_range():
    middle, half = (go2.Q_UPPER[7] + go2.Q_LOWER[7]) / 2, (go2.Q_UPPER[7] - go2.Q_LOWER[7]) / 2
    assert terms(x=moved(x14=float(middle + 0.95 * half) + 0.02))["limits"] == pytest.approx(-0.02, abs=1e-6)
    assert terms(x=moved(x14=float(middle - half)))["limits"] == pytest.approx(-0.05 * float(half), abs=1e-6)


def test_posture_is_that_of_free_and_supporting_legs():
    """Joint 7 + 1 is a front thigh, supporting in the handstand; 7 + 8 a rear calf, free there."""
    rest = HANDSTAND.pose
    found = terms(x=moved(x8=float(rest[1]) + 0.2, x15=float(rest[8]) - 0.3))
    assert found["stance_posture"] == pytest.approx(-0.04, abs=1e-6)
    assert found["posture"] == pytest.approx(-0.09, abs=1e-6)


def test_power_is_torque_times_speed_at_each_joint():
    """Only damping acts: 0.5 x 2 = 1 N m at 2 rad/s and 0.5 x 3 = 1.5 N m at 3 rad/s."""
    assert terms(x=moved(x25=2.0, x28=-3.0))["power"] == pytest.approx(-(2.0 + 4.5), rel=1e-6)


def test_rates():
    found = terms(before=moved(x25=0.1, x30=-0.2), u_prev=HANDSTAND.pose + 0.1)
    assert found["acceleration"] == pytest.approx(-(5.0**2 + 10.0**2))
    assert found["target_rate"] == pytest.approx(-12 * 0.01, rel=1e-5)


def test_drift_is_squared_and_capped():
    assert terms(x=moved(x0=0.3, x1=-0.4))["drift"] == pytest.approx(-0.25)
    assert terms(x=moved(x0=30.0))["drift"] == -4.0
