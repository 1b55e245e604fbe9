"""The stand-in robot in one object: command frames in, state frames out, 2 ms of physics in between."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple

import mujoco
import numpy as np
import torch

from deploy.codec import (
    FOC,
    HEAD,
    LOW_LEVEL,
    STOP,
    Floats,
    FrameError,
    MotorCommand,
    RobotState,
    decode_command,
    encode_state,
)
from deploy.remote import Remote, pack
from hmc.go2 import model as go2
from hmc.go2.stances import FOOTSTAND
from tools.robot.body import EXACT, STEP, Body, build
from tools.robot.faults import Faults, Way
from tools.robot.motors import LIMP, Motors, damp, hold
from tools.robot.sensors import CLEAN, Battery, Encoders, Feet, Imu, Sensors, roll_pitch_yaw

SUBSTEPS = 2  # physics steps a state frame
PERIOD = SUBSTEPS * STEP  # s, from state to state: 500 Hz
DAMPING = 3.0  # N m s/rad, of a robot that is told nothing
LYING = np.array([0.0, 1.36, -2.65] * 4)  # rad, on its belly with folded legs

Start = Literal["lying", "standing", "footstand"]
Loss = Literal["hold", "damp", "limp"]


@dataclass(frozen=True)
class Settings:
    """A stand-in robot.

    Attributes:
        seed: of its body, its sensors' errors and its faults, each with a stream of its own.
        start: lying or standing under its own controller, or in the foot stand, released, its trunk held in
            place until the first command.
        strict: refuse commands without the header and level flag that the robot's own firmware wants;
            some programs do not send them.
        state_delay: from the measurement until a state frame leaves [s]; whole PERIODs.
        command_delay: from the arrival of a command until it acts [s]; whole PERIODs.
        loss: what the motors do when commands stop: hold the last one, damp, or go limp.
        loss_after: so long after the last command [s].
        body: how it differs from the planner's model.
        sensors: errors of its sensors.
        states: faults of the state frames it sends.
        commands: faults of the command frames it receives.
    """

    seed: int = 0
    start: Start = "standing"
    strict: bool = True
    state_delay: float = 0.0
    command_delay: float = 0.002
    loss: Loss = "hold"
    loss_after: float = 0.1
    body: Body = field(default_factory=Body)
    sensors: Sensors = field(default_factory=Sensors)
    states: Faults = field(default_factory=Faults)
    commands: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        for name in ("state_delay", "command_delay"):
            if not 0 <= (value := getattr(self, name)) <= 10:
                raise ValueError(f"{name} of frames must be 0 to 10 s, got {value}")
        if not self.loss_after >= 0:
            raise ValueError(f"loss_after must be 0 s or more, got {self.loss_after}")


def ideal(seed: int = 0, start: Start = "standing") -> Settings:
    """A robot without any unkindness: the planner's body, exact sensors, no delay."""
    return Settings(seed=seed, start=start, command_delay=0.0, body=EXACT, sensors=CLEAN)


class Truth(NamedTuple):
    """What really is, after a step; for a log, never for the wire."""

    tick: int  # ms
    qpos: Floats  # (19,) base position, attitude (w x y z), joints; SI units, world frame
    qvel: Floats  # (18,) base velocity in the world frame, angular velocity in the body's, joints
    torque: Floats  # (12,) N m
    foot_force: Floats  # (4,) N, normal
    released: bool
    accepted: int  # commands since the start
    refused: int


class StandIn:
    """A robot that is stepped by its caller: same settings and same frames in, same frames out.

    Attributes:
        released: whether it listens to commands; until then its own controller holds it.
        motors: which can be weakened or lost.
        feet: whose sensors can get stuck.
        states, commands: the ways of frames, whose faults can be replaced.
        remote: what the operator presses.
        loss: what the motors do when commands stop.
        accepted: number of commands that were followed.
        refused: number of commands that were not, by reason.
    """

    def __init__(self, settings: Settings):
        body, imu, encoders, feet, states, commands = (
            np.random.default_rng([settings.seed, stream]) for stream in range(6)
        )
        self._model, zeros = build(settings.body, body)
        self._data = mujoco.MjData(self._model)
        self._imu = Imu(settings.sensors, imu)
        self._encoders = Encoders(settings.sensors, zeros, encoders)
        self.feet = Feet(settings.sensors, feet)
        self.states = Way(settings.states, round(settings.state_delay / PERIOD), PERIOD, states)
        self.commands = Way(settings.commands, round(settings.command_delay / PERIOD), PERIOD, commands)
        self.motors, self._battery = Motors(), Battery()
        self.remote = Remote()
        self.accepted, self.refused = 0, Counter[str]()
        self._strict, self._loss_after = settings.strict, settings.loss_after
        self.loss: Loss = settings.loss
        self._push, self._push_until = np.zeros(3), 0.0
        self._mean = np.zeros(6)  # rate [rad/s] and specific force [m/s^2] over a period: an IMU adds up

        start = _start(settings.start)
        self._data.qpos[:] = start
        self._own = damp(DAMPING) if settings.start == "lying" else hold(start[7:], 60.0, 5.0)
        self._command, self._heard = self._own, math.inf  # time of the last command: none to lose yet
        self.released = settings.start == "footstand"
        self._model.eq_data[0, :10] = [0, 0, 0, *start[:7]]  # grip at the base's origin, in this pose
        self._data.eq_active[0] = self.released
        mujoco.mj_forward(self._model, self._data)

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self._data.time

    def release(self, released: bool) -> None:
        """Let go of the robot's own controller and listen to commands, or the other way round."""
        if released != self.released:
            self.released, self._command, self._heard = released, damp(DAMPING), math.inf

    def push(self, force: Sequence[float], duration: float) -> None:
        """Push the trunk with a force [N] in the world frame, (3,), for so long [s]; else a ValueError."""
        push = np.array(force, dtype=np.float64)
        if push.shape != (3,) or not np.isfinite([*push, duration]).all():
            raise ValueError(f"a push is three finite forces and a duration, got {force} for {duration}")
        self._push, self._push_until = push, self.time + duration

    def step(self, frames: list[bytes]) -> list[bytes]:
        """Advance by PERIOD under the newest command.

        Args:
            frames: LowCmd frames that came since the last call, oldest first.

        Returns:
            LowState frames that leave: one, but for faults and delay.

        Raises:
            RuntimeError: the simulated robot diverged.
        """
        for frame in self.commands.send(frames):
            self._receive(frame)
        self._mean[:] = 0.0
        for _ in range(SUBSTEPS):
            self._physics()
        self.motors.warm(PERIOD)
        self._battery.draw(self.motors.torque, self._data.qvel[6:], PERIOD)
        return self.states.send([encode_state(self._measure())])

    def truth(self) -> Truth:
        """What really is."""
        return Truth(
            self._tick,
            self._data.qpos.copy(),
            self._data.qvel.copy(),
            self.motors.torque,
            self._data.sensordata[6:10].copy(),
            self.released,
            self.accepted,
            self.refused.total(),
        )

    @property
    def _tick(self) -> int:
        return round(self.time * 1000) % 2**32

    def _receive(self, frame: bytes) -> None:
        try:
            motors, objection = _judged(frame, self._strict)
        except FrameError:
            self.refused["no LowCmd frame"] += 1
            return
        if objection := objection or ("" if self.released else "not released"):
            self.refused[objection] += 1
            return
        self._command, self._heard = motors, self.time
        self._data.eq_active[0] = False
        self.accepted += 1

    def _active(self) -> MotorCommand:
        """What the motors follow now."""
        if not self.released:
            return self._own
        if self.time - self._heard > self._loss_after and self.loss != "hold":
            return damp(DAMPING) if self.loss == "damp" else LIMP
        return self._command

    def _physics(self) -> None:
        data = self._data
        q, dq = data.qpos[7:], data.qvel[6:]
        data.qfrc_applied[6:] = self.motors.drive(self._active(), self._encoders.angle(q), dq)
        data.xfrc_applied[1, :3] = self._push if self.time < self._push_until else 0.0
        mujoco.mj_step(self._model, data)
        # that rate turned the body in this step, that specific force changed its velocity
        self._mean += np.concatenate([data.qvel[3:6], data.sensordata[3:6]]) / SUBSTEPS
        if not np.isfinite(data.qpos).all():
            raise RuntimeError(
                f"the simulated robot diverged at {self.time:.3f} s: are the last command's gains too high?"
            )

    def _measure(self) -> RobotState:
        data = self._data
        mujoco.mj_forward(self._model, data)  # or the feet would be a step behind the encoders
        quat, gyro, acc = self._imu.read(self.time, PERIOD, data.qpos[3:7], self._mean[:3], self._mean[3:])
        q, dq, torque = self._encoders.told(data.qpos[7:], data.qvel[6:], self.motors.torque)
        return RobotState(
            tick=self._tick,
            quat=quat,
            gyro=gyro,
            acc=acc,
            rpy=roll_pitch_yaw(quat),
            q=q,
            dq=dq,
            tau=torque,
            mode=self._active().mode,
            temperature=np.rint(self.motors.temperature).astype(np.int64),
            foot_force=self.feet.read(data.sensordata[6:10], PERIOD),
            remote=pack(self.remote),
            charge=self._battery.charge,
            current=round(1000 * self._battery.current),
            voltage=self._battery.voltage,
        )


@lru_cache(maxsize=1)  # between two control steps a controller says the same again
def _judged(frame: bytes, strict: bool) -> tuple[MotorCommand, str]:
    """What a LowCmd frame tells the motors, and why it is not followed; "" if it may be."""
    command = decode_command(frame)
    mode = command.motors.mode
    if not command.crc_ok:
        return command.motors, "checksum"
    if strict and command.head != HEAD:
        return command.motors, "head"
    if strict and command.level_flag != LOW_LEVEL:
        return command.motors, "level flag"
    if not ((mode == FOC) | (mode == STOP)).all():
        return command.motors, "motor mode"
    finite = np.isfinite(np.concatenate(command.motors[:5])).all()
    return command.motors, "" if finite else "not a number"


def _start(start: Start) -> Floats:
    """Base pose and joints at rest, (19,), the lowest point on the floor."""
    if start == "footstand":
        return FOOTSTAND.state()[:19].numpy()
    x = torch.zeros(1, 37, dtype=torch.float64)
    x[0, 2], x[0, 3] = 1.0, 1.0
    x[0, 7:19] = torch.as_tensor(LYING) if start == "lying" else go2.HOME
    x[0, 2] -= min(float(gap.min()) for gap in go2.clearances(x).values())
    return x[0, :19].numpy()
