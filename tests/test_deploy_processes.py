"""The watchdog, the log and the whole program as processes of their own, ended in every way."""

from __future__ import annotations

import json
import os
import re
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
from deploy.watchdog import Process, Watchdog
from hmc.cli import command_line
from tests.test_deploy_kills import prompt
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


class Run:
    """The program with the stand-in, its operator held back; its processes, found by their commands."""

    def __init__(self, out: Path, *arguments: str):
        self.out = out
        command = [sys.executable, "deploy/go2.py", "--domain", str(DOMAIN), "--out", str(out), *arguments]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        self.commands = Link(DOMAIN).subscriber("rt/lowcmd", LowCmd_, depth=5000)

    def child(self, name: str) -> int:
        """Number of one of its processes."""
        found = subprocess.run(
            ["pgrep", "-P", str(self.process.pid), "-f", name], capture_output=True, text=True
        )
        return int(found.stdout.split()[0])

    def until(self, words: str, timeout: float = 120.0) -> None:
        """Read what it prints until these words."""
        assert self.process.stdout is not None
        until = time.monotonic() + timeout
        for line in self.process.stdout:
            if re.search(words, line):
                return
            assert time.monotonic() < until, words
        pytest.fail(f"it ended without {words!r}")

    def gone(self, within: float = 0.0) -> None:
        """See that nothing of it is left after so long [s]."""
        until, pattern = time.monotonic() + within, f'--domain {DOMAIN} |"domain": {DOMAIN},'
        while (
            left := subprocess.run(["pgrep", "-f", pattern], capture_output=True).stdout.split()
        ) and time.monotonic() < until:
            time.sleep(0.1)
        assert not left

    def end(self) -> dict[str, object]:
        """Its summary, once it has ended by itself; nothing of it is left."""
        self.process.communicate(timeout=60)
        self.gone()
        return json.loads((self.out / "summary.json").read_text())


@pytest.fixture
def program(tmp_path) -> Iterator[Run]:
    run = Run(tmp_path)
    yield run
    if run.process.poll() is None:
        run.process.send_signal(signal.SIGINT)
        run.process.communicate(timeout=60)


def damped(program: Run, seconds: float) -> tuple[float, float]:
    """When the first damping command came, and the longest gap in it [s]; for so long nothing else comes."""
    first = last = time.monotonic()
    until, longest, found = first + 5.0, 0.0, False
    while time.monotonic() < until:
        for frame in program.commands.take(0.005):
            if found:
                assert not decode_command(frame).motors.kp.any()
                longest = max(longest, time.monotonic() - last)
            elif not decode_command(frame).motors.kp.any():
                found, first = True, time.monotonic()
                until = first + seconds
            last = time.monotonic()
    assert found
    return first, max(longest, time.monotonic() - last)


@pytest.mark.clock
@pytest.mark.deploy
def test_killed_in_the_foot_stand(program):
    """The watchdog damps at once, and until the robot lies."""
    program.until("hybrid foot")
    time.sleep(1.0)
    control = program.child("deploy.loop")
    program.commands.take()
    with prompt():
        os.kill(control, signal.SIGKILL)
        killed = time.monotonic()
        first, gap = damped(program, 2.5)
    assert first - killed < 0.02
    assert gap < 0.05
    program.end()


@pytest.mark.clock
@pytest.mark.deploy
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGKILL", "SIGINT, planner stopped"])
def test_however_the_program_ends_the_robot_is_damped_until_it_lies(program, how):
    """A lost terminal, or a planner that hangs, is no reason to leave it alone."""
    program.until("hybrid foot")
    time.sleep(1.0)
    if "planner" in how:
        os.kill(program.child("deploy.planner"), signal.SIGSTOP)
    program.commands.take()
    with prompt():
        program.process.send_signal(signal.Signals[how.split(",")[0]])
        told = time.monotonic()
        first, gap = damped(program, 2.5)
    assert first - told < 0.1
    assert gap < 0.05
    if how == "SIGKILL":  # nobody is left to write a summary
        program.process.communicate(timeout=60)
        program.gone(20.0)
    else:
        program.end()


@pytest.mark.deploy
def test_the_foot_stand_goes_on_without_the_planner(program):
    program.until("hybrid foot")
    control, planner = (os.sched_getaffinity(program.child(f"deploy.{name}")) for name in ("loop", "planner"))
    if len(os.sched_getaffinity(0)) > 1:
        assert len(control) == 1
        assert not control & planner
    os.kill(program.child("deploy.planner"), signal.SIGKILL)
    time.sleep(5.0)
    program.process.send_signal(signal.SIGINT)
    summary = program.end()
    assert summary["stages_true"]["foot_stand"]
    assert summary["reasons"][-1] == "the program was told to end"


@pytest.mark.deploy
def test_a_controller_that_was_stopped_stays_silent_when_it_wakes_up(program):
    program.until("hybrid foot")
    control = program.child("deploy.loop")
    os.kill(control, signal.SIGSTOP)
    time.sleep(0.5)
    program.commands.take()
    os.kill(control, signal.SIGCONT)
    time.sleep(0.2)
    frames = program.commands.take()
    awake = [frame for frame in frames if decode_command(frame).motors.kp.any()]
    assert len(awake) <= 1  # what it was about to send when it was stopped
    assert "hung" in str(program.end()["reasons"])


@pytest.mark.deploy
def test_ctrl_c_and_a_dry_run(tmp_path):
    run = Run(tmp_path, "--dry-run")
    run.until("lie")
    run.process.send_signal(signal.SIGINT)
    summary = run.end()
    assert run.commands.take() == []
    assert int(str(summary["ticks"])) > 10
    assert summary["end"] == "damping"
