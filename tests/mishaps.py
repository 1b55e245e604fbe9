"""Faults of the deployment, made at a `Rig`, and what has to come of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np

from deploy.codec import decode_state, encode_state
from deploy.ekf import V
from deploy.estimate import Estimate
from deploy.modes import FOOT, HAND, JUMP
from deploy.remote import Button
from deploy.safety import Phase
from tests.rig import STEPS, Rig
from tools.robot.faults import Faults
from tools.robot.standin import PERIOD, Loss

PASSIVE, LIE, STAND, READY, HYBRID, DAMPING = Phase
THIGH, CALF = 7, 8  # joints of the left hind leg, which carries in the foot stand
REAR_LEFT = 2  # its foot


class Outcome(Enum):
    """What has to come of a fault."""

    DAMPS = auto()  # within 100 ms
    GOES_ON = auto()  # in its phase, and is upright
    EITHER = auto()  # goes on within its envelope, or damps within 100 ms of leaving it
    FALLS = auto()  # the latter
    LIES = auto()  # as SELECT wants it


DAMPS, GOES_ON, EITHER, FALLS, LIES = Outcome


@dataclass(frozen=True)
class Fault:
    """A fault.

    Attributes:
        strike: makes it.
        outcome: in every phase in which motors are commanded; a robot that is passive or damped stays so.
        but: in these phases another one.
        starts: whether a passive robot may be started with it.
    """

    strike: Callable[[Rig], object]
    outcome: Outcome
    but: dict[Phase, Outcome] = field(default_factory=dict)
    starts: bool = True


def put(it: object, **methods: Callable[..., object]) -> None:
    """Put other methods in the place of an object's."""
    vars(it).update(methods)


def states(**faults: float) -> Callable[[Rig], None]:
    """Faults of the state frames."""

    def strike(rig: Rig) -> None:
        rig.robot.states.faults = Faults(**faults)

    return strike


def commands(loss: Loss = "hold", **faults: float) -> Callable[[Rig], None]:
    """Faults of the command frames, and what the motors do when commands stop."""

    def strike(rig: Rig) -> None:
        rig.robot.commands.faults, rig.robot.loss = Faults(**faults), loss

    return strike


def held_up(seconds: float) -> Callable[[Rig], None]:
    """State frames come so much later than before [s], in their order."""

    def strike(rig: Rig) -> None:
        rig.robot.states._delay = round(seconds / PERIOD)

    return strike


def tells(**fields: object) -> Callable[[Rig], None]:
    """The robot tells these instead of what it measures, under a good checksum."""

    def strike(rig: Rig) -> None:
        rig.change = lambda frame: encode_state(decode_state(frame)._replace(**fields))

    return strike


def restarts(rig: Rig) -> None:
    """The robot's clock begins at 0 again."""
    first = rig.robot.truth().tick

    def change(frame: bytes) -> bytes:
        state = decode_state(frame)
        return encode_state(state._replace(tick=state.tick - first))

    rig.change = change


def biased(gyro: float = 0.0, acc: float = 0.0) -> Callable[[Rig], None]:
    """Biases of the IMU jump by so much [rad/s, m/s^2], each axis."""

    def strike(rig: Rig) -> None:
        imu = rig.robot._imu
        imu.gyro_bias, imu.acc_bias = imu.gyro_bias + gyro, imu.acc_bias + acc

    return strike


def freezes(rig: Rig) -> None:
    """The IMU tells the same for ever."""
    last = rig.robot._imu._last
    put(rig.robot._imu, read=lambda *_: last)


def slips(joint: int, angle: float) -> Callable[[Rig], None]:
    """An encoder jumps by so much [rad]."""

    def strike(rig: Rig) -> None:
        zeros = rig.robot._encoders._zeros.copy()
        zeros[joint] += angle
        rig.robot._encoders._zeros = zeros

    return strike


def loses(*joints: str) -> Callable[[Rig], None]:
    """These motors give no torque any more."""
    return lambda rig: rig.robot.motors.weaken(dict.fromkeys(joints, 0.0))


def heats(rig: Rig) -> None:
    """A motor is hot."""
    rig.robot.motors.temperature[CALF] = 95.0


def unsure(rig: Rig) -> None:
    """The velocity's variance is (10 m/s)^2 more from now on."""
    update = rig.control.estimator.update

    def updated(*readings: np.ndarray) -> Estimate | None:
        found = update(*readings)
        if found is not None:
            found.P[V, V] += 100.0 * np.eye(3)
        return found

    put(rig.control.estimator, update=updated)


def lost(rig: Rig) -> None:
    """The estimator begins anew again and again."""
    rig.before = rig.control.estimator.reset


def confused(rig: Rig) -> None:
    """The velocity is no number."""

    def confuse() -> None:
        rig.control.estimator.ekf.v = np.full(3, np.nan)

    rig.before = confuse


def wants(target: float) -> Callable[[Rig], None]:
    """Policies and slow motions want all joints at this angle [rad]."""

    class Policy:
        def act(self, *_: object) -> np.ndarray:
            return np.full((1, 12), target)

    def strike(rig: Rig) -> None:
        rig.control.performer._policies = dict.fromkeys((FOOT, HAND), Policy())
        put(rig.control, _ramped=lambda: np.full(12, target))

    return strike


def ends(rig: Rig) -> None:
    """The control process ends."""
    rig.turning, rig.gone = False, True


def hangs(rig: Rig) -> None:
    """The control process hangs for 0.3 s."""
    until = rig.now + 0.3

    def wake() -> None:
        rig.turning = rig.now >= until

    rig.before = wake


def pauses(rig: Rig) -> None:
    """Everything but the robot stands still for 40 ms."""
    until = rig.now + 0.04

    def wake() -> None:
        rig.turning = rig.watching = rig.planning = rig.now >= until

    rig.before = wake


def blind(rig: Rig) -> None:
    """No state frame comes any more, and the control process gets a core once in 20 ms only."""
    rig.robot.states.faults = Faults(drop=1.0)

    def share() -> None:
        rig.turning = round(rig.now / PERIOD) % 10 == 0

    rig.before = share


def stops(*names: str) -> Callable[[Rig], None]:
    """These do not run any more."""

    def strike(rig: Rig) -> None:
        for name in names:
            setattr(rig, name, False)

    return strike


def plans(late: int = 0, **fields: object) -> Callable[[Rig], None]:
    """All plans are such as this from now on."""

    def strike(rig: Rig) -> None:
        plan = rig.plan
        put(rig, plan=lambda: plan(late, **fields))

    return strike


def presses(*buttons: Button) -> Callable[[Rig], None]:
    """The operator presses these."""
    return lambda rig: rig.press(*buttons)


BLIND = {LIE: GOES_ON, STAND: GOES_ON}  # nothing rests on the estimate yet
FLIP = np.array([FOOT] * 5 + [JUMP] * 20 + [HAND] * 103, np.int8)
FAULTS = {
    # state frames
    "no states": Fault(states(drop=1.0), DAMPS, starts=False),
    "no states, slow turns": Fault(blind, DAMPS, starts=False),
    "30 % of the states lost": Fault(states(drop=0.3), GOES_ON),
    "states twice": Fault(states(duplicate=1.0), GOES_ON),
    "30 % of the states 10 ms late": Fault(states(late=0.3, stall=0.01), GOES_ON),
    "half of the states out of order": Fault(states(late=0.5, stall=0.004), GOES_ON),
    "states 20 ms old": Fault(held_up(0.02), EITHER),
    "states 0.5 s old": Fault(held_up(0.5), DAMPS, starts=False),
    "states corrupt": Fault(states(corrupt=1.0), DAMPS, starts=False),
    "30 % of the states corrupt": Fault(states(corrupt=0.3), GOES_ON),
    "rates not numbers": Fault(tells(gyro=np.full(3, np.nan)), DAMPS, starts=False),
    "a number of every state is none": Fault(states(nan=1.0), DAMPS, starts=False),
    "30 % of the states not numbers": Fault(states(nan=0.3), GOES_ON),
    "the clock stands": Fault(tells(tick=10_000), DAMPS, starts=False),
    "the clock restarts": Fault(restarts, DAMPS, starts=False),
    # sensors
    "a foot tells 0": Fault(lambda rig: rig.robot.feet.stuck.update({REAR_LEFT: 0}), GOES_ON),
    "a foot tells 200": Fault(lambda rig: rig.robot.feet.stuck.update({REAR_LEFT: 200}), GOES_ON),
    "gyroscope off by 0.05 rad/s": Fault(biased(gyro=0.05), GOES_ON),
    "gyroscope off by 1 rad/s": Fault(biased(gyro=1.0), EITHER),
    "accelerometer off by 0.5 m/s^2": Fault(biased(acc=0.5), GOES_ON),
    "accelerometer off by 10 m/s^2": Fault(biased(acc=10.0), EITHER),
    "the IMU freezes": Fault(freezes, DAMPS, starts=False),
    "an encoder jumps by 0.05 rad": Fault(slips(CALF, 0.05), GOES_ON),
    "an encoder jumps by 0.5 rad": Fault(slips(CALF, 0.5), EITHER),
    "an encoder jumps by 6 rad": Fault(slips(THIGH, 6.0), DAMPS, starts=False),
    # body
    "a motor lost": Fault(loses("RL_calf"), EITHER, {HYBRID: FALLS}),
    "a leg lost": Fault(loses("RL_*"), EITHER, {HYBRID: FALLS}),
    "a push": Fault(lambda rig: rig.robot.push((0.0, 50.0, 0.0), 0.1), GOES_ON),
    "a strong push": Fault(lambda rig: rig.robot.push((0.0, 500.0, 0.0), 0.1), EITHER, {HYBRID: FALLS}),
    "a motor hot": Fault(heats, DAMPS, starts=False),
    # command frames
    "no commands, hold": Fault(commands("hold", drop=1.0), EITHER),
    "no commands, damp": Fault(commands("damp", drop=1.0), EITHER, {HYBRID: FALLS}),
    "no commands, limp": Fault(commands("limp", drop=1.0), EITHER, {HYBRID: FALLS}),
    "30 % of the commands lost": Fault(commands("limp", drop=0.3), GOES_ON),
    "commands corrupt": Fault(commands("limp", corrupt=1.0), EITHER, {HYBRID: FALLS}),
    "30 % of the commands corrupt": Fault(commands("limp", corrupt=0.3), GOES_ON),
    "commands 20 ms late": Fault(commands(late=1.0, stall=0.02), EITHER),
    # control process
    "the estimate unsure": Fault(unsure, DAMPS, BLIND),
    "the estimate lost": Fault(lost, DAMPS, BLIND),
    "the estimate no number": Fault(confused, DAMPS, {LIE: GOES_ON, STAND: EITHER}),  # damps once it stands
    "targets not numbers": Fault(wants(np.nan), DAMPS),
    "targets beyond all limits": Fault(wants(1e3), EITHER, {HYBRID: FALLS}),
    "the control process ends": Fault(ends, DAMPS),
    "the control process hangs": Fault(hangs, DAMPS),
    "a pause": Fault(pauses, GOES_ON),
    # the others
    "another program commands": Fault(lambda rig: rig.wire.others.append("another"), DAMPS, starts=False),
    "no watchdog": Fault(stops("watching"), DAMPS, starts=False),
    "no planner": Fault(stops("planning"), GOES_ON),
    "plans too late": Fault(plans(late=50, modes=FLIP, steps=STEPS), GOES_ON),
    "plans not numbers": Fault(plans(u=np.nan), GOES_ON),
    "plans of no mode": Fault(plans(modes=7), GOES_ON),
    "L2 and B": Fault(presses(Button.L2, Button.B), DAMPS, {PASSIVE: DAMPS}),
    "SELECT": Fault(presses(Button.SELECT), DAMPS, {STAND: LIES, READY: LIES}),
}
