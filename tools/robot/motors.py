"""The stand-in's motors: the servo law that runs on the robot, within the torque-speed curve."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase

import numpy as np

from deploy.codec import FOC, POSITION_STOP, VELOCITY_STOP, Floats, MotorCommand
from hmc.go2.model import GEAR, JOINTS, NO_LOAD, PEAK, STALL

_STALL = STALL * GEAR.numpy().astype(np.float64)
_PEAK = PEAK * GEAR.numpy().astype(np.float64)
_SLOPE = _STALL / (NO_LOAD / GEAR.numpy().astype(np.float64))
_NONE = np.zeros(len(JOINTS))
LIMP = MotorCommand(_NONE, _NONE, _NONE, _NONE, _NONE, np.full(len(JOINTS), FOC))


def hold(pose: Floats, kp: float, kd: float) -> MotorCommand:
    """Hold a pose [rad], (12,), with these gains on every joint."""
    return LIMP._replace(q=pose, kp=np.full(len(JOINTS), kp), kd=np.full(len(JOINTS), kd))


def damp(kd: float) -> MotorCommand:
    """Resist motion only."""
    return LIMP._replace(kd=np.full(len(JOINTS), kd))


def servo(command: MotorCommand, q: Floats, dq: Floats) -> Floats:
    r"""Torque that the motors are asked for [N m], (12,).

    .. math:: \tau = \tau_{ff} + k_p (q^* - q) + k_d (\dot q^* - \dot q)

    without the position term where q* is POSITION_STOP, without the velocity term where dq* is
    VELOCITY_STOP, and zero where the mode is not FOC.

    Args:
        command: set points.
        q: angles that the encoders read [rad], (12,).
        dq: joint speeds [rad/s], (12,).
    """
    position = np.where(command.q == POSITION_STOP, 0.0, command.kp * (command.q - q))
    velocity = np.where(command.dq == VELOCITY_STOP, 0.0, command.kd * (command.dq - dq))
    return np.where(command.mode == FOC, command.tau + position + velocity, 0.0)


def limit(torque: Floats, dq: Floats) -> Floats:
    """What the motors can do of it at these speeds: `hmc.go2.model.motor_torque` has the curve."""
    back = _SLOPE * dq  # minimum and maximum: np.clip takes several times as long
    top = np.maximum(np.minimum(_STALL - back, _PEAK), -_PEAK)
    bottom = np.minimum(np.maximum(-_STALL - back, -_PEAK), _PEAK)
    return np.maximum(np.minimum(torque, top), bottom)


class Motors:
    """Twelve motors that warm up, weaken and break.

    Attributes:
        strength: part of the torque that comes out, (12,); 0 for a motor that is lost.
        torque: at the joints, in the last step [N m], (12,).
        temperature: [deg C], (12,).
    """

    # K per (N m)^2 and s, and 1/s: about 10 K a minute at 10 N m, back to ambient in ten minutes. Assumed.
    HEATING, COOLING, AMBIENT = 0.0017, 1 / 600, 30.0

    def __init__(self) -> None:
        self.strength = np.ones(len(JOINTS))
        self.torque = np.zeros(len(JOINTS))
        self.temperature = np.full(len(JOINTS), self.AMBIENT)

    def weaken(self, parts: Mapping[str, float]) -> None:
        """Let only a part of the torque out of these joints' motors, all of it out of the others'.

        Args:
            parts: from joint names, or patterns such as "FL_*", to 0 (a lost motor) .. 1; later ones win.
        """
        strength = np.ones(len(JOINTS))
        for pattern, part in parts.items():
            chosen = [fnmatchcase(joint, pattern) for joint in JOINTS]
            if not any(chosen):
                raise ValueError(f"no joint is like {pattern!r}: there are {', '.join(JOINTS)}")
            if not 0 <= part <= 1:
                raise ValueError(f"strength of {pattern} must be 0 to 1, got {part}")
            strength[chosen] = part
        self.strength = strength

    def drive(self, command: MotorCommand, q: Floats, dq: Floats) -> Floats:
        """Torque at the joints [N m], (12,); arguments as in `servo`."""
        self.torque = self.strength * limit(servo(command, q, dq), dq)
        return self.torque

    def warm(self, dt: float) -> None:
        """Heat and cool for dt [s] at the present torque."""
        heat = self.HEATING * self.torque**2 - self.COOLING * (self.temperature - self.AMBIENT)
        self.temperature = self.temperature + dt * heat
