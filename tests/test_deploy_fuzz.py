"""Mutated octets wherever octets come in: nothing crashes, and nothing is commanded because of them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import STATE_SIZE, decode_state, encode_state, seal
from deploy.log import STATE, TICK, TICK_RECORD, LogError, Recorder, pipe, read, write
from deploy.messages import Response_
from deploy.motion_switcher import _understood
from deploy.safety import Phase
from tests.test_deploy_control import Rig, check, duplicate

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
def test_calls_of_the_motion_switcher(count: int) -> None:
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
    "count", [pytest.param(200, id="some"), pytest.param(20_000, id="many", marks=pytest.mark.deploy)]
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
