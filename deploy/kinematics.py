"""Leg kinematics of the Go2 in numpy: foot centres, their Jacobians and the shanks' rotation axes.

Frames: the base frame has x forward, y left, z up, its origin at the trunk's centre. Legs are ordered FL, FR,
RL, RR, the joints of a leg hip, thigh, calf. Lengths in m, angles in rad.
The figures and their sources are in `hmc.go2.facts`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmc.go2 import facts
from hmc.go2.facts import FOOT_BACK, HIP_LENGTH, HIP_X, HIP_Y, LINK
from hmc.go2.facts import FOOT_RADIUS as FOOT_RADIUS

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

IMU = np.array(facts.IMU)

_X = (HIP_X, HIP_X, -HIP_X, -HIP_X)
_Y = (HIP_Y, -HIP_Y, HIP_Y, -HIP_Y)
_SINGULAR, _LEVEL = 1e-4, 0.03  # m^2, m
_OUT = (HIP_LENGTH, -HIP_LENGTH, HIP_LENGTH, -HIP_LENGTH)


@dataclass(frozen=True, slots=True)
class Chain:
    """One leg at one set of joint angles, in plain numbers: numpy takes longer over three than all this does.

    Attributes:
        foot: centre of the foot sphere in the base frame [m].
        rows: of d foot / d (hip, thigh, calf) [m/rad].
        hip: cosine and sine of the hip angle.
        out: lateral offset of the leg's plane [m].
        thigh: from the thigh's joint to the foot, forward and down in the leg's plane [m].
        shin: from the knee to the foot, likewise.
    """

    foot: Vector
    rows: tuple[Vector, Vector, Vector]
    hip: tuple[float, float]
    out: float
    thigh: tuple[float, float]
    shin: tuple[float, float]

    def shank(self, hip: float, thigh: float, calf: float) -> Vector:
        """Rotation of the shank relative to the base, in its frame, by that of the joints; small or rates."""
        cos, sin = self.hip
        bend = thigh + calf
        return hip, cos * bend, sin * bend

    def force(self, hip: float, thigh: float, calf: float) -> Vector:
        r"""Force of the ground on the foot in the base frame [N] by joint torques [N m]: -J^{-T} tau.

        In the leg's plane thigh and calf tell forward and upward force; the hip tells the one across, the
        worse the less the foot is below the hip: there it is damped to 0. The leg counts as massless.
        """
        (x, d), (shin_x, shin_d), (cos, sin) = self.thigh, self.shin, self.hip
        det = x * shin_d - d * shin_x
        if abs(det) < _SINGULAR:  # straight: beyond the joints' limits
            return 0.0, 0.0, 0.0
        # thigh = d ahead + x up, calf = shin_d ahead + shin_x up, hip = -d across - out up
        ahead = (x * calf - shin_x * thigh) / det
        up = (shin_d * thigh - d * calf) / det
        across = -(hip + self.out * up) * d / (d * d + _LEVEL * _LEVEL)
        return ahead, cos * across - sin * up, sin * across + cos * up


@dataclass(frozen=True, slots=True)
class Legs:
    """The four legs at one set of joint angles, in the base frame.

    Attributes:
        foot: centres of the foot spheres [m], (4, 3).
        jacobian: d foot / d (hip, thigh, calf) [m/rad], (4, 3, 3).
    """

    foot: Array
    jacobian: Array


def chains(q: list[float]) -> list[Chain]:
    r"""The legs, one by one.

    With hip angle h, thigh angle a, calf angle b, link length l and foot offset e, in the leg's plane

    .. math::
        x = -l \sin a - l \sin(a + b) - e \cos(a + b), \quad
        d = l \cos a + l \cos(a + b) - e \sin(a + b)

    forward and down; the plane is turned by h about the hip's x axis, at its lateral offset.

    Args:
        q: joint angles [rad], 12.
    """
    out = []
    for i in range(4):
        h, a, b = q[3 * i : 3 * i + 3]
        ch, sh, ca, sa = math.cos(h), math.sin(h), math.cos(a), math.sin(a)
        cb, sb = math.cos(a + b), math.sin(a + b)
        shin_x, shin_d = -LINK * sb - FOOT_BACK * cb, LINK * cb - FOOT_BACK * sb
        x, d, side = shin_x - LINK * sa, shin_d + LINK * ca, _OUT[i]
        y, z = ch * side + sh * d, sh * side - ch * d
        rows = ((0.0, -d, -shin_d), (-z, sh * x, sh * shin_x), (y, -ch * x, -ch * shin_x))
        out.append(Chain((_X[i] + x, _Y[i] + y, z), rows, (ch, sh), side, (x, d), (shin_x, shin_d)))
    return out


def legs(q: Array) -> Legs:
    """Foot centres and Jacobians at joint angles q [rad], (12,)."""
    four = chains(q.tolist())
    return Legs(np.array([leg.foot for leg in four]), np.array([leg.rows for leg in four]))


# Corners of the trunk and the head's two spheres, as a box [m]; and the radius of shin and thigh at the knee.
_TRUNK = [(x, y, z) for x in (-0.19, 0.33) for y in (-0.05, 0.05) for z in (-0.1, 0.06)]
_KNEE = 0.017


def lowest(four: list[Chain], q: list[float], up: Vector) -> tuple[float, bool]:
    """Height of the robot's lowest point from its base [m], and whether that is a foot.

    Args:
        four: the legs at q.
        q: joint angles [rad], 12.
        up: world z in the base frame.
    """
    ux, uy, uz = up
    foot = min(ux * x + uy * y + uz * z for x, y, z in (leg.foot for leg in four)) - FOOT_RADIUS
    rest = min(ux * x + uy * y + uz * z for x, y, z in _TRUNK)
    for i, leg in enumerate(four):
        (ch, sh), a = leg.hip, q[3 * i + 1]
        x, d = -LINK * math.sin(a), LINK * math.cos(a)
        knee = ux * (_X[i] + x) + uy * (_Y[i] + ch * leg.out + sh * d) + uz * (sh * leg.out - ch * d)
        rest = min(rest, knee - _KNEE)
    return min(foot, rest), foot <= rest
