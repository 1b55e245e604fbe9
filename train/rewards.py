"""Reward terms: names, units and sources."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.stances import Stance
from hmc.sim.device import constant


@dataclass(frozen=True)
class EffortCfg:
    """Weight of what moving costs in every mode, a second of simulated time.

    Attributes:
        limits: sum of joint positions beyond 95 % of their range [rad].
        power: sum |torque x speed| [W].
        acceleration: sum of squared joint accelerations [rad^2/s^4].
        target_rate: sum of squared changes of the joint targets [rad^2].
        termination: once, when an episode ends in a fall.
    """

    limits: float = 1.0
    power: float = 0.001
    acceleration: float = 2.5e-7
    target_rate: float = 0.05
    termination: float = 1.0


@dataclass(frozen=True)
class RewardCfg(EffortCfg):
    """Weight of each term, those of `EffortCfg` too; the first four earn, the others cost.

    Height, orientation and the costs follow MuJoCo Playground's Go1 handstand task, with the contact
    term as intended there (the two free feet); stillness, held and free-leg posture are ours.

    Attributes:
        height: exp(-max(0, target - z) / 0.1), z the base height [m].
        orientation: ((1 + cos tilt) / 2)^2.
        stillness: height x orientation x exp(-|v / pace|^2 - 0.1 |omega|^2), v [m/s], omega [rad/s].
        pace: speed at which stillness has fallen to 1 / e [m/s].
        held: 1 where the stance is held as it is measured, see `Stance.held`; height and orientation alone
            hardly tell a lean of 20 degrees from none.
        contact: number of free feet on the ground.
        posture: sum of squared deviations of the free legs from the stance's pose [rad^2].
        stance_posture: the same for the supporting legs.
        drift: squared horizontal distance from the anchor [m^2].
    """

    height: float = 1.0
    orientation: float = 1.0
    stillness: float = 0.5
    pace: float = 1.0
    held: float = 0.0
    contact: float = 0.3
    posture: float = 0.1
    stance_posture: float = 0.05
    power: float = 0.0005
    drift: float = 0.1


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
    still = torch.exp(-(x[:, 19:22] / cfg.pace).square().sum(1) - 0.1 * x[:, 22:25].square().sum(1))
    off = (q - constant(stance.pose, q)).square().reshape(-1, 2, 6).sum(2)  # of the front and the rear pair
    torque = go2.motor_torque(q, qd, u)
    return {
        "height": cfg.height * height,
        "orientation": cfg.orientation * orientation,
        "stillness": cfg.stillness * height * orientation * still,
        "held": cfg.held * stance.held(x, gap).to(x.dtype),
        "contact": -cfg.contact * (gap["foot"][:, stance.swing] < 0.005).sum(1),
        "posture": -cfg.posture * off[:, stance.free[0] // 2],
        "stance_posture": -cfg.stance_posture * off[:, stance.support[0] // 2],
        **efforts(cfg, x, before, torque, u, u_prev, dt),
        "drift": -cfg.drift * (x[:, :2] - anchor[:, :2]).square().sum(1).clamp(max=4.0),
    }


def efforts(
    cfg: EffortCfg,
    x: Tensor,
    before: Tensor,
    torque: Tensor,
    u: Tensor,
    u_prev: Tensor,
    dt: float,
) -> dict[str, Tensor]:
    """What moving costs in every mode, name -> (n,); arguments as of `stage_rewards`, torque (n, 12)."""
    q, qd = x[:, 7:19], x[:, 25:37]
    return {
        "limits": -cfg.limits * ((q - constant(MIDDLE, q)).abs() - constant(REACH, q)).clamp(min=0).sum(1),
        "power": -cfg.power * (torque * qd).abs().sum(1),
        "acceleration": -cfg.acceleration * ((qd - before[:, 25:37]) / dt).square().sum(1),
        "target_rate": -cfg.target_rate * (u - u_prev).square().sum(1),
    }


@dataclass(frozen=True)
class LegsRewardCfg(EffortCfg):
    """Weight of each term on four legs, those of `EffortCfg` too; the first eight earn, the others cost.

    With o = (1 + cos tilt) / 2 and h = exp(-max(0, 0.28 - z) / 0.1), z the base height [m]. Tracking is that
    of legged_gym (Rudin et al. 2021), as is rewarding feet for their time in the air; upright, height and
    posture follow MuJoCo Playground's Go1 getup task.

    Attributes:
        upright: o.
        height: o h.
        posture: o h exp(-|q - q_home|^2 / width).
        width: squared distance from the pose at which posture has fallen to 1 / e [rad^2].
        stillness: o h exp(-|v|^2 - 0.1 |omega|^2) where the command is to stand, v [m/s], omega [rad/s].
        track: o h exp(-|v - v_command|^2 / 0.15), over the ground.
        turn: o h exp(-(omega_z - omega_command)^2 / 0.25).
        air: once, when a foot comes down while the robot is to move: how much longer than 0.1 s it was in the
            air, of 0.35 s at most [s]. Nothing for shorter steps: where they cost, standing still pays more.
        trot: 1 while the robot is to move and exactly one pair of diagonal feet is on the ground.
        bounce: v_z^2 + 0.05 (omega_x^2 + omega_y^2).
        touch: number of thighs and shins on the ground, and of trunks.
        beyond: sum of squared distances of the joint targets that the policy asks for from the joints' ranges
            [rad^2]: out there nothing tells it the way back.
    """

    upright: float = 1.0
    height: float = 1.0
    posture: float = 0.5
    width: float = 2.0
    stillness: float = 0.5
    track: float = 0.0
    turn: float = 0.0
    air: float = 0.0
    trot: float = 0.0
    bounce: float = 0.0
    touch: float = 0.1
    beyond: float = 0.0


def legs_rewards(
    cfg: LegsRewardCfg,
    x: Tensor,
    before: Tensor,
    u: Tensor,
    u_prev: Tensor,
    velocity: Tensor,
    command: Tensor,
    landed: Tensor,
    beyond: Tensor,
    dt: float,
    gap: dict[str, Tensor],
) -> dict[str, Tensor]:
    """Weighted reward terms of one control step on four legs, name -> (n,), not yet multiplied by dt.

    Args:
        cfg: weights.
        x: state after the step (n, 37).
        before: state before it.
        u: joint targets of the step (n, 12) [rad].
        u_prev: those of the step before.
        velocity: forward, sideways [m/s] and turn [rad/s], (n, 3).
        command: what it should be, likewise.
        landed: of feet on the ground, how long they were in the air until this step [s], (n, 4).
        beyond: how far the joint targets that were asked for are out of the joints' ranges, (n, 12) [rad].
        dt: control step [s].
        gap: `clearances` of x.
    """
    q, qd = x[:, 7:19], x[:, 25:37]
    upright = 0.5 + 0.5 * go2.vertical(x[:, 3:7])[:, 2]
    high = upright * torch.exp(-(0.28 - x[:, 2]).clamp(min=0) / 0.1)
    off = velocity - command
    moves = command.norm(dim=1) > 0.1
    still = high * torch.exp(-x[:, 19:22].square().sum(1) - 0.1 * x[:, 22:25].square().sum(1))
    air = (landed.clamp(max=0.35) - 0.1).clamp(min=0).sum(1) / dt
    left, right, rear_left, rear_right = (gap["foot"] < 0.005).unbind(1)
    trot = (left & rear_right & ~(right | rear_left)) | (right & rear_left & ~(left | rear_right))
    torque = go2.motor_torque(q, qd, u)
    touching = (gap["thigh"] < 0).sum(1) + (gap["calf"] < 0).sum(1) + (gap["trunk"] < 0)
    terms = {
        "upright": cfg.upright * upright,
        "height": cfg.height * high,
        "posture": cfg.posture * high * torch.exp(-(q - constant(go2.HOME, q)).square().sum(1) / cfg.width),
        "stillness": cfg.stillness * torch.where(moves, 0.0, still),
        "track": cfg.track * high * torch.exp(-off[:, :2].square().sum(1) / 0.15),
        "turn": cfg.turn * high * torch.exp(-off[:, 2].square() / 0.25),
        "air": cfg.air * torch.where(moves, air, 0.0),
        "trot": cfg.trot * (moves & trot),
        "bounce": -cfg.bounce * (x[:, 21].square() + 0.05 * x[:, 22:24].square().sum(1)),
        "touch": -cfg.touch * touching,
        "beyond": -cfg.beyond * beyond.square().sum(1),
    }
    return terms | efforts(cfg, x, before, torque, u, u_prev, dt)
