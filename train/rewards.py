"""Reward terms of the stances: names, units and sources."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.stances import Stance


@dataclass(frozen=True)
class RewardCfg:
    """Weight of each term, a second of simulated time; the first three earn, the others cost.

    Height, orientation and the costs follow MuJoCo Playground's Go1 handstand task, with the contact
    term as intended there (the two free feet); stillness and free-leg posture are ours.

    Attributes:
        height: exp(-max(0, target - z) / 0.1), z the base height [m].
        orientation: ((1 + cos tilt) / 2)^2.
        stillness: height x orientation x exp(-|v|^2 - 0.1 |omega|^2), v [m/s], omega [rad/s].
        contact: number of free feet on the ground.
        limits: sum of joint positions beyond 95 % of their range [rad].
        posture: sum of squared deviations of the free legs from the stance's pose [rad^2].
        stance_posture: the same for the supporting legs.
        power: sum |torque x speed| [W].
        acceleration: sum of squared joint accelerations [rad^2/s^4].
        target_rate: sum of squared changes of the joint targets [rad^2].
        drift: squared horizontal distance from the anchor [m^2].
        termination: once, when an episode ends in a fall.
    """

    height: float = 1.0
    orientation: float = 1.0
    stillness: float = 0.5
    contact: float = 0.3
    limits: float = 1.0
    posture: float = 0.1
    stance_posture: float = 0.05
    power: float = 0.0005
    acceleration: float = 2.5e-7
    target_rate: float = 0.05
    drift: float = 0.1
    termination: float = 1.0


TARGET_HEIGHT = 0.55  # m
MIDDLE = (go2.Q_UPPER + go2.Q_LOWER) / 2  # of the joints' range [rad]
REACH = (go2.Q_UPPER - go2.Q_LOWER) / 2 * 0.95  # free of cost about it [rad]


def stage_rewards(
    cfg: RewardCfg,
    stance: Stance,
    x: Tensor,
    before: Tensor,
    u: Tensor,
    u_prev: Tensor,
    anchor: Tensor,
    dt: float,
    gap: dict[str, Tensor],
) -> dict[str, Tensor]:
    """Weighted reward terms of one control step, name -> (n,), not yet multiplied by dt.

    Args:
        cfg: weights.
        stance: what is to be held.
        x: state after the step (n, 37).
        before: state before it.
        u: joint targets of the step (n, 12) [rad].
        u_prev: those of the step before.
        anchor: (n, 4), see `hmc.go2.observe`.
        dt: control step [s].
        gap: `clearances` of x.
    """
    q, qd = x[:, 7:19], x[:, 25:37]
    height = torch.exp(-(TARGET_HEIGHT - x[:, 2]).clamp(min=0) / 0.1)
    orientation = (0.5 * stance.uprightness(x) + 0.5).square()
    still = torch.exp(-x[:, 19:22].square().sum(1) - 0.1 * x[:, 22:25].square().sum(1))
    off = (q - stance.pose.to(q)).square().reshape(-1, 2, 6).sum(2)  # of the front and the rear pair
    torque = go2.motor_torque(q, qd, u)
    return {
        "height": cfg.height * height,
        "orientation": cfg.orientation * orientation,
        "stillness": cfg.stillness * height * orientation * still,
        "contact": -cfg.contact * (gap["foot"][:, stance.swing] < 0.005).sum(1),
        "limits": -cfg.limits * ((q - MIDDLE.to(q)).abs() - REACH.to(q)).clamp(min=0).sum(1),
        "posture": -cfg.posture * off[:, stance.free[0] // 2],
        "stance_posture": -cfg.stance_posture * off[:, stance.support[0] // 2],
        "power": -cfg.power * (torque * qd).abs().sum(1),
        "acceleration": -cfg.acceleration * ((qd - before[:, 25:37]) / dt).square().sum(1),
        "target_rate": -cfg.target_rate * (u - u_prev).square().sum(1),
        "drift": -cfg.drift * (x[:, :2] - anchor[:, :2]).square().sum(1).clamp(max=4.0),
    }
