"""State to observation: the one function that training, planning and deployment share."""

from __future__ import annotations

import torch
from torch import Tensor

from hmc.go2.facts import LEASH
from hmc.go2.model import rotation, vertical


def observe(x: Tensor, u: Tensor, anchor: Tensor) -> Tensor:
    """Observation of DESIGN's 48 numbers, (n, 48).

    ======== === =========================================================================
    slice    n   meaning
    ======== === =========================================================================
    0:3      3   gravity direction in the body frame (unit vector; (0, 0, -1) when upright)
    3:6      3   base position [m]: x, y from the anchor, turned into the anchor's heading; height
    6:9      3   base linear velocity in the body frame [m/s]
    9:12     3   base angular velocity in the body frame [rad/s]
    12:24    12  joint positions [rad]
    24:36    12  joint velocities [rad/s]
    36:48    12  previous action: desired joint positions [rad]
    ======== === =========================================================================

    Args:
        x: state (n, 37): qpos (position, quaternion w x y z, joints), qvel (linear velocity in the
            world frame, angular velocity in the body frame, joints).
        u: previous action (n, 12) [rad].
        anchor: where the mode was entered, (n, 4): x, y [m], cos and sin of the heading; see `anchor_of`.
    """
    turn = rotation(x[:, 3:7])
    dx, dy = (x[:, :2] - anchor[:, :2]).unbind(-1)
    c, s = anchor[:, 2:].unbind(-1)
    # entry by entry: a matrix product may round differently in a batch of another size
    across = turn * x[:, 19:22, None]
    velocity = across[:, 0] + across[:, 1] + across[:, 2]
    position = torch.stack([c * dx + s * dy, c * dy - s * dx, x[:, 2]], -1)
    return torch.cat([-turn[:, 2], position, velocity, x[:, 22:25], x[:, 7:19], x[:, 25:37], u], -1)


def anchor_of(x: Tensor) -> Tensor:
    """Anchor at state x, (n, 4): position and heading.

    The heading is that of the body's y axis (left) less 90 degrees: unlike the x axis it stays
    horizontal when the robot pitches through the vertical.
    """
    left = rotation(x[:, 3:7])[:, :2, 1]
    left = left / left.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.stack([x[:, 0], x[:, 1], left[:, 1], -left[:, 0]], -1)


def follow(x: Tensor, anchor: Tensor) -> Tensor:
    """Anchors (n, 4), drawn along so that states x (n, 37) are within `LEASH` of them.

    A stance that drifts would otherwise see numbers that it was never trained with, and fall.
    """
    dx, dy = (x[:, :2] - anchor[:, :2]).unbind(-1)
    distance = (dx * dx + dy * dy).sqrt()
    share = LEASH / distance.clamp(min=LEASH)
    at = torch.stack([x[:, 0] - share * dx, x[:, 1] - share * dy], -1)
    return torch.cat([torch.where((distance > LEASH)[:, None], at, anchor[:, :2]), anchor[:, 2:]], -1)


def pitch(x: Tensor) -> Tensor:
    """Pitch [rad], (n,): -pi/2 with the nose up (foot stand), +pi/2 with the nose down (handstand)."""
    up = vertical(x[:, 3:7])
    return torch.atan2(-up[:, 0], up[:, 2])
