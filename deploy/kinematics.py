"""Leg kinematics of the Go2 in numpy: foot centres, their Jacobians and the shanks' rotation axes.

Frames: the base frame has x forward, y left, z up, its origin at the trunk's centre. Legs are ordered FL, FR,
RL, RR, the joints of a leg hip, thigh, calf. Lengths in m, angles in rad.

Sources: offsets and link lengths are Unitree's, as published in MuJoCo Menagerie's unitree_go2
(BSD-3-Clause); the IMU's place is the one in Unitree's go2_description.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIP_X, HIP_Y, HIP_LENGTH, LINK = 0.1934, 0.0465, 0.0955, 0.213
FOOT_BACK = 0.002  # the foot's centre lies behind the shank's axis
FOOT_RADIUS = 0.022
IMU = np.array([-0.02557, 0.0, 0.04232])

_X = (HIP_X, HIP_X, -HIP_X, -HIP_X)
_Y = (HIP_Y, -HIP_Y, HIP_Y, -HIP_Y)
_OUT = (HIP_LENGTH, -HIP_LENGTH, HIP_LENGTH, -HIP_LENGTH)


@dataclass(frozen=True, slots=True)
class Legs:
    """The four legs at one set of joint angles, in the base frame.

    Attributes:
        foot: centres of the foot spheres [m], (4, 3).
        jacobian: d foot / d (hip, thigh, calf) [m/rad], (4, 3, 3).
        axis: angular velocity of the shank relative to the base per joint speed, (4, 3, 3).
    """

    foot: Array
    jacobian: Array
    axis: Array


def legs(q: Array) -> Legs:
    r"""Foot centres, Jacobians and shank axes.

    With hip angle h, thigh angle a, calf angle b, link length l and foot offset e, in the leg's plane

    .. math::
        x = -l \sin a - l \sin(a + b) - e \cos(a + b), \quad
        d = l \cos a + l \cos(a + b) - e \sin(a + b)

    forward and down; the plane is turned by h about the hip's x axis, at its lateral offset.

    Args:
        q: joint angles [rad], (12,).
    """
    foot, jacobian, axis = [], [], []
    # plain arithmetic: an array operation on four numbers takes as long as all that a leg needs
    for (h, a, b), hip_x, hip_y, out in zip(q.reshape(4, 3).tolist(), _X, _Y, _OUT, strict=True):
        ch, sh, ca, sa = math.cos(h), math.sin(h), math.cos(a), math.sin(a)
        cb, sb = math.cos(a + b), math.sin(a + b)
        shin_x, shin_d = -LINK * sb - FOOT_BACK * cb, LINK * cb - FOOT_BACK * sb
        x, d = shin_x - LINK * sa, shin_d + LINK * ca
        y, z = ch * out + sh * d, sh * out - ch * d
        foot.append((hip_x + x, hip_y + y, z))
        jacobian.append(((0.0, -d, -shin_d), (-z, sh * x, sh * shin_x), (y, -ch * x, -ch * shin_x)))
        axis.append(((1.0, 0.0, 0.0), (0.0, ch, ch), (0.0, sh, sh)))
    return Legs(np.array(foot), np.array(jacobian), np.array(axis))
