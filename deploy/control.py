"""The control process without its process: state frames in, command frames out, nothing waited for."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from deploy.checks import StateChecks
from deploy.codec import FOC, JOINTS, MotorCommand, RobotState, encode_command
from deploy.estimate import Estimate
from deploy.estimator import Estimator
from deploy.modes import NAMES, NONE, Performer
from deploy.observe import vertical
from deploy.remote import ABSENT, unpack
from deploy.safety import EMERGENCY, Body, Envelope, Inputs, Machine, Phase, limited
from deploy.settings import DeployCfg, EnvelopeCfg, RampCfg
from deploy.slots import STATE
from deploy.so3 import Array
from hmc.go2 import facts
from hmc.go2.network import Network

TICK = round(1000 * facts.DT)  # ms
_ZERO = np.zeros(JOINTS)
_FOC = np.full(JOINTS, FOC)
_ARRIVED, _OVERTIME = 0.4, 2.0  # rad off the pose that counts as standing; s that it may take longer
_SETTLED_SPEED, _SETTLED_TILT = 0.2, math.radians(3.0)  # m/s, rad: standard deviations


class Control:
    """Estimator, state machine, modes and limits at one place.

    The robot's own clock makes the ticks: ten states a tick. So a policy acts at the rate that it was trained
    at even where a simulated robot loses time, and no second clock drifts against the first.

    Attributes:
        machine: phases.
        performer: modes of the plan.
        checks: of the state frames.
        k: ticks so far.
        missed: ticks that were left out because states came too late.
        state: last good one.
        estimate: at it; None while the estimator does not know.
        target: joint targets commanded last [rad], (12,).
        asked: tick at which the operator asked for the handstand; -1 before.
        planner: whether the planner has been heard of.
        wait: what has to come before the robot may be started; "" for nothing.
        situation: value of the state's slot, of the last tick with modes.

    Args:
        cfg: settings.
        policies: of the modes that are policies, by their index.
    """

    def __init__(self, cfg: DeployCfg, policies: Mapping[int, Network]):
        self.cfg = cfg
        self.machine, self.performer = Machine(), Performer(cfg.plan, policies)
        self.checks, self.estimator = StateChecks(cfg.input), Estimator()
        self.k, self.missed, self.asked = 0, 0, -1
        self.state: RobotState | None = None
        self.estimate: Estimate | None = None
        self.target: Array = np.full(JOINTS, np.nan)
        self.planner, self.wait = False, ""
        self.situation = np.zeros((), STATE)
        self._first = -1  # ms of tick 0
        self._envelope = Envelope()
        self._entered = 0  # ms of the phase's entry
        self._ramp: RampCfg | None = None
        self._from, self._ramp_began = _ZERO, 0  # where it begins [rad], and when [ms]
        self._frame: bytes | None = None
        self._fault = ""
        self._heard: float | None = None  # when the state came that `settle` has yet to look at [s]
        self._ticked = -1  # ms of the last tick's state
        self._anew = False  # whether the estimator has begun anew since the robot stands

    @property
    def phase(self) -> Phase:
        """Where the state machine is."""
        return self.machine.phase

    def hear(self, frame: bytes, now: float) -> bool:
        """Take a state frame that came `now` [s], all of it; whether it made a tick."""
        ticked = self.react(frame, now)
        self.settle()
        return ticked

    def react(self, frame: bytes, now: float) -> bool:
        """Take a state frame that came `now` [s], and command what a tick asks for; whether it made one.

        What takes longer, and a command can do without, is left to `settle`, which has to follow. What is
        known to be wrong without it ends in damping first.
        """
        state = self.checks.take(frame, now)
        if state is None:
            self.idle(now)
            return False
        self.state, ms, self._heard = state, self.checks.ms, now
        if self._first < 0:
            self._first = ms
        if self._fault or self.checks.fault(now) or unpack(state.remote).buttons & EMERGENCY == EMERGENCY:
            self.settle()
        if (due := (ms - self._first) // TICK) <= self.k:
            return False
        x = None
        if self.phase == Phase.HYBRID:
            x = self.estimator.ahead(0.001 * ms, state.gyro, state.acc, state.q, state.dq)
            if x is None:  # a reading is missing, or came late: the estimate comes first
                self.settle()
                x = None if self.estimate is None else self.estimate.x
        self.missed += due - self.k - 1
        self.k, self._ticked = due, ms
        self._tick(x)
        return True

    def settle(self) -> None:
        """What the last state means for the estimate, and both for the phase."""
        if self._heard is None or self.state is None:
            return
        state, now, self._heard = self.state, self._heard, None
        self.estimate = self.estimator.update(
            0.001 * self.checks.ms,
            state.gyro,
            state.acc,
            state.q,
            state.dq,
            state.tau,
            state.foot_force.astype(np.float64),
        )
        if self.estimate is not None and self.checks.ms == self._ticked:
            self.situation["x"] = self.estimate.x
        fault = self._fault or self.checks.fault(now) or self._outside(state)
        if self.phase == Phase.PASSIVE:
            fault = fault or self.wait
        phase = self.phase  # what a phase does not ask for is not looked at: this is done 500 times a second
        posed = phase in (Phase.LIE, Phase.STAND, Phase.READY) and self._posed()
        settled = phase == Phase.STAND and self._settled()
        # what is held while the remote cannot be heard is not let go, nor pressed anew after that
        buttons = None if state.remote == ABSENT else unpack(state.remote).buttons
        self._step(Inputs(buttons, fault, posed, settled, self.planner))

    def idle(self, now: float) -> None:
        """No frame came that is believed."""
        self._step(Inputs(None, self._fault or self.checks.fault(now)))

    def fail(self, fault: str) -> None:
        """Something outside is wrong."""
        self._fault = self._fault or fault
        self._step(Inputs(None, self._fault))

    @property
    def due_ms(self) -> int:
        """When the last tick was due, by the robot's clock [ms]."""
        return self._first + self.k * TICK

    @property
    def command(self) -> bytes | None:
        """The LowCmd frame to send; None in the passive phase, in which nothing is commanded."""
        return self._frame

    def _step(self, inputs: Inputs) -> None:
        before = self.machine.phase
        phase = self.machine.step(inputs)
        if self.machine.asked and self.asked < 0:
            self.asked = self.k
        if phase != before:
            self._enter(phase, before)

    def _enter(self, phase: Phase, before: Phase) -> None:
        self._entered, self._anew = self.checks.ms, False
        self._ramp = {Phase.LIE: self.cfg.lie, Phase.STAND: self.cfg.stand}.get(phase, self._ramp)
        if phase in (Phase.LIE, Phase.STAND):
            assert self.state is not None
            self.target = self._from = self.state.q if before == Phase.PASSIVE else self.target
            self._ramp_began = self.checks.ms
        if phase == Phase.DAMPING:
            self._frame = self._encode(_ZERO, 0.0, self.cfg.output.damping)

    def _tick(self, x: Array | None) -> None:
        """Command this control step, in which the state is x (37,); only modes ask for it."""
        phase = self.phase
        if phase in (Phase.PASSIVE, Phase.DAMPING):
            return
        try:
            if phase == Phase.HYBRID:
                assert x is not None
                wanted, kp, kd, step = self._perform(x), facts.KP, facts.KD, self.cfg.output.step
            else:
                ramp = self._ramp
                assert ramp is not None
                wanted, kp, kd, step = self._ramped(), ramp.kp, ramp.kd, ramp.step
            self.target = limited(wanted, self.target, step)
        except ValueError as error:
            self.fail(str(error))
            return
        self._frame = self._encode(self.target, kp, kd)

    def _perform(self, x: Array) -> Array:
        """What the plan's mode wants in state x; what a planner has to know is taken down before."""
        performer, now = self.performer, self.situation
        performer.take_over(self.k)
        now["k"], now["x"], now["u"], now["asked"], now["running"] = self.k, x, self.target, self.asked, 1
        now["mode"], now["entered"], now["anchor"] = performer.mode, performer.entered, performer.anchor
        now["plan"] = performer.plan.number if performer.plan else 0
        return performer.act(self.k, x, self.target)

    def _ramped(self) -> Array:
        """Where the slow motion is now; its speed is zero at both ends."""
        assert self._ramp is not None
        part = min(1.0, self._ramping / self._ramp.seconds)
        w = 0.5 - 0.5 * math.cos(math.pi * part)
        return (1.0 - w) * self._from + w * self._ramp.joints

    @property
    def _elapsed(self) -> float:
        """Since the phase's entry [s]."""
        return 0.001 * (self.checks.ms - self._entered)

    @property
    def _ramping(self) -> float:
        """Since the slow motion began [s]."""
        return 0.001 * (self.checks.ms - self._ramp_began)

    def _posed(self) -> bool:
        if self._ramp is None or self.state is None or self._ramping < self._ramp.seconds:
            return False
        if self.phase == Phase.LIE:  # a robot on its belly may not be able to fold its legs further
            return True
        off = float(np.abs(self.state.q - self._ramp.joints).max())
        if self.phase != Phase.STAND:
            return off < _ARRIVED
        if off < _ARRIVED:
            if not self._anew:  # the belly is no foothold: heights are known from here on
                self._anew = True
                self.estimator.reset()
                self.estimate = None
            return True
        if self._ramping > self._ramp.seconds + _OVERTIME:
            self._fault = f"the robot did not stand up: a joint is {off:.2f} rad off its place"
        return False

    def _settled(self) -> bool:
        """Whether the estimator knows the state well."""
        if self.estimate is None:
            return False
        speed, tilt = uncertainty(self.estimate)
        return speed < _SETTLED_SPEED and tilt < _SETTLED_TILT

    def _outside(self, state: RobotState) -> str:
        """Which limit of the phase or mode the robot has been outside of for too long."""
        phase, estimate = self.phase, self.estimate
        if phase in (Phase.PASSIVE, Phase.DAMPING):
            return ""
        blind = phase in (Phase.LIE, Phase.STAND)  # nothing rests on the estimator yet
        if estimate is None and not blind:
            return "the estimator lost the state"
        if estimate is None or blind:
            body = Body(vertical(state.quat), math.nan, state.q, state.dq, state.tau)
        else:
            up, height = estimate.C[2], float(estimate.x[2])
            body = Body(up, height, state.q, state.dq, state.tau, *uncertainty(estimate))
        name, cfg, since = self._limits(phase)
        return self._envelope.check(cfg, name, body, since, 0.001 * self.checks.ms)

    def _limits(self, phase: Phase) -> tuple[str, EnvelopeCfg, float]:
        """Name and envelope of the phase or mode, and the time since its entry [s]."""
        envelope = self.cfg.envelope
        if phase != Phase.HYBRID or self.performer.mode == NONE:
            stance = {Phase.LIE: envelope.lie, Phase.STAND: envelope.stand}.get(phase, envelope.ready)
            return phase.name.lower(), stance, self._elapsed
        mode = self.performer.mode
        since = facts.DT * (self.k - self.performer.entered)
        return NAMES[mode], (envelope.foot, envelope.jump, envelope.hand)[mode], since

    def _encode(self, q: Array, kp: float, kd: float) -> bytes:
        return encode_command(MotorCommand(q, _ZERO, _ZERO, np.full(JOINTS, kp), np.full(JOINTS, kd), _FOC))


def uncertainty(estimate: Estimate) -> tuple[float, float]:
    """Standard deviations of velocity [m/s] and tilt [rad], of the axis where they are largest.

    Of velocity in the body frame: in the world's, a heading that nobody can know makes a jump's unknown.
    """
    speed, tilt = estimate.velocity_covariance(), estimate.tilt_covariance()
    return math.sqrt(max(speed.diagonal().max(), 0.0)), math.sqrt(max(tilt.diagonal().max(), 0.0))
