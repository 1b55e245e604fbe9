"""Leg kinematics of the Go2 in numpy: foot centres, their Jacobians and the shanks' rotation axes.

Frames: the base frame has x forward, y left, z up, its origin at the trunk's centre. Legs are ordered FL, FR,
RL, RR, the joints of a leg hip, thigh, calf. Lengths in m, angles in rad.

Sources: offsets and link lengths are Unitree's, as published in MuJoCo Menagerie's unitree_go2
(BSD-3-Clause); the IMU's place is the one in Unitree's go2_description.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIP_X, HIP_Y, HIP_LENGTH, LINK = 0.1934, 0.0465, 0.0955, 0.213
FOOT_BACK = 0.002  # the foot's centre lies behind the shank's axis
FOOT_RADIUS = 0.022
IMU = np.array([-0.02557, 0.0, 0.04232])

_END = np.array([1.0, 1.0, -1.0, -1.0])
_SIDE = np.array([1.0, -1.0, 1.0, -1.0])
_X, _Y, _OUT = HIP_X * _END, HIP_Y * _SIDE, HIP_LENGTH * _SIDE


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
    joint = q.reshape(4, 3).T.copy()
    joint[2] += joint[1]
    (ch, ca, cb), (sh, sa, sb) = np.cos(joint), np.sin(joint)
    shin_x, shin_d = -LINK * sb - FOOT_BACK * cb, LINK * cb - FOOT_BACK * sb
    x, d = shin_x - LINK * sa, shin_d + LINK * ca
    y, z = ch * _OUT + sh * d, sh * _OUT - ch * d

    foot = np.empty((4, 3))
    foot[:, 0], foot[:, 1], foot[:, 2] = x + _X, y + _Y, z
    jacobian = np.zeros((4, 3, 3))
    jacobian[:, 1, 0], jacobian[:, 2, 0] = -z, y
    jacobian[:, 0, 1], jacobian[:, 1, 1], jacobian[:, 2, 1] = -d, sh * x, -ch * x
    jacobian[:, 0, 2], jacobian[:, 1, 2], jacobian[:, 2, 2] = -shin_d, sh * shin_x, -ch * shin_x
    axis = np.zeros((4, 3, 3))
    axis[:, 0, 0] = 1.0
    axis[:, 1, 1:] = ch[:, None]
    axis[:, 2, 1:] = sh[:, None]
    return Legs(foot, jacobian, axis)
