"""The deployment closed in lock step: stand-in, control process, watchdog and a planner, on one clock."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from deploy.codec import VELOCITY_STOP, decode_command
from deploy.control import Control
from deploy.log import Recorder
from deploy.loop import Loop, policies
from deploy.modes import FOOT, NONE
from deploy.observe import vertical
from deploy.remote import Button, Remote
from deploy.safety import Body, Phase, violations
from deploy.settings import DeployCfg
from deploy.slots import Board
from deploy.watchdog import Watchdog, damping
from hmc.cfg import load
from hmc.go2.network import LOWER, UPPER
from hmc.go2.stances import FOOTSTAND, STAND
from tools.robot.standin import PERIOD, Settings, StandIn

CFG = load(Path("cfg/deploy.toml"), DeployCfg, ("lie.seconds=0.4", "stand.seconds=0.8"))
LOOK = round(CFG.watchdog.period / PERIOD)  # steps between two looks of the watchdog
PLAN = 20  # steps between two plans
STEPS = 40  # of a plan
LYING, LEVEL = (
    0.15,
    math.cos(math.radians(20.0)),
)  # m, base of a robot on its belly at most; cosine of its tilt
DOUBT = 5.0, 0.05  # deg, m: how far the robot may be outside of its envelope before the estimate has to tell


class Wire:
    """The control process's link, its subscriber and its publisher at once; judges whatever is published.

    Attributes:
        frames: of the robot, on their way to the control process.
        sent: commands on their way to the robot.
        others: publishers of rt/lowcmd that do not belong here.
        count: commands published.
    """

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.sent: list[bytes] = []
        self.others: list[str] = []
        self.count = 0
        self._last = b""
        self._target: np.ndarray | None = None

    def take(self, timeout: float = 0.0) -> list[bytes]:
        taken, self.frames = self.frames, []
        return taken

    def write(self, command: bytes) -> None:
        self.sent.append(command)
        self.count += 1
        if command != self._last:
            self._check(command)
            self._last = command

    def publisher(self, topic: str, kind: type) -> Wire:
        return self

    def rivals(self, topic: str, ours: tuple[int, ...] = (), most: int = 0) -> list[str]:
        return self.others

    def follow(self, target: np.ndarray) -> None:
        """Take joint targets [rad], (12,), for the last that were published."""
        self._target = target.copy()

    def _check(self, command: bytes) -> None:
        """Whatever is commanded is a number, within the joints' limits and the limit of its rate."""
        frame = decode_command(command)
        motors = frame.motors
        assert frame.crc_ok
        for numbers in motors[:5]:
            assert np.isfinite(numbers).all()
        assert 0.0 <= motors.kp.min() <= motors.kp.max() <= 60.0
        assert 0.0 < motors.kd.min() <= motors.kd.max() <= 5.0
        assert np.abs(motors.dq).max() < VELOCITY_STOP
        assert not motors.tau.any()
        if not motors.kp.any():
            return
        assert (motors.q >= LOWER - 1e-6).all()
        assert (motors.q <= UPPER + 1e-6).all()
        assert self._target is not None
        assert np.abs(motors.q - self._target).max() <= CFG.output.step + 1e-5
        self._target = motors.q


class Rig:
    """A robot and what controls it; faults replace parts of it.

    Attributes:
        robot: stand-in.
        control: what decides in the control process.
        now: clock of all processes [s].
        board, wire: slots and link between them.
        change: what becomes of state frames on their way.
        before: goes before every step.
        turning: whether the control process runs.
        gone: whether it has ended.
        watching: whether the watchdog runs.
        planning: whether the planner runs.

    Args:
        robot: stand-in.
        control: what decides.
        now: clock [s].
    """

    def __init__(self, robot: StandIn, control: Control, now: float = 1000.0):
        self.robot, self.control, self.now = robot, control, now
        self.board, self.wire = Board(), Wire()
        self.change: Callable[[bytes], bytes] = lambda frame: frame
        self.before: Callable[[], object] = lambda: None
        self.turning = self.watching = self.planning = True
        self.gone = False
        self._watchdog = Watchdog(self.board, CFG.watchdog)
        self._loop = Loop(self.wire, self.wire, self.board, control, Recorder(-1), dry_run=False)
        self._steps = self._plans = 0
        # before the first command the targets are where the joints are
        passive = control.phase == Phase.PASSIVE
        self.wire.follow(robot.truth().qpos[7:] if passive else control.target)

    @classmethod
    def lying(cls, seed: int = 0) -> Rig:
        """A robot that lies, whose clock has run for a while, and nothing started yet."""
        robot = StandIn(Settings(seed=seed, start="lying"))
        robot.release(True)
        robot._data.time = 10.0
        return cls(robot, Control(CFG, policies("", "")))

    def fork(self) -> Rig:
        """Another one in the same state; the model and the networks are shared."""
        shared = [self.robot._model, *self.control.performer._policies.values()]
        robot, control = copy.deepcopy((self.robot, self.control), {id(it): it for it in shared})
        return Rig(robot, control, self.now)

    @property
    def phase(self) -> Phase:
        """Where the state machine is."""
        return self.control.phase

    def press(self, *buttons: Button) -> None:
        """Hold these buttons, and no others, from now on."""
        held = Button(0)
        for button in buttons:
            held |= button
        self.robot.remote = Remote(held)

    def reach(self, phase: Phase, seconds: float) -> None:
        """Press START until this phase, and stay in it for a while [s]."""
        until = self.now + 10.0
        while self.phase != phase:
            assert self.now < until, self.control.machine.hint or self.control.machine.reason
            self.press(*([Button.START] if self._steps % 100 < 50 else []))
            self.step()
        self.press()
        self.run(seconds)

    def run(self, seconds: float) -> None:
        """Go on for so long [s]."""
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def step(self) -> None:
        """Go on by a state frame, 2 ms."""
        self.now += PERIOD
        self._steps += 1
        self.before()
        sent, self.wire.sent = self.wire.sent, []
        self.wire.frames += map(self.change, self.robot.step(sent))
        if self.planning and self._steps % PLAN == 0:
            self.plan()
        if self.watching and self._steps % LOOK == 0 and self._watchdog.look(self.gone, self.now):
            self.wire.write(damping(CFG.output.damping))
        if self.turning:
            with mock.patch.object(time, "monotonic", return_value=self.now):
                self._loop.turn()

    def plan(self, late: int = 0, **fields: object) -> None:
        """Publish a plan: the stance goes on. Until modes run, that the planner is there.

        Args:
            late: control steps by which it comes too late.
            fields: of its record, in place of these.
        """
        record, performer = self.board.plan.blank(), self.control.performer
        record["t"] = self.now
        if performer.mode != NONE:
            self._plans += 1
            record["number"], record["base"] = self._plans, self.control.k - late
            record["begin"], record["running"] = self.control.k + 5 - late, performer.mode
            record["steps"], record["modes"] = STEPS, FOOT
        for name, value in fields.items():
            record[name][...] = value
        self.board.plan.write(record)

    @property
    def damped(self) -> bool:
        """Whether what the motors follow only resists motion."""
        motors = self.robot._active()
        return not motors.kp.any() and not motors.tau.any() and bool((motors.kd > 0.0).all())

    @property
    def upright(self) -> bool:
        """Whether the robot really is how its phase wants it: on its belly, on four feet or on two."""
        truth = self.robot.truth()
        level, height = float(vertical(truth.qpos[3:7])[2]) > LEVEL, float(truth.qpos[2])
        if self.phase in (Phase.PASSIVE, Phase.LIE):
            return level and height < LYING
        if self.phase == Phase.STAND:
            return level
        x = torch.from_numpy(np.concatenate([truth.qpos, truth.qvel]))[None]
        return bool((FOOTSTAND if self.phase == Phase.HYBRID else STAND).held(x))

    @property
    def outside(self) -> bool:
        """Whether the robot really is outside of the phase's envelope, by more than the estimate's error."""
        truth, (_, cfg, since) = self.robot.truth(), self.control._limits(self.phase)
        angle, height = DOUBT
        wide = replace(
            cfg,
            pitch=(cfg.pitch[0] - angle, cfg.pitch[1] + angle),
            lean=cfg.lean + angle,
            height=(cfg.height[0] - height, cfg.height[1] + height),
        )
        zero = np.zeros(12)
        body = Body(vertical(truth.qpos[3:7]), float(truth.qpos[2]), truth.qpos[7:], zero, zero)
        return bool(violations(wide, body, since))
