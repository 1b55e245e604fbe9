"""cfg/deploy.toml as frozen dataclasses: limits, ramps and times of the deployment, with their units.

What a Go2 cannot be told in earnest, such as a negative gain, is a ValueError that names the setting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deploy.slots import STEPS
from hmc.go2 import facts

_TIME = 0.001, 3600.0  # s
_MAYBE = 0.0, 3600.0  # s, of what may be left out
_READING = 0.0, 1000.0  # of any sensor
_KP, _KD = (0.0, 200.0), (0.0, 20.0)  # N m/rad, N m s/rad: several times what stands it up
_DAMPING = 1.0, 20.0  # N m s/rad: with less the legs are as good as limp
_STEP = 0.001, 2 * math.pi  # rad, at most more than a joint has
_TURN = -2 * math.pi, 2 * math.pi  # rad
_KINDS = ("hip", "thigh", "calf")
_LOWEST = tuple(max(facts.Q_LOWER[i::3]) for i in range(3))  # that every leg can [rad]
_HIGHEST = tuple(min(facts.Q_UPPER[i::3]) for i in range(3))


def _within(name: str, value: float, low: float, high: float) -> None:
    """A setting may be either end of its range; NaN is never within."""
    if not low <= value <= high:
        raise ValueError(f"{name} must be {low:g} to {high:g}, got {value:g}")


def _check(cfg: object, limits: tuple[float, float], *names: str) -> None:
    """Whether fields, or all that each holds, are within the same range."""
    for name in names:
        found = getattr(cfg, name)
        for value in found if isinstance(found, tuple) else (found,):
            _within(name, value, *limits)


def _rises(name: str, low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"{name} must rise from its least to its most, got {low:g} to {high:g}")


@dataclass(frozen=True)
class InputCfg:
    """What a state frame has to be like.

    Attributes:
        max_age: without a good frame for longer, the robot is damped [s]; time in which the control process
            stood still itself counts hardly.
        stall: without one for longer it is in any case [s].
        gyro: largest reading [rad/s].
        acc: largest reading [m/s^2].
        joint_margin: how far an encoder may read beyond a joint's limits [rad].
        joint_speed: largest reading [rad/s].
        torque: largest reading [N m].
        temperature: of a motor, at most [deg C].
        min_charge: of the battery, to start with [%].
        frozen: time in which the IMU may tell the same to the last bit [s]; no noise does.
        remote: time without the remote after which the robot is damped [s]: its L2 and B end everything.
    """

    max_age: float = 0.06
    stall: float = 0.2
    gyro: float = 35.0
    acc: float = 157.0
    joint_margin: float = 0.35
    joint_speed: float = 80.0
    torque: float = 90.0
    temperature: float = 85.0
    min_charge: int = 20
    frozen: float = 0.04
    remote: float = 3.0

    def __post_init__(self) -> None:
        _check(self, _TIME, "max_age", "stall", "frozen", "remote")
        _check(self, _READING, "gyro", "acc", "joint_margin", "joint_speed", "torque")
        _check(self, (0.0, 255.0), "temperature")
        _check(self, (0, 100), "min_charge")


@dataclass(frozen=True)
class EnvelopeCfg:
    """Within what a phase or mode is as it should be.

    A mode that begins somewhere else has `settle` to come into its pitch and height.

    Attributes:
        pitch: of the body, least and most: -90 nose up, 90 nose down [deg].
        lean: of its plane of symmetry from the vertical, at most [deg].
        height: of the base, least and most [m].
        settle: time without limits of pitch and height after the mode's entry [s].
        joint_low, joint_high: of hip, thigh and calf of every leg [rad]; by default more than they can.
        joint_speed: at most [rad/s].
        torque: of a joint, relative to its motor's peak, at most.
        velocity_std: of the estimated velocity in the body frame, at most [m/s].
        tilt_std: of the estimated attitude, at most [deg].
        patience: how long a limit may be exceeded [s].
    """

    pitch: tuple[float, float] = (-180.0, 180.0)
    lean: float = 60.0
    height: tuple[float, float] = (-0.1, 2.0)
    settle: float = 0.0
    joint_low: tuple[float, float, float] = (-1.15, -1.67, -2.83)
    joint_high: tuple[float, float, float] = (1.15, 4.64, -0.73)
    joint_speed: float = 45.0
    torque: float = 1.5
    velocity_std: float = 1.0
    tilt_std: float = 10.0
    patience: float = 0.03

    def __post_init__(self) -> None:
        _check(self, (-360.0, 360.0), "pitch")
        _check(self, (0.0, 180.0), "lean", "tilt_std")
        _check(self, (-10.0, 10.0), "height")
        _check(self, _MAYBE, "settle", "patience")
        _check(self, _TURN, "joint_low", "joint_high")
        _check(self, _READING, "joint_speed")
        _check(self, (0.0, 10.0), "torque", "velocity_std")
        _rises("pitch", *self.pitch)
        _rises("height", *self.height)
        for kind, low, high in zip(_KINDS, self.joint_low, self.joint_high, strict=True):
            _rises(f"joint_low to joint_high of the {kind}", low, high)

    @cached_property
    def joints(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """`joint_low` and `joint_high` of all joints, (12,) each."""
        return np.tile(self.joint_low, 4), np.tile(self.joint_high, 4)


@dataclass(frozen=True)
class EnvelopesCfg:
    """An envelope for each phase and mode in which the motors are commanded."""

    lie: EnvelopeCfg = field(default_factory=EnvelopeCfg)
    stand: EnvelopeCfg = field(default_factory=EnvelopeCfg)
    ready: EnvelopeCfg = field(default_factory=EnvelopeCfg)
    foot: EnvelopeCfg = field(default_factory=EnvelopeCfg)
    jump: EnvelopeCfg = field(default_factory=EnvelopeCfg)
    hand: EnvelopeCfg = field(default_factory=EnvelopeCfg)


@dataclass(frozen=True)
class RampCfg:
    """A slow motion of all joints into a pose, which is then held.

    Attributes:
        pose: hip, thigh, calf of every leg [rad].
        seconds: duration [s].
        kp: [N m/rad].
        kd: [N m s/rad].
        step: change of a joint's target from one control step to the next, at most [rad].
    """

    pose: tuple[float, float, float]
    seconds: float
    kp: float
    kd: float
    step: float = 0.1

    def __post_init__(self) -> None:
        for kind, angle, low, high in zip(_KINDS, self.pose, _LOWEST, _HIGHEST, strict=True):
            _within(f"pose of the {kind}", angle, low, high)
        _check(self, _TIME, "seconds")
        _check(self, _KP, "kp")
        _check(self, _KD, "kd")
        _check(self, _STEP, "step")

    @cached_property
    def joints(self) -> NDArray[np.float64]:
        """`pose` of all joints, (12,)."""
        return np.tile(self.pose, 4)


@dataclass(frozen=True)
class OutputCfg:
    """Limits of what is commanded.

    Attributes:
        step: change of a joint's target from one control step to the next while modes run, at most [rad].
        damping: gain while the robot is damped [N m s/rad].
    """

    step: float = 2.0
    damping: float = 5.0

    def __post_init__(self) -> None:
        _check(self, _STEP, "step")
        _check(self, _DAMPING, "damping")


@dataclass(frozen=True)
class PlanCfg:
    """How plans are taken over.

    Attributes:
        expires: control steps after a plan's begin from which on it starts no other mode.
        jump: control steps that a jump may last.
        quantile: of the planner's latest times that the next one is expected to take.
        longest: control steps that are planned ahead for, at most.
    """

    expires: int = 40
    jump: int = 60
    quantile: float = 0.8
    longest: int = 40

    def __post_init__(self) -> None:
        _check(self, (1, STEPS), "expires", "jump", "longest")
        _check(self, (0.0, 1.0), "quantile")


@dataclass(frozen=True)
class WatchdogCfg:
    """The watchdog.

    Attributes:
        period: between two looks, and two damping commands [s].
        hang: age of the control process's heartbeat at which it counts as hung, without the time in which the
            watchdog stood still itself [s].
        stall: age at which it does in any case [s].
        lost: age of the watchdog's own at which the control process damps [s], counted as `hang` is.
        after: how long it goes on damping when the program that started it is gone [s].
    """

    period: float = 0.004
    hang: float = 0.07
    stall: float = 0.2
    lost: float = 0.08
    after: float = 5.0

    def __post_init__(self) -> None:
        _check(self, (0.001, 0.1), "period")  # a tenth of a second is a long fall
        _check(self, _TIME, "hang", "stall", "lost")
        _check(self, _MAYBE, "after")


@dataclass(frozen=True)
class DeployCfg:
    """cfg/deploy.toml."""

    lie: RampCfg = RampCfg((0.0, 1.36, -2.65), 1.5, 30.0, 2.0)
    stand: RampCfg = RampCfg((0.0, 0.9, -1.8), 2.0, 60.0, 4.0)
    input: InputCfg = field(default_factory=InputCfg)
    output: OutputCfg = field(default_factory=OutputCfg)
    envelope: EnvelopesCfg = field(default_factory=EnvelopesCfg)
    plan: PlanCfg = field(default_factory=PlanCfg)
    watchdog: WatchdogCfg = field(default_factory=WatchdogCfg)
