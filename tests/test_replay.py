"""Looking at a run again: the estimator finds what it found then, and the plots show it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")
pytest.importorskip("matplotlib", reason="needs the demo extra: pip install -e .[demo]")

import matplotlib.pyplot as plt
from mcap.reader import make_reader

from deploy import log
from deploy.codec import decode_state, encode_state
from deploy.control import Control
from deploy.log import STATE, TICK, TICK_RECORD, LogError, Recorder, about, metadata, pipe, read, write
from deploy.loop import Loop, policies
from deploy.process import Job
from deploy.remote import Button, Remote
from deploy.safety import Phase
from deploy.settings import DeployCfg
from deploy.slots import Board
from deploy.so3 import multiply, quaternion
from hmc.cfg import load
from tests.test_deploy_loop import Wire
from tools.replay import Args, Replay, main, replay
from tools.robot.standin import Settings, StandIn

ROOT = Path(__file__).parent.parent
# lock step: it does not matter how long anything takes
PATIENT = ("input.max_age=60", "input.stall=60", "watchdog.lost=60")
QUICK = ("lie.seconds=0.4", "stand.seconds=0.784")
PRESSES = (0.3, 0.75, 1.95)  # s: lie, stand, hybrid


@contextmanager
def logged(path: Path, *settings: str) -> Iterator[Recorder]:
    """A recorder whose log is in the file afterwards."""
    source, sink = pipe()

    def run() -> None:
        with os.fdopen(source, "rb") as stream:
            write(stream, path, about(Job(set=settings)))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield Recorder(sink)
    finally:
        os.close(sink)
        thread.join()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A log of a robot that rises into the foot stand; frames come one or two at a time."""
    path, settings = tmp_path_factory.mktemp("run") / "run.mcap", (*PATIENT, *QUICK)
    robot, rng, wire, board = StandIn(Settings(start="lying")), np.random.default_rng(0), Wire(), Board()
    robot.release(True)
    control = Control(load(Job().cfg, DeployCfg, settings), policies("", ""))
    with logged(path, *settings) as recorder:
        loop = Loop(wire, wire, board, control, recorder, dry_run=False)
        while robot.time < 2.3:
            pressed = any(at <= robot.time < at + 0.1 for at in PRESSES)
            robot.remote = Remote(Button.START if pressed else Button(0))
            for _ in range(rng.integers(1, 3)):
                wire.frames += robot.step(wire.sent)
                wire.sent.clear()
            for slot in (board.guard, board.plan):  # watchdog and planner are there
                beat = slot.blank()
                beat["t"] = time.monotonic()
                slot.write(beat)
            loop.turn()
        loop.end()
    assert recorder.lost == 0
    assert list(dict.fromkeys(tick["phase"] for tick in ticks(path)))[:5] == list(Phase)[:5]
    board.close()
    return path


def ticks(path: Path) -> list[dict[str, Any]]:
    return [content for topic, _, content in read(path) if topic == "tick"]


@pytest.fixture(scope="module")
def it(run: Path) -> Replay:
    return replay(run)


def test_readings_give_the_estimates_of_the_log_to_the_bit(it: Replay) -> None:
    """Lying, and in the foot stand after the estimator has begun anew between two ticks."""
    (anew,) = {tick["anew"] for tick in it.ticks} - {-1}
    known = [tick for tick in it.ticks if any(tick["variance"])]
    before, after = (sum((tick["ms"] > anew) == late for tick in known) for late in (False, True))
    assert min(before, after) > 15
    assert anew not in {tick["ms"] for tick in it.ticks}
    for tick in known:
        assert np.array_equal(tick["x"], it.again[tick["ms"]])
    assert it.difference() == (0.0, 0.0)
    assert it.refused == 0


@pytest.mark.parametrize("turn", [[0.1, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 1e-9], [0.0, 3.0, 0.0]])
def test_a_difference_is_told(it: Replay, turn: list[float]) -> None:
    """2 cm, and a turn about any axis, at one tick each; there is none where nothing is known."""
    other, (one, two) = dict(it.again), (tick["ms"] for tick in it.ticks[-2:])
    for ms in (one, two):
        other[ms] = other[ms].copy()
    other[one][2] += 0.02
    other[one][3:7] *= -1  # the same attitude
    other[two][3:7] = multiply(other[two][3:7], quaternion(np.array(turn)))
    height, angle = replace(it, again=other).difference()
    assert height == pytest.approx(0.02)
    assert angle == pytest.approx(np.linalg.norm(turn), rel=1e-6)
    assert np.isnan(replace(it, again={}).difference()).all()


def test_frames_are_believed_as_in_the_run(tmp_path: Path) -> None:
    """Every third of these would be out of the usual range; without it there is a gap as well."""
    robot, frames = StandIn(Settings()), []
    for i in range(30):
        (frame,) = robot.step([])
        state = decode_state(frame)
        frames.append(encode_state(state._replace(gyro=np.full(3, 36.0))) if i % 3 == 1 else frame)
    for settings, refused in ((("input.gyro=40",), 0), ((), 10)):
        path = tmp_path / f"{refused}.mcap"
        with logged(path, *settings) as recorder:
            for frame in frames:
                recorder.add(STATE, frame)
        assert replay(path).refused == refused
        assert "input.gyro = " in metadata(path)["settings"]


def test_plots_are_drawn(
    run: Path,
    it: Replay,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Into a PNG file; each of its five parts shows something in colour."""
    monkeypatch.setattr("tools.replay.replay", lambda path: {run: it}[path])
    out = tmp_path / "plots.png"
    main(Args(run, out))
    assert out.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    image = plt.imread(out)[:, :, :3]
    coloured = np.ptp(image, axis=2) > 0.2
    assert all(part.sum() > 200 for part in np.array_split(coloured, 5))
    told = capsys.readouterr().out
    assert f"{len(it.ticks)} control steps, {len(it.again)} states" in told
    assert "0 frames refused" in told
    assert "height 0.00 mm, attitude 0.000 deg" in told
    assert told.splitlines()[-1] == str(out)


def test_a_log_is_read_as_it_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In chunks or not, though the wall clock is set back again and again."""
    for chunk in (log.CHUNK, 1000):
        path, stamps = tmp_path / f"{chunk}.mcap", iter([100, 300, 200, 50, 250] * 40)
        with monkeypatch.context() as then:
            then.setattr(log, "CHUNK", chunk)
            then.setattr(time, "time_ns", lambda stamps=stamps: next(stamps))
            with logged(path) as recorder:
                for k in range(200):
                    recorder.event("told", k=k)
        assert [content["k"] for _, _, content in read(path)] == list(range(200))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    octets = bytearray(path.read_bytes())
    octets[summary.chunk_indexes[3].chunk_start_offset] = 0x50  # no chunk any more
    path.write_bytes(octets)
    with pytest.raises(LogError, match=r"damaged .*records, expected 200"):
        list(read(path))


def a_tick(path: Path) -> Path:
    with logged(path) as recorder:
        recorder.add(TICK_RECORD, np.zeros((), TICK).tobytes())
    return path


def refused(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that is said of a log, with exit status 2."""
    with pytest.raises(SystemExit) as ended:
        main(Args(path))
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1
    assert str(path) in err
    return err


def test_a_log_of_another_version(tmp_path, monkeypatch, capsys) -> None:
    with monkeypatch.context() as then:
        then.setattr(log, "VERSION", "1")
        path = a_tick(tmp_path / "old.mcap")
    line = refused(path, capsys)
    assert f"is of version 1, expected {log.VERSION}: take the hmc that wrote it" in line
    with pytest.raises(LogError, match="is of version 1"):
        metadata(path)


def test_what_is_no_log(tmp_path, monkeypatch, capsys) -> None:
    with monkeypatch.context() as other:
        other.setattr(log, "METADATA", "somebody's")
        path = a_tick(tmp_path / "other.mcap")
    assert "an MCAP file of another program: give a run.mcap of deploy/go2.py" in refused(path, capsys)
    with logged(tmp_path / "empty.mcap"):
        pass
    assert "holds no control step" in refused(tmp_path / "empty.mcap", capsys)
    assert "no such file" in refused(tmp_path / "none.mcap", capsys)
    (tmp_path / "text.mcap").write_text("no log")
    assert "not a whole MCAP file" in refused(tmp_path / "text.mcap", capsys)


@pytest.mark.deploy
def test_the_program(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is called, on a good log and on one of another version."""
    monkeypatch.setattr(log, "VERSION", "1")
    old = a_tick(tmp_path / "old.mcap")
    for path, status, lines in ((run, 0, 0), (old, 2, 1)):
        command = [sys.executable, "tools/replay.py", str(path)]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert (ran.returncode, ran.stderr.count("\n")) == (status, lines), ran.stderr
    assert run.with_name("replay.png").stat().st_size > 20_000
    assert not old.with_name("replay.png").exists()
