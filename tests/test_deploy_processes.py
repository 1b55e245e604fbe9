"""The watchdog and the log as processes of their own, and bad input."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import decode_command
from deploy.dds import Link, Subscriber
from deploy.go2 import Args
from deploy.log import STATE, TICK, TICK_RECORD, LogError, Recorder, pipe, read
from deploy.messages import LowCmd_
from deploy.process import Job, spawn
from deploy.settings import WatchdogCfg
from deploy.slots import Board, said
from deploy.watchdog import DAMPED, Process, Watchdog
from hmc.cli import command_line
from tools.robot.process import Args as StandInArgs

ROOT = Path(__file__).parent.parent
DOMAIN = 10 + os.getpid() % 100
SLEEPER = [sys.executable, "-c", "import time; time.sleep(60)"]


@pytest.fixture
def board() -> Iterator[Board]:
    made = Board()
    yield made
    made.close()


def beat(board: Board, t: float, commanding: bool = True) -> None:
    heart = board.heart.blank()
    heart["t"], heart["commanding"] = t, commanding
    board.heart.write(heart)


def looks(it: Watchdog, first: float, last: float) -> bool:
    """Whether it damps, looking every 4 ms between these times [s]."""
    return any(it.look(gone=False, now=first + 0.004 * k) for k in range(round((last - first) / 0.004)))


def test_watchdog_latches_by_age_and_death_and_never_before_the_first_command(board):
    it = Watchdog(board, WatchdogCfg(hang=0.07))
    assert not it.look(gone=False, now=1.0)  # nobody there yet
    beat(board, 1.0, commanding=False)
    assert not it.look(gone=True, now=9.0)  # it never moved the robot
    beat(board, 9.0)
    assert not looks(it, 9.001, 9.070)
    assert it.look(gone=False, now=9.072)
    beat(board, 10.0)  # it wakes up again
    assert it.look(gone=False, now=10.0)
    assert said(board.guard.read()["reason"].item()) == "the control process hung for 72 ms"
    other = Watchdog(board, WatchdogCfg())
    assert other.look(gone=True, now=10.0)
    assert other.reason == "the control process ended"


def test_a_pause_of_the_whole_machine_is_no_hang(board):
    """The watchdog stands still with the control process, which then gets the time that it has otherwise."""
    it = Watchdog(board, WatchdogCfg(period=0.004, hang=0.07, stall=0.2))
    beat(board, 1.0)
    assert not looks(it, 1.0, 1.02)
    assert not looks(it, 1.15, 1.19)  # 130 ms later
    beat(board, 1.19)
    assert not looks(it, 1.19, 1.25)
    assert it.look(gone=False, now=1.40), "but no longer than this"
    it = Watchdog(board, WatchdogCfg(period=0.004, hang=0.07, stall=0.2))
    beat(board, 2.0)
    assert not looks(it, 2.0, 2.02)
    assert looks(it, 2.10, 2.16), "after the pause it hung"


def test_a_process_ends_when_it_is_killed_and_not_by_its_name():
    code = "import ctypes, time; ctypes.CDLL(None).prctl(15, b'x) Z 4 4 4 4 4'); print(flush=True)"
    with subprocess.Popen(
        [sys.executable, "-c", f"{code}; time.sleep(60)"], stdout=subprocess.PIPE
    ) as victim:
        assert victim.stdout is not None
        victim.stdout.readline()
        it = Process(victim.pid)
        assert not it.ends
        victim.kill()
        until = time.monotonic() + 5.0
        while not it.ends and time.monotonic() < until:
            time.sleep(0.001)
        assert it.ends
        victim.wait()
        assert it.ends
        it.close()
        late = Process(victim.pid)
        assert late.ends
        late.close()


@contextmanager
def watched(board: Board) -> Iterator[tuple[subprocess.Popen[bytes], Subscriber]]:
    """A process in place of the controller, a watchdog that knows it, and what is commanded."""
    commands = Link(DOMAIN).subscriber("rt/lowcmd", LowCmd_, depth=2000)
    with subprocess.Popen(SLEEPER) as victim:
        watchdog = spawn("watchdog", Job(board.descriptor, DOMAIN, pid=victim.pid), [board.descriptor])
        until = time.monotonic() + 20
        while (board.guard.read() is None or not commands.peers) and time.monotonic() < until:
            time.sleep(0.01)
        try:
            yield victim, commands
        finally:
            victim.kill()
            watchdog.terminate()
            assert watchdog.wait(5) == 0


def until_damped(commands: Subscriber) -> float:
    """When the first command came [s]; it and the next 50 are damping at 200 Hz or more."""
    frames: list[bytes] = commands.take(2.0)
    first = time.monotonic()
    while len(frames) < 51 and time.monotonic() < first + 2.0:
        frames += commands.take(0.1)
    assert time.monotonic() - first < 50 / 200
    for frame in frames:
        motors = decode_command(frame).motors
        assert decode_command(frame).crc_ok
        assert not motors.kp.any()
        assert (motors.kd == 5.0).all()
    return first


@pytest.mark.clock
def test_a_killed_controller_is_followed_by_damping_within_20_ms(board):
    with watched(board) as (victim, commands):
        for _ in range(20):
            beat(board, time.monotonic())
            time.sleep(0.005)
        assert commands.take() == []
        beat(board, time.monotonic() + 10.0)  # so that death alone counts
        victim.kill()
        killed = time.monotonic()
        assert until_damped(commands) - killed < 0.02


@pytest.mark.clock
def test_a_controller_that_hangs_is_damped_within_100_ms(board):
    with watched(board) as (_, commands):
        beat(board, stopped := time.monotonic())
        assert until_damped(commands) - stopped < 0.1
        beat(board, time.monotonic())
        time.sleep(0.05)
        assert board.guard.read()["latched"]


def test_a_watchdog_that_is_told_to_end_stays_as_long_as_it_is_needed(board):
    """Who ends a whole group of processes tells it and the control process at once."""
    with watched(board) as (victim, commands):
        (watchdog,) = (int(board.guard.read()["pid"]),)
        beat(board, time.monotonic() + 60.0)
        time.sleep(0.05)
        os.kill(watchdog, signal.SIGTERM)
        assert commands.take(0.3) == []  # the control process lives and commands
        victim.kill()
        first, last = until_damped(commands), 0.0
        while commands.take(0.1):
            last = time.monotonic()
        assert last - first > DAMPED - 0.1
        state = Path(f"/proc/{watchdog}/stat")
        while state.read_text().split()[2] != "Z":  # it has ended by itself, when its interpreter has
            assert time.monotonic() < last + 10
            time.sleep(0.01)


def test_the_log_keeps_what_came_before_a_death(tmp_path):
    source, sink = pipe()
    process = spawn("log", Job(log=source, path=str(tmp_path / "run.mcap")), [source])
    os.close(source)
    recorder = Recorder(sink)
    tick = np.zeros((), TICK)
    for k in range(100):
        tick["k"], tick["x"] = k, 0.5 * k
        recorder.add(TICK_RECORD, tick.tobytes())
        recorder.add(STATE, bytes([k]) * 1180)
    recorder.event("phase", reason="of a test")
    recorder.add(STATE, bytes(9999))  # larger than a record may be
    assert recorder.lost == 1
    os.close(sink)  # as the kernel does for a process that is killed
    assert process.wait(20) == 0
    found = list(read(tmp_path / "run.mcap"))
    ticks = [content for topic, _, content in found if topic == "tick"]
    assert [tick["k"] for tick in ticks] == list(range(100))
    assert ticks[7]["x"] == [3.5] * 37
    assert [content[0] for topic, _, content in found if topic == "rt/lowstate"] == list(range(100))
    assert [content for topic, _, content in found if topic == "event"] == [
        {"what": "phase", "reason": "of a test"}
    ]
    octets = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(octets[: len(octets) // 2])
    with pytest.raises(LogError, match="mcap recover"):
        list(read(tmp_path / "cut.mcap"))


def test_a_full_pipe_never_waits():
    source, sink = pipe()
    recorder = Recorder(sink)
    began = time.monotonic()
    for _ in range(3000):
        recorder.add(STATE, bytes(1180))
    assert time.monotonic() - began < 1.0
    assert recorder.lost > 1000
    os.close(source)
    recorder.add(STATE, b"")  # nobody reads any more
    os.close(sink)


def test_the_real_time_side_needs_neither_torch_nor_mujoco():
    code = "import sys, deploy.loop, deploy.watchdog, deploy.log; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(ran.stdout.split())
    assert "onnxruntime" in loaded
    assert not loaded & {"torch", "mujoco", "warp", "mujoco_warp", "tyro", "rich"}


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--interface", "eth77"], "no network interface 'eth77'"),
        (["--set", "input.max_aeg=1"], "unknown key input.max_aeg; did you mean max_age?"),
        (["--foot", "none.onnx"], "policy none.onnx: no such file"),
        (["--robot", "state-delay"], "--robot takes settings such as state-delay=0.002, got 'state-delay'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, told, tmp_path):
    ran = subprocess.run(
        [sys.executable, "deploy/go2.py", "--domain", str(DOMAIN), "--out", str(tmp_path), *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ran.returncode == 2, ran.stderr
    assert told in ran.stderr
    assert ran.stderr.count("\n") == 1


def test_the_stand_in_is_told_its_settings():
    """By the command line itself, several times or at once."""
    words = ["--robot", "states.drop=0.25", "loss=limp", "--seed", "3", "--robot", "state-delay=0.002"]
    found = command_line(Args, words).stand_in
    robot = command_line(StandInArgs, found).robot
    assert (robot.seed, robot.start, robot.loss, robot.state_delay) == (3, "lying", "limp", 0.002)
    assert robot.states.drop == 0.25
