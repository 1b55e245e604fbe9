"""The state machine in every phase under every input, the envelopes, and the limits of commands."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.checks import StateChecks
from deploy.codec import encode_state, seal
from deploy.remote import ABSENT, Button
from deploy.safety import EMERGENCY, Body, Envelope, Inputs, Machine, Phase, limited, violations
from deploy.settings import DeployCfg, EnvelopeCfg, InputCfg
from deploy.timing import Silence
from hmc.cfg import load
from hmc.go2 import facts
from hmc.go2.network import LOWER, UPPER
from tests.wire import state

NOTHING = Button(0)
MOVING = (Phase.LIE, Phase.STAND, Phase.READY, Phase.HYBRID)


def machine(phase: Phase) -> Machine:
    """A machine in a phase, no button pressed before."""
    it = Machine()
    it.step(Inputs())
    it.phase = phase
    return it


def after(phase: Phase, inputs: Inputs) -> Phase:
    return machine(phase).step(inputs)


# Everything that an input can be: 2^3 flags, a fault or none, and buttons.
FLAGS = [
    dict(zip(("posed", "settled", "planner"), f, strict=True)) for f in itertools.product((0, 1), repeat=3)
]
BUTTONS = [NOTHING, Button.START, Button.SELECT, Button.L2, Button.B, EMERGENCY, Button.START | Button.SELECT]
ALLOWED = {
    Phase.PASSIVE: {Phase.PASSIVE, Phase.LIE, Phase.DAMPING},
    Phase.LIE: {Phase.LIE, Phase.STAND, Phase.DAMPING},
    Phase.STAND: {Phase.STAND, Phase.READY, Phase.LIE, Phase.DAMPING},
    Phase.READY: {Phase.READY, Phase.HYBRID, Phase.LIE, Phase.DAMPING},
    Phase.HYBRID: {Phase.HYBRID, Phase.DAMPING},
    Phase.DAMPING: {Phase.DAMPING},
}


@pytest.mark.parametrize("phase", Phase)
def test_every_input_leads_only_where_it_may(phase):
    for flags, buttons, fault in itertools.product(FLAGS, BUTTONS, ("", "something")):
        found = after(phase, Inputs(buttons, fault, **flags))
        assert found in ALLOWED[phase]
        if buttons & EMERGENCY == EMERGENCY:
            assert found == Phase.DAMPING
        if fault and buttons & EMERGENCY != EMERGENCY:
            assert found == (Phase.PASSIVE if phase == Phase.PASSIVE else Phase.DAMPING)


@pytest.mark.parametrize("phase", Phase)
def test_nothing_moves_without_a_press(phase):
    for flags in FLAGS:
        found = after(phase, Inputs(NOTHING, **flags))
        risen = phase == Phase.STAND and flags["posed"] and flags["settled"]
        assert found == (Phase.READY if risen else phase)


def test_start_goes_all_the_way_and_asks_for_the_handstand_at_its_end():
    it, known = machine(Phase.PASSIVE), {"posed": True, "settled": True, "planner": True}
    seen = []
    for _ in range(6):
        seen.append(it.step(Inputs(Button.START, **known)))
        it.step(Inputs(**known))
    assert [phase.name for phase in dict.fromkeys(seen)] == ["LIE", "STAND", "HYBRID"]
    assert it.asked


def test_a_button_held_down_is_one_press_and_none_at_the_start():
    it = Machine()
    held = Inputs(Button.START, posed=True)
    assert [it.step(held) for _ in range(3)] == [Phase.PASSIVE] * 3  # held since before the program began
    it.step(Inputs())
    assert [it.step(held) for _ in range(3)] == [Phase.LIE] * 3


def test_what_is_held_while_nothing_is_known_is_not_pressed_again():
    it = Machine()
    held, unknown, known = Inputs(Button.START, posed=True), Inputs(None), {"posed": True, "planner": True}
    assert [it.step(i) for i in (unknown, held, unknown, held)] == [
        Phase.PASSIVE
    ] * 4  # since before it began
    it.step(Inputs())
    assert [it.step(i) for i in (held, unknown, held)] == [Phase.LIE] * 3
    it = machine(Phase.READY)
    for buttons in (Button.START, None, Button.START, None, Button.START):
        it.step(Inputs(buttons, **known))
    assert it.phase == Phase.HYBRID
    assert not it.asked
    it = machine(Phase.HYBRID)  # nor is an emergency made up of what was pressed before
    it.step(Inputs(Button.L2))
    assert it.step(Inputs(None)) == Phase.HYBRID


@pytest.mark.parametrize(
    ("phase", "hint"),
    [(Phase.LIE, "does not lie"), (Phase.STAND, "not ready"), (Phase.READY, "planner has not started")],
)
def test_a_press_that_does_nothing_says_why(phase, hint):
    it = machine(Phase.READY)
    assert it.step(Inputs(Button.START, planner=True)) == Phase.READY
    assert "a joint is not where it should be" in it.hint
    it = machine(phase)
    assert it.step(Inputs(Button.START)) == phase
    assert hint in it.hint


def test_damping_keeps_its_first_reason_and_never_ends():
    it = machine(Phase.HYBRID)
    it.step(Inputs(fault="the first"))
    for flags, buttons in itertools.product(FLAGS, BUTTONS):
        assert it.step(Inputs(buttons, "another", **flags)) == Phase.DAMPING
        it.step(Inputs())
    assert it.reason == "the first"


def test_select_lies_down_on_four_feet_and_damps_elsewhere():
    found = {phase: after(phase, Inputs(Button.SELECT)) for phase in Phase}
    assert found[Phase.STAND] == found[Phase.READY] == Phase.LIE
    assert found[Phase.LIE] == found[Phase.HYBRID] == found[Phase.DAMPING] == Phase.DAMPING
    assert found[Phase.PASSIVE] == Phase.PASSIVE


UPRIGHT = Body(np.array([0.0, 0.0, 1.0]), 0.29, np.array(facts.HOME), np.zeros(12), np.zeros(12))
NOSE_UP = replace(UPRIGHT, up=np.array([1.0, 0.0, 0.0]), height=0.57)
NOSE_DOWN = replace(UPRIGHT, up=np.array([-1.0, 0.0, 0.0]), height=0.57)


def test_each_stance_is_within_its_own_envelope_and_no_other():
    envelope = load(Path("cfg/deploy.toml"), DeployCfg).envelope
    own = {"stand": UPRIGHT, "ready": UPRIGHT, "foot": NOSE_UP, "hand": NOSE_DOWN}
    for (name, body), (other, wrong) in itertools.product(own.items(), own.items()):
        found = violations(getattr(envelope, name), wrong, since=10.0)
        assert bool(found) == (wrong is not body), (name, other, found)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (replace(UPRIGHT, up=np.array([0.0, 1.0, 0.0])), "lean is 90 deg"),
        (replace(UPRIGHT, q=np.array(facts.HOME) + 2.0 * (np.arange(12) == 5)), "FR_calf is 0.2 rad, -2.83"),
        (replace(UPRIGHT, q=np.where(np.arange(12) == 7, np.nan, facts.HOME)), "RL_thigh is nan rad"),
        (replace(UPRIGHT, dq=np.full(12, -50.0)), "joint speed is 50 rad/s"),
        (replace(UPRIGHT, tau=np.full(12, 60.0)), "joint torque is 2.97"),
        (replace(UPRIGHT, velocity_std=3.0), "velocity uncertainty is 3 m/s"),
        (replace(UPRIGHT, tilt_std=math.radians(20)), "tilt uncertainty is 20 deg"),
        (replace(UPRIGHT, height=3.0), "height is 3 m"),
        (replace(UPRIGHT, dq=np.full(12, np.nan)), "joint speed is nan"),
        (replace(UPRIGHT, tilt_std=math.nan), "tilt uncertainty is nan"),
    ],
)
def test_what_is_exceeded_is_named(body, told):
    assert violations(EnvelopeCfg(), UPRIGHT, 10.0) == []
    (found,) = violations(EnvelopeCfg(), body, 10.0)
    assert found.startswith(told)


def test_an_envelope_has_patience_and_forgets():
    cfg, envelope = EnvelopeCfg(lean=10.0, patience=0.03), Envelope()
    tilted = replace(UPRIGHT, up=np.array([0.0, 0.5, math.sqrt(0.75)]))
    assert envelope.check(cfg, "ready", tilted, 1.0, 5.00) == ""
    assert envelope.check(cfg, "ready", tilted, 1.0, 5.02) == ""
    assert envelope.check(cfg, "ready", UPRIGHT, 1.0, 5.021) == ""
    assert envelope.check(cfg, "ready", tilted, 1.0, 5.04) == ""
    assert envelope.check(cfg, "ready", tilted, 1.0, 5.08) == "in ready: lean is 30 deg, at most 10 allowed"


def test_each_mode_has_joint_ranges_of_its_own():
    """A leg that is where this mode never has it is outside, though the motors can go there."""
    cfg = load(Path("cfg/deploy.toml"), DeployCfg)
    for name, body in (("ready", UPRIGHT), ("foot", NOSE_UP), ("hand", NOSE_DOWN)):
        envelope = getattr(cfg.envelope, name)
        assert violations(envelope, body, 10.0) == []
        for joint in range(12):
            low, high = envelope.joint_low[joint % 3], envelope.joint_high[joint % 3]
            for angle, wrong in ((low, False), (low - 0.01, True), (high, False), (high + 0.01, True)):
                q = np.array(facts.HOME)
                q[joint] = angle
                found = violations(envelope, replace(body, q=q), 10.0)
                assert [text.split()[0] for text in found] == [facts.JOINTS[joint]] * wrong
    assert violations(cfg.envelope.ready, replace(UPRIGHT, q=np.array(facts.HOME) + [0.6, 0, 0] * 4), 10.0)


@given(st.lists(st.floats(-1e9, 1e9), min_size=12, max_size=12), st.integers(0, 99))
def test_no_target_leaves_the_limits(wanted, seed):
    last = np.random.default_rng(seed).uniform(LOWER, UPPER)
    target = limited(np.array(wanted), last, 0.5)
    assert (target >= LOWER).all()
    assert (target <= UPPER).all()
    assert np.abs(target - last).max() <= 0.5 + 1e-12


def test_a_target_that_is_no_number_is_named():
    wanted = np.array(facts.HOME)
    wanted[4] = np.nan
    with pytest.raises(ValueError, match="FR_thigh is nan"):
        limited(wanted, np.array(facts.HOME), 0.5)


def good(tick: int) -> bytes:
    """A frame that is believed."""
    told = state()._replace(tick=tick, q=np.array(facts.HOME), temperature=np.full(12, 30))
    noise = np.array([0.001 * (tick % 97), 0.0, 0.0])
    return encode_state(told._replace(quat=np.array([1.0, 0.0, 0.0, 0.0]), gyro=noise))


def changed(tick: int, **fields: object) -> bytes:
    from deploy.codec import decode_state

    return encode_state(decode_state(good(tick))._replace(**fields))


BAD = {
    "checksum": lambda tick: good(tick)[:500] + bytes([good(tick)[500] ^ 4]) + good(tick)[501:],
    "no LowState frame": lambda tick: good(tick)[:-1],
    "not a number": lambda tick: changed(tick, acc=np.array([0.0, np.nan, 0.0])),
    "range of the attitude": lambda tick: changed(tick, quat=np.zeros(4)),
    "range of the angles": lambda tick: changed(tick, rpy=np.array([7.0, 0.0, 0.0])),
    "range of the gyroscope": lambda tick: changed(tick, gyro=np.array([0.0, -40.0, 0.0])),
    "range of the accelerometer": lambda tick: changed(tick, acc=np.array([200.0, 0.0, 0.0])),
    "range of the joints": lambda tick: changed(tick, q=np.array(facts.Q_UPPER) + 0.5),
    "range of the joint speeds": lambda tick: changed(tick, dq=np.full(12, 100.0)),
    "range of the torques": lambda tick: changed(tick, tau=np.full(12, -100.0)),
    "repeated": lambda tick: good(tick - 2),
    "out of order": lambda tick: good(tick - 8),
}


@pytest.mark.parametrize("reason", BAD)
def test_a_bad_frame_is_dropped_counted_and_many_are_a_fault(reason):
    checks = StateChecks(InputCfg(max_age=0.06))
    assert checks.fault(0.0) == "no good state frame yet"
    assert checks.take(good(100), 1.0) is not None
    assert checks.take(BAD[reason](102), 1.002) is None
    assert checks.counts[reason] == 1
    assert [checks.fault(1.002 + 0.002 * k) for k in range(25)] == [""] * 25
    last = [checks.fault(1.052 + 0.002 * k) for k in range(10)][-1]
    assert last == f"no good state frame for 70 ms (the last one refused: {reason})"
    assert checks.take(good(110), 1.1) is not None
    assert checks.counts["gap"] == 4
    assert checks.fault(1.1) == ""


def test_a_pause_of_the_whole_machine_is_no_fault():
    """Frames of the robot come after it, before one counts as silent; but not after any time."""
    checks = StateChecks(InputCfg(max_age=0.06, stall=0.2))
    assert checks.take(good(100), 1.0) is not None
    assert checks.fault(1.005) == ""
    assert [checks.fault(1.12 + 0.005 * k) for k in range(8)] == [""] * 8
    assert checks.take(good(102), 1.16) is not None
    assert checks.fault(1.30) == ""
    assert [checks.fault(1.30 + 0.005 * k) for k in range(12)][-1] != "", "and nothing came"
    assert checks.take(good(104), 2.0) is not None
    assert checks.fault(2.21) == "no good state frame for 210 ms"


def test_the_robots_clock_overflows_and_restarts():
    checks = StateChecks(InputCfg())
    for tick in (2**32 - 4, 2**32 - 2, 0, 2):
        assert checks.take(good(tick), 1.0) is not None
    assert checks.ms == 2**32 + 2
    assert checks.counts["gap"] == 0
    long = StateChecks(InputCfg())
    long.take(good(500_000), 1.0)
    assert long.take(good(2), 1.0) is None
    assert "it restarted" in long.fault(1.0)


def test_frames_that_never_came_are_counted():
    """A robot's clock may round to steps of 1 and 3 ms."""
    for ticks, gap in (((2, 3, 6, 7, 10), 0), ((2, 3, 5), 0), ((2, 6), 1), ((2, 4, 10), 2)):
        checks = StateChecks(InputCfg())
        for tick in ticks:
            assert checks.take(good(tick), 1.0) is not None
        assert checks.counts["gap"] == gap


def test_a_remote_that_is_gone_is_a_fault_until_it_is_back():
    """By the robot's clock; a robot that has never had one near gets as long."""
    far = {"remote": ABSENT}
    for first in ({}, far):
        checks = StateChecks(InputCfg(remote=3.0))
        assert checks.take(changed(100, **first), 1.0) is not None
        for tick in range(200, 3101, 100):
            assert checks.take(changed(tick, **far), 1.0) is not None
            assert checks.fault(1.0) == ""
        assert checks.take(changed(3102, **far), 1.0) is not None
        assert checks.fault(1.0).startswith("no remote for 3.0 s")
        assert checks.take(good(3104), 1.0) is not None
        assert checks.fault(1.0) == ""


def test_an_imu_that_tells_the_same_is_a_fault():
    """Exactly the same: a robot that lies still has noise."""
    checks = StateChecks(InputCfg(frozen=0.04))
    same = {"gyro": np.full(3, 0.01), "acc": np.array([0.0, 0.0, 9.8])}
    for tick in range(100, 142, 2):
        assert checks.take(changed(tick, **same), 1.0) is not None
        assert checks.fault(1.0) == ""
    assert checks.take(changed(142, **{**same, "acc": np.array([0.0, 0.0, 9.81])}), 1.0) is not None
    for tick in range(144, 186, 2):
        assert checks.take(changed(tick, **same), 1.0) is not None
        assert checks.fault(1.0) == ""
    checks.take(changed(186, **same), 1.0)
    assert checks.fault(1.0).startswith("the IMU has told the same for 42 ms")


def test_a_hot_motor_is_a_fault():
    checks = StateChecks(InputCfg(temperature=80.0))
    assert checks.take(changed(2, temperature=np.array([30] * 11 + [81])), 1.0) is not None
    assert checks.fault(1.0).startswith("a motor has 81 deg C")


def test_random_octets_never_pass():
    rng, checks = np.random.default_rng(0), StateChecks(InputCfg())
    checks.take(good(100), 0.0)
    for _ in range(2000):
        frame = bytearray(good(102))
        for at in rng.integers(4, len(frame), rng.integers(1, 9)):
            frame[at] ^= int(rng.integers(1, 256))
        found = checks.take(bytes(frame), 0.0)
        # two octets behind a motor's mode are padding: nobody reads them
        assert found is None or encode_state(found) == good(102)
    nan = bytearray(good(102))
    nan[40:44] = np.float32(np.nan).tobytes()
    assert checks.take(seal(nan), 0.0) is None  # under a good checksum


@pytest.mark.parametrize(
    ("looks", "found"),
    [
        (np.arange(1, 100) * 0.002 + 0.001, 0.061),  # all of the time is looked at
        ([0.15, 0.16, 0.17, 0.18, 0.19, 0.199, 0.201], 0.201),  # 10 ms of the pause count
        (np.arange(1, 10) * 0.02, 0.08),  # ms that count: 10, 20, 20, 20
        (np.arange(1, 10) * 0.045, 0.135),  # 10, 20, 40
        ([0.05, 0.052, 0.102, 0.104, 0.106], None),  # 10, 2, 20, 2, 2
    ],
    ids=["busy", "one pause", "slow turns", "pauses", "two pauses"],
)
def test_silence(looks: np.ndarray, found: float | None) -> None:
    """A pause of the machine is no silence; that nothing is ever heard between pauses is one."""
    silence = Silence(0.06, 0.2, 0.01)
    for heard in (1.0, 2.0):  # what was counted before it was heard again does not matter
        silence.hear(heard)
        silence.too_long(heard)
        late = (float(t) for t in looks if silence.too_long(heard + float(t)))
        assert next(late, None) == (found if found is None else pytest.approx(found))
