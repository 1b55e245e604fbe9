"""The controller and the stand-in in lock step: deterministic, without processes, wires or clocks."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from deploy.codec import VELOCITY_STOP, RobotState, decode_command, decode_state, encode_state
from deploy.control import TICK, Control, uncertainty
from deploy.ekf import N, V
from deploy.estimate import Estimate
from deploy.loop import policies
from deploy.remote import ABSENT, Button, Remote, pack
from deploy.safety import PEAK_TORQUE, Phase
from deploy.settings import DeployCfg
from hmc.cfg import load
from hmc.go2.network import LOWER, UPPER
from hmc.go2.stances import FOOTSTAND
from tools.robot.faults import Faults, Way
from tools.robot.standin import Settings, StandIn

CFG = load(Path("cfg/deploy.toml"), DeployCfg, ("lie.seconds=0.4", "stand.seconds=0.8"))
PRESSES = (0.3, 1.0, 2.5)  # s: lie, stand, hybrid


class Rig:
    """A robot, a controller, and what passes between them."""

    def __init__(self, seed: int = 0):
        self.robot = StandIn(Settings(seed=seed, start="lying"))
        self.robot.release(True)
        self.control = Control(CFG, policies("", ""))
        self.control.planner = True
        self.sent: list[bytes] = []
        self.held: list[bool] = []
        self.phases: list[Phase] = []

    def run(self, until: float, presses: tuple[float, ...] = PRESSES) -> Rig:
        """Go on until the robot's time [s], pressing START at these."""
        while self.robot.time < until - 1e-9:
            pressed = any(at <= self.robot.time < at + 0.1 for at in presses)
            if presses:
                self.robot.remote = Remote(Button.START if pressed else Button(0))
            self.step()
        return self

    def step(self) -> None:
        """2 ms."""
        frames = self.robot.step(self.sent)
        for frame in frames:
            self.control.hear(frame, self.robot.time)
        if not frames:
            self.control.idle(self.robot.time)
        command = self.control.command
        self.sent = [] if command is None else [command]
        if command is not None:
            check(command)
        self.phases.append(self.control.phase)
        truth = self.robot.truth()
        x = torch.from_numpy(np.concatenate([truth.qpos, truth.qvel]))[None]
        self.held.append(bool(FOOTSTAND.held(x)))


def check(command: bytes) -> None:
    """Whatever is commanded is within the limits."""
    motors = decode_command(command).motors
    assert decode_command(command).crc_ok
    for numbers in motors[:5]:
        assert np.isfinite(numbers).all()
    if motors.kp.any():
        assert (motors.q >= LOWER - 1e-6).all()
        assert (motors.q <= UPPER + 1e-6).all()
    assert motors.kp.max() <= 60.0
    assert motors.kd.max() <= 5.0
    assert np.abs(motors.dq).max() < VELOCITY_STOP
    assert not motors.tau.any()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.deploy)])
def test_from_lying_to_the_foot_stand_with_the_estimate_alone(seed):
    rig = Rig(seed).run(5.0)
    order = list(dict.fromkeys(rig.phases))
    assert order == [Phase.PASSIVE, Phase.LIE, Phase.STAND, Phase.READY, Phase.HYBRID], (
        rig.control.machine.reason
    )
    assert all(rig.held[-750:]), "1.5 s of the foot stand"
    assert rig.control.missed == 0
    assert rig.control.k == 249  # every 20 ms of the robot's time
    estimate, truth = rig.control.estimate, rig.robot.truth()
    assert estimate is not None
    assert estimate.x[2] == pytest.approx(truth.qpos[2], abs=0.03)
    assert np.linalg.norm(estimate.velocity - truth.qvel[:3]) < 0.1


def test_nothing_is_commanded_before_start():
    rig = Rig().run(1.0, ())
    assert rig.control.command is None
    assert rig.robot.truth().accepted == 0


def test_it_is_the_same_again():
    one, two = Rig(3).run(0.8), Rig(3).run(0.8)
    assert one.sent == two.sent
    assert one.robot.truth().qpos.tolist() == two.robot.truth().qpos.tolist()


REACHED = {Phase.PASSIVE: 0.05, Phase.LIE: 0.5, Phase.STAND: 1.4, Phase.READY: 2.3, Phase.HYBRID: 3.0}
Change = Callable[[RobotState], RobotState]
FAULTS: dict[str, Faults | Remote | str | Change] = {
    "drop": Faults(drop=1.0),
    "corrupt": Faults(corrupt=1.0),
    "nan": Faults(nan=1.0),
    "late": Faults(late=1.0, stall=0.5),
    "repeated": lambda state: state._replace(tick=7),
    "restarted": lambda state: state._replace(tick=state.tick % 256),
    "out of range": lambda state: state._replace(q=UPPER + 0.5),
    "too fast": lambda state: state._replace(dq=np.full(12, 50.0)),
    "too strong": lambda state: state._replace(tau=1.8 * PEAK_TORQUE),
    "hot": lambda state: state._replace(temperature=np.full(12, 95)),
    "emergency": Remote(Button.L2 | Button.B),
    "select": Remote(Button.SELECT),
    "watchdog": "the watchdog does not live any more",
}
Met = dict[Phase, tuple[Control, list[bytes]]]


@pytest.fixture(scope="module")
def met() -> Met:
    """For each phase a controller in it, and the states that came next."""
    rig, found = Rig(), {}
    for phase, until in REACHED.items():
        rig.run(until)
        assert rig.control.phase == phase
        kept, frames = duplicate(rig.control), []
        for _ in range(100):
            frames += rig.robot.step(rig.sent)
            rig.control.hear(frames[-1], rig.robot.time)
            rig.sent = [] if rig.control.command is None else [rig.control.command]
        found[phase] = kept, frames
    damped = duplicate(kept)
    damped.fail("a test")
    return {**found, Phase.DAMPING: (damped, frames)}


def duplicate(control: Control) -> Control:
    """A controller in the same state; the networks are shared."""
    return copy.deepcopy(control, {id(it): it for it in control.performer._policies.values()})


@pytest.mark.matrix
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("phase", Phase, ids=lambda phase: phase.name.lower())
def test_every_fault_in_every_phase_is_safe_within_100_ms(met: Met, phase: Phase, fault: str):
    """It damps; but SELECT on four feet lies the robot down, and a robot that is passive is left alone."""
    control, frames = duplicate(met[phase][0]), met[phase][1]
    kind = FAULTS[fault]
    way = Way(kind if isinstance(kind, Faults) else Faults(), 0, 0.002, np.random.default_rng(0))
    if isinstance(kind, str):
        control.fail(kind)
    lies = fault == "select" and phase in (Phase.STAND, Phase.READY)
    wanted = Phase.LIE if lies else Phase.DAMPING
    safe, now = None, control.checks.heard
    for i, frame in enumerate(frames):
        now += 0.002
        if isinstance(kind, Remote):
            frame = encode_state(decode_state(frame)._replace(remote=pack(kind)))
        elif not isinstance(kind, str | Faults):
            frame = encode_state(kind(decode_state(frame)))
        arrived = way.send([frame])
        for each in arrived:
            control.hear(each, now)
        if not arrived:
            control.idle(now)
        if control.command is not None:
            check(control.command)
        if phase == Phase.PASSIVE:
            assert control.command is None or control.phase == Phase.DAMPING
        elif control.phase == wanted:
            safe = i if safe is None else safe
        else:
            assert safe is None, "it stays safe"
    if phase != Phase.PASSIVE:
        assert safe is not None
        assert safe < 50, f"{2 * safe} ms"
    if control.phase == Phase.DAMPING:
        assert control.command is not None
        motors = decode_command(control.command).motors
        assert not motors.kp.any()
        assert (motors.kd == 5.0).all()


def test_a_command_does_not_wait_for_the_estimator(met: Met):
    """It is for the state by the IMU alone; with what the feet say it is hardly another one."""
    control, frames = duplicate(met[Phase.HYBRID][0]), met[Phase.HYBRID][1]
    patient = duplicate(control)
    now, ticks = control.checks.heard, 0
    for frame in frames:
        now += 0.002
        before = control.estimate
        with mock.patch.object(patient.estimator, "ahead", return_value=None):
            assert control.react(frame, now) == patient.hear(frame, now)
        assert control.estimate is before, "that comes later"
        assert control.k == patient.k
        ticks += control.k * TICK == control.checks.ms - control._first
        np.testing.assert_allclose(control.target, patient.target, atol=0.02)
        control.settle()
        estimate = control.estimate
        assert estimate is not None
        assert estimate.t == 0.001 * control.checks.ms
        control.settle()
        assert control.estimate is estimate, "once a state"
    assert ticks == 10


def test_single_bad_frames_disturb_nothing():
    rig = Rig()
    rig.robot.states.faults = Faults(drop=0.02, duplicate=0.02, corrupt=0.02, nan=0.02, late=0.01)
    rig.run(2.5)
    rig.run(3.6, (2.5, 2.52, 2.54, 2.56, 2.58, 2.6, 2.62, 2.64))  # START held: one press
    assert rig.control.phase == Phase.HYBRID, rig.control.machine.reason
    assert rig.control.asked < 0
    assert all(rig.held[-100:])
    counts = rig.control.checks.counts
    assert min(counts[name] for name in ("checksum", "not a number", "repeated", "out of order", "gap")) > 0


def test_a_button_held_while_the_remote_is_gone_is_one_press(met: Met):
    """START goes on to the foot stand; a moment without the remote would ask for the handstand as well."""
    control, frames = duplicate(met[Phase.READY][0]), met[Phase.READY][1]
    now, held = control.checks.heard, pack(Remote(Button.START))
    for i, frame in enumerate(frames[:60]):
        now += 0.002
        remote = ABSENT if 20 <= i < 24 else held
        control.hear(encode_state(decode_state(frame)._replace(remote=remote)), now)
    assert control.phase == Phase.HYBRID, control.machine.reason
    assert not control.machine.asked


def test_an_unknown_heading_is_no_unknown_velocity():
    """After half an hour on two legs nobody knows the heading: a jump at 1.5 m/s was damped for it."""
    x, P = np.zeros(37), 1e-4 * np.eye(N)
    x[3], x[19:22] = 1.0, (1.5, 0.2, 0.3)
    turned = np.zeros(N)
    turned[2], turned[V] = 2.0, np.cross([0.0, 0.0, 2.0], x[19:22])  # by 2 rad, and the velocity with it
    none, nobody = np.zeros(3), np.zeros(4, dtype=bool)

    def speed(P: np.ndarray) -> float:
        return uncertainty(Estimate(0.0, x, np.eye(3), none, none, nobody, nobody, P, 0.0))[0]

    known = P + np.outer(turned, turned)
    assert np.sqrt(known[V, V].diagonal().max()) > 2.9
    assert speed(known) == pytest.approx(speed(P), rel=1e-6)
    assert 0.01 <= speed(P) < 0.02
    P[V, V] += np.eye(3)
    assert speed(P + np.outer(turned, turned)) == pytest.approx(1.0, abs=1e-3)
