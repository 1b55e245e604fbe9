"""Mutated octets wherever octets come in: nothing crashes, and nothing is commanded because of them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import COMMAND_SIZE, STATE_SIZE, decode_state, encode_command, encode_state, seal
from deploy.log import STATE, TICK, TICK_RECORD, LogError, Recorder, pipe, read, write
from deploy.messages import LowCmd_, Request_, RequestHeader_, RequestIdentity_, Response_
from deploy.motion_switcher import (
    CHECK_MODE,
    RELEASE_MODE,
    SELECT_MODE,
    MotionSwitcherService,
    _understood,
)
from deploy.remote import Button, Remote, pack
from deploy.safety import PEAK_TORQUE, Phase
from hmc.go2.stances import FOOTSTAND
from tests.test_deploy_control import Rig, check, duplicate
from tests.test_deploy_loop import Wire
from tools.robot.motors import hold
from tools.robot.standin import Settings, StandIn

REMOTE = slice(1104, 1144)  # its octets in a state frame

MANY = [pytest.param(2_000, id="some"), pytest.param(100_000, id="many", marks=pytest.mark.deploy)]


def mutated(octets: bytes, rng: np.random.Generator) -> bytearray:
    """Octets overwritten, flipped, cut out, put in, cut short or made longer."""
    found, kind = bytearray(octets), rng.integers(5)
    at, size = int(rng.integers(len(found))), int(rng.integers(1, 64))
    if kind == 0:
        found[at : at + size] = rng.bytes(len(found[at : at + size]))
    elif kind == 1:
        for place in rng.integers(0, len(found), size):
            found[place] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        del found[at : at + size]
    elif kind == 3:
        found[at:at] = rng.bytes(size)
    else:
        found = found[:at] + bytes(size)
    return found


@pytest.mark.parametrize("count", MANY)
def test_state_frames(count: int) -> None:
    """In the foot stand, every second frame mutated, half of those under a good checksum.

    Whatever is commanded is within the limits, and a frame that is refused changes nothing of it.
    """
    rng, rig = np.random.default_rng(0), Rig().run(3.0)
    kept, frame, start = rig.control, rig.robot.step(rig.sent)[-1], rig.robot.time
    control, now, tick, refused, damped = duplicate(kept), start, decode_state(frame).tick, 0, 0
    for i in range(count):
        now, tick = now + 0.002, tick + 2
        good = encode_state(decode_state(frame)._replace(tick=tick))
        bad = mutated(good, rng)
        if len(bad) == STATE_SIZE and rng.random() < 0.5:
            seal(bad)
        before, heard = control.command, control.checks.heard
        control.hear(bytes(bad), now)
        assert control.command is not None
        check(control.command)
        if control.checks.heard == heard:
            refused += 1
            assert control.command == before or control.phase == Phase.DAMPING
        control.hear(good, now)
        check(control.command)
        if control.phase == Phase.DAMPING or i % 200 == 199:  # it is on its feet again
            damped += control.phase == Phase.DAMPING
            control, now, tick = duplicate(kept), start, decode_state(frame).tick
    assert refused > 0.7 * count
    assert damped < 0.2 * count


@pytest.mark.parametrize("count", MANY)
def test_state_frames_in_the_passive_phase(count: int) -> None:
    """Nothing is commanded, whatever comes, but where START is pressed."""
    rng, rig = np.random.default_rng(4), Rig().run(0.2, ())
    kept, frame, start = rig.control, rig.robot.step([])[-1], rig.robot.time
    assert decode_state(frame).remote == frame[REMOTE]
    control, now, tick, believed = duplicate(kept), start, decode_state(frame).tick, 0
    for i in range(count):
        now, tick = now + 0.002, tick + 2
        good = encode_state(decode_state(frame)._replace(tick=tick))
        bad = mutated(good, rng)
        if len(bad) == STATE_SIZE and rng.random() < 0.5:
            bad[REMOTE] = good[REMOTE]
            seal(bad)
        before = control.checks.heard
        for each in (bytes(bad), good):
            control.hear(each, now)
            assert control.command is None
            assert control.phase == Phase.PASSIVE
            believed += each != good and control.checks.heard != before
        if control.checks.fault(now) or i % 200 == 199:
            control, now, tick = duplicate(kept), start, decode_state(frame).tick
    assert 0.01 * count < believed < 0.3 * count
    pressed = decode_state(frame)._replace(remote=pack(Remote(Button.START)))
    for i in range(20):
        control.hear(encode_state(pressed._replace(tick=tick + 2 * i)), now + 0.002 * i)
    assert control.phase == Phase.LIE
    assert control.command is not None


@pytest.mark.parametrize("count", MANY)
def test_command_frames(count: int) -> None:
    """The stand-in in the foot stand follows only what is whole, and stays a robot whatever it follows."""
    rng, robot, accepted = np.random.default_rng(3), standing(), 0
    command = hold(FOOTSTAND.state().numpy()[7:19], 60.0, 5.0)
    for i in range(count):
        good = encode_command(command)
        bad = mutated(good, rng)
        sealed = len(bad) == COMMAND_SIZE and rng.random() < 0.5
        octets = seal(bad) if sealed else bytes(bad)
        before = robot.accepted
        robot.step([octets])
        if robot.accepted > before:
            accepted += 1
            assert sealed or octets == good
            told = LowCmd_.deserialize(octets)
            assert (told.head, told.level_flag) == (b"\xfe\xef", 0xFF)
            for motor in told.motor_cmd[:12]:
                assert motor.mode in (0, 1)
                assert np.isfinite([motor.q, motor.dq, motor.tau, motor.kp, motor.kd]).all()
        truth = robot.truth()
        assert np.isfinite(np.concatenate([truth.qpos, truth.qvel])).all()
        assert (np.abs(truth.torque) <= PEAK_TORQUE * (1 + 1e-6)).all()
        robot.step([good])
        assert robot.accepted > before
        if i % 200 == 199:  # it is on its feet again
            robot = standing()
    assert 0.05 * count < accepted < 0.5 * count


def standing() -> StandIn:
    return StandIn(Settings(start="footstand", command_delay=0.0))


class Post(Wire):
    """A link whose topics are one list to read from and one to write to."""

    def subscriber(self, topic: str, kind: type, **_: bool) -> Post:
        return self


@pytest.mark.parametrize("count", MANY)
def test_calls_to_the_motion_switcher(count: int) -> None:
    """Each is answered once or not at all; only one that asks for it lets go of the legs."""
    rng, post = np.random.default_rng(5), Post()
    service, answered, let_go = MotionSwitcherService(post), 0, 0
    calls = [
        Request_(RequestHeader_(RequestIdentity_(7, function)), parameter).serialize()
        for function, parameter in ((CHECK_MODE, "{}"), (SELECT_MODE, '{"name": "ai"}'), (RELEASE_MODE, "{}"))
    ]
    for i in range(count):
        call, service.name = bytes(mutated(calls[i % 3], rng)), "mcf"
        post.frames, post.sent = [call], []
        service.serve()
        assert isinstance(service.name, str)
        assert len(post.sent) <= 1
        if service.name != "mcf":
            header = Request_.deserialize(call).header
            assert header.identity.api_id in ((SELECT_MODE,) if service.name else (SELECT_MODE, RELEASE_MODE))
            let_go += not service.name
        for octets in post.sent:
            answered += 1
            assert Response_.deserialize(octets).header.identity == Request_.deserialize(call).header.identity
    assert 0.1 * count < answered < 0.9 * count
    assert let_go > 0


@pytest.mark.parametrize("count", MANY)
def test_answers_of_the_motion_switcher(count: int) -> None:
    rng = np.random.default_rng(1)
    whole = Response_(data='{"name": "mcf"}').serialize()
    found = [_understood(Response_, bytes(mutated(whole, rng))) for _ in range(count)]
    assert any(each is None for each in found)
    assert any(isinstance(each, Response_) for each in found)


def a_log(path: Path) -> bytes:
    source, sink = pipe()
    recorder, tick = Recorder(sink), np.zeros((), TICK)
    for k in range(20):
        tick["k"] = k
        recorder.add(TICK_RECORD, tick.tobytes())
        recorder.add(STATE, bytes([k]) * 1180)
    recorder.event("phase", reason="of a test")
    os.close(sink)
    with os.fdopen(source, "rb") as stream:
        write(stream, path, {})
    return path.read_bytes()


@pytest.mark.parametrize(
    "count", [pytest.param(200, id="some"), pytest.param(100_000, id="many", marks=pytest.mark.deploy)]
)
def test_logs(count: int, tmp_path: Path) -> None:
    """A damaged log is read as it was written, or refused with a line that names it."""
    octets, rng = a_log(tmp_path / "run.mcap"), np.random.default_rng(2)
    topics = {topic for topic, _, _ in read(tmp_path / "run.mcap")}
    assert topics == {"tick", "rt/lowstate", "event"}
    told = []
    for _ in range(count):
        path = tmp_path / "bad.mcap"
        path.write_bytes(mutated(octets, rng))
        try:
            list(read(path))
        except LogError as error:
            told.append(str(error))
    assert len(told) > 0.5 * count
    assert all("bad.mcap" in line and "\n" not in line for line in told)
