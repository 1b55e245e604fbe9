"""Rotations: skew matrices, exponential and logarithm of SO(3), unit quaternions (w, x, y, z).

A quaternion or matrix of an attitude turns body into world vectors. Source: J. Solà, "Quaternion kinematics
for the error-state Kalman filter", 2017, sections 2 to 4, with the Hamilton convention.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# a @ _SKEW is the skew matrix of a, row by row
_SKEW = np.zeros((3, 9))
_SKEW[0, 5], _SKEW[0, 7] = -1.0, 1.0
_SKEW[1, 2], _SKEW[1, 6] = 1.0, -1.0
_SKEW[2, 1], _SKEW[2, 3] = -1.0, 1.0

_SMALL = 1e-3  # rad: below it the closed forms lose more digits than their series leave out


def skew(a: Array) -> Array:
    """Matrix [a] with [a] b = a x b: (..., 3) to (..., 3, 3)."""
    return (a @ _SKEW).reshape(*a.shape, 3)


def rotated(C: list[list[float]], a: Sequence[float]) -> tuple[float, float, float]:
    """C a of a matrix (3, 3) and a vector in plain numbers."""
    x, y, z = a
    (b, c, d), (e, f, g), (h, i, j) = C
    return b * x + c * y + d * z, e * x + f * y + g * z, h * x + i * y + j * z


def matrix(q: Array) -> Array:
    """Rotation matrix (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = q.tolist()
    # one row of nine: numpy reads nested lists more slowly
    return np.array(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
    ).reshape(3, 3)


def multiply(p: Array, q: Array) -> Array:
    """Product of two quaternions (4,), normalised."""
    a, b, c, d = p.tolist()
    w, x, y, z = q.tolist()
    out = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    scale = 1.0 / math.sqrt(sum(v * v for v in out))
    return np.array([v * scale for v in out])


def quaternion(phi: Array) -> Array:
    """Unit quaternion (4,) of a rotation vector [rad] (3,)."""
    x, y, z = phi.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(angle / 2) / angle by its series where it is 0/0
    s = math.sin(0.5 * angle) / angle if angle > _SMALL else 0.5 - angle * angle / 48.0
    return np.array([math.cos(0.5 * angle), s * x, s * y, s * z])


def exp(phi: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector [rad] (3,)."""
    return matrix(quaternion(phi))


def turned(q: Array, phi: Array, world: bool = False) -> tuple[Array, Array]:
    """Unit quaternion (4,) and matrix (3, 3) of q turned on by phi [rad] in the body's or the world's frame.

    The same as `quaternion`, `multiply` and `matrix` in turn, without the arrays between them.
    """
    x, y, z = phi.tolist()
    a, b, c, d = q.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    s = math.sin(0.5 * angle) / angle if angle > _SMALL else 0.5 - angle * angle / 48.0
    t, x, y, z = math.cos(0.5 * angle), s * x, s * y, s * z
    if world:  # the vector parts' product changes its sign with the order
        b, c, d, x, y, z = x, y, z, b, c, d
        a, t = t, a
    e = a * t - b * x - c * y - d * z
    f = a * x + b * t + c * z - d * y
    g = a * y - b * z + c * t + d * x
    h = a * z + b * y - c * x + d * t
    s = 1.0 / math.sqrt(e * e + f * f + g * g + h * h)
    out = np.array([s * e, s * f, s * g, s * h])
    return out, matrix(out)


def log(q: Array) -> Array:
    """Rotation vector [rad] (3,), no longer than pi, of a unit quaternion (4,)."""
    w, x, y, z = q.tolist()
    if w < 0.0:  # the same rotation the short way round
        w, x, y, z = -w, -x, -y, -z
    s = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 * math.atan2(s, w) / s if s > _SMALL * _SMALL else 2.0
    return np.array([factor * x, factor * y, factor * z])


def integrals(phi: Array) -> tuple[Array, Array]:
    r"""Single and double integral of a rotation that grows from 0 to phi, (3, 3) each.

    .. math::
        \Gamma_1 = \int_0^1 \exp(s \phi)\, ds, \quad \Gamma_2 = \int_0^1 \int_0^s \exp(u \phi)\, du\, ds

    Source: Hartley et al., "Contact-aided invariant extended Kalman filtering for robot state estimation",
    IJRR 2020, appendix A.
    """
    K = skew(phi)
    K2 = K @ K
    a, b, c = _coefficients(float(phi @ phi))
    return _EYE + a * K + b * K2, 0.5 * _EYE + b * K + c * K2


def carried(phi: Array, f: Array) -> tuple[Array, Array]:
    """Both `integrals` of phi (3,) times f (3,), without the matrices: (3,) each."""
    (x, y, z), (a, b, c) = phi.tolist(), f.tolist()
    square = x * x + y * y + z * z
    first, second, third = _coefficients(square)
    # phi x f, and phi x (phi x f)
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
    return (
        np.array([a + first * p + second * u, b + first * q + second * v, c + first * r + second * w]),
        np.array(
            [
                0.5 * a + second * p + third * u,
                0.5 * b + second * q + third * v,
                0.5 * c + second * r + third * w,
            ]
        ),
    )


def _coefficients(square: float) -> tuple[float, float, float]:
    """Of the powers of a skew matrix in its integrals, by its squared angle."""
    if square < _SMALL * _SMALL:
        return 0.5, 1.0 / 6.0, 1.0 / 24.0
    angle = math.sqrt(square)
    first = (1.0 - math.cos(angle)) / square
    return first, (angle - math.sin(angle)) / (square * angle), (0.5 - first) / square


def aligning(a: Array, b: Array) -> Array:
    """Quaternion (4,) of the shortest rotation that turns unit vector a (3,) into unit vector b (3,)."""
    w = 1.0 + float(a @ b)
    if w < 1e-9:  # opposite: half a turn about any axis across a
        axis = np.zeros(3)
        axis[int(np.argmin(np.abs(a)))] = 1.0
        axis -= (axis @ a) * a
        return np.array([0.0, *(axis / np.linalg.norm(axis))])
    q = np.array([w, *(skew(a) @ b)])
    return q / np.linalg.norm(q)


_EYE = np.eye(3)
