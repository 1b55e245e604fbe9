"""The observation of `hmc.go2.observe` for one robot in numpy: same numbers, without torch."""

from __future__ import annotations

import math

import numpy as np

from deploy.so3 import Array, matrix


def observe(x: Array, u: Array, anchor: Array) -> Array:
    """Observation of a policy, (48,); its layout is that of `hmc.go2.observe.observe`.

    Args:
        x: state (37,): qpos (position, quaternion w x y z, joints), qvel (linear velocity in the world
            frame, angular velocity in the body frame, joints).
        u: previous action: joint targets [rad], (12,).
        anchor: where the mode was entered, (4,), see `anchor_of`.
    """
    C = matrix(x[3:7])
    dx, dy = x[0] - anchor[0], x[1] - anchor[1]
    c, s = anchor[2], anchor[3]
    position = (c * dx + s * dy, c * dy - s * dx, x[2])
    return np.concatenate([-C[2], position, x[19:22] @ C, x[22:25], x[7:19], x[25:37], u])


def anchor_of(x: Array) -> Array:
    """Anchor at state x, (4,): x, y [m], cosine and sine of the heading, which is that of the body's y axis
    less 90 degrees."""
    C = matrix(x[3:7])
    left_x, left_y = float(C[0, 1]), float(C[1, 1])
    size = max(math.hypot(left_x, left_y), 1e-6)
    return np.array([x[0], x[1], left_y / size, -left_x / size])


def vertical(quat: Array) -> Array:
    """World z of each body axis, (3,), of a unit quaternion (w, x, y, z)."""
    return matrix(quat)[2]


def pitch(up: Array) -> float:
    """Pitch [rad] of a `vertical`: -pi/2 with the nose up (foot stand), +pi/2 with it down (handstand)."""
    return math.atan2(-up[0], up[2])


def lean(up: Array) -> float:
    """Angle [rad] of the body's plane of symmetry with the vertical: roll that pitch does not come into."""
    return math.asin(max(-1.0, min(1.0, float(up[1]))))
