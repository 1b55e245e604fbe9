"""What the reference filters share: clean frames, contacts, and the still stand at the start."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from deploy import so3
from deploy.contact import ContactCfg, FootContact
from deploy.ekf import Flags
from deploy.kinematics import FOOT_RADIUS, IMU, Legs, legs
from deploy.so3 import Array
from tools.estimators.sensors import Readings


@dataclass(frozen=True)
class Frame:
    """One tick without faults: what is not finite is as in the tick before.

    Attributes:
        dt: since the frame before [s].
        gyro, acc: [rad/s], [m/s^2], (3,).
        leg: kinematics of the legs.
        qd: joint speeds [rad/s], (4, 3).
        tau: joint torques [N m], (12,).
        force: foot forces [counts], (4,).
    """

    dt: float
    gyro: Array
    acc: Array
    leg: Legs
    qd: Array
    tau: Array
    force: Array


class Reference(Protocol):
    """A filter as the study runs it: started at rest, then stepped; the attributes are its output.

    Attributes:
        C: attitude, body to world, (3, 3).
        v, r: velocity and position of the IMU in the world frame [m/s], [m], (3,).
        gyro_bias: its estimate [rad/s], (3,).
    """

    C: Array
    gyro_bias: Array

    @property
    def v(self) -> Array: ...

    @property
    def r(self) -> Array: ...

    def start(self, C: Array, gyro: Array, r: Array, s: Array) -> None:
        """Begin at attitude C with mean angular velocity gyro, position r and feet s (4, 3) from the IMU."""

    def step(self, frame: Frame, contact: Flags) -> None:
        """One tick."""


def frames(readings: Readings) -> Iterator[Frame | None]:
    """A frame for each reading; None for one that is not newer than the last."""
    last, held = -np.inf, None
    for t, *parts in readings:
        row = np.concatenate(parts)
        held = row if held is None else np.where(np.isfinite(row), row, held)
        dt, last = t - last, max(t, last)
        if dt <= 0.0:
            yield None
            continue
        gyro, acc, q, qd, tau, force = np.split(held, [3, 6, 18, 30, 42])
        yield Frame(min(dt, 0.002) if np.isinf(dt) else dt, gyro, acc, legs(q), qd.reshape(4, 3), tau, force)


def run(reference: Reference, readings: Readings, still: float = 0.25) -> Array:
    """Body velocity, gravity direction and base height at each reading, (n, 7); NaN before the start.

    Contacts are those of the estimator's own detector, so that filters are compared and not thresholds.
    """
    detectors = [FootContact(ContactCfg()) for _ in range(4)]
    out = np.full((len(readings.t), 7), np.nan)
    rest: list[Array] = []
    begun, omega, elapsed = False, np.zeros(3), 0.0
    for i, frame in enumerate(frames(readings)):
        if frame is not None:
            elapsed += frame.dt
            if not begun:
                rest.append(np.concatenate([frame.gyro, frame.acc]))
                if elapsed < still:
                    continue
                mean, s = np.mean(rest, 0), frame.leg.foot - IMU
                C = so3.matrix(so3.aligning(mean[3:] / np.linalg.norm(mean[3:]), np.array([0.0, 0.0, 1.0])))
                r = np.array([0.0, 0.0, FOOT_RADIUS - (s @ C[2]).min()])
                reference.start(C, mean[:3], r, s)
                begun = True
                continue
            load = normal_load(frame.leg.jacobian, frame.tau, reference.C[2])
            forces = zip(detectors, frame.force, load, strict=True)
            reference.step(frame, np.array([foot.update(f, n, frame.dt) for foot, f, n in forces]))
            omega = frame.gyro - reference.gyro_bias
        if begun:
            out[i, :3] = reference.v @ reference.C - np.cross(omega, IMU)
            out[i, 3:6] = -reference.C[2]
            out[i, 6] = reference.r[2] - reference.C[2] @ IMU
    return out


def normal_load(jacobian: Array, tau: Array, up: Array) -> Array:
    r"""Normal force of the ground on each foot by its joint torques, inertia left out [N], (4,).

    .. math:: f = -J^{-T} \tau, \quad n = e_z^T C f

    Args:
        jacobian: of the feet [m/rad], (4, 3, 3).
        tau: joint torques [N m], (12,).
        up: world z in the body frame, (3,).
    """
    force = np.linalg.solve(jacobian.transpose(0, 2, 1), -tau.reshape(4, 3, 1))
    return np.asarray(force[:, :, 0] @ up)
