"""One robot's attitude in numpy, as `hmc.go2.observe` has it in torch."""

from __future__ import annotations

import math

import numpy as np

from deploy.so3 import Array, matrix


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
