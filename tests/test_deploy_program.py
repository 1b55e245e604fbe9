"""The whole program with its processes, ended in every way."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import decode_command
from deploy.dds import Link
from deploy.messages import LowCmd_
from tests.test_deploy_kills import prompt

ROOT = Path(__file__).parent.parent
DOMAIN = 10 + os.getpid() % 100


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
@pytest.mark.parametrize(
    "how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGKILL", "SIGINT, planner stopped", "SIGTERM, to all"]
)
def test_however_the_program_ends_the_robot_is_damped_until_it_lies(program, how):
    """A lost terminal, a planner that hangs, and a system that ends all of it are no reasons to leave it."""
    program.until("hybrid foot")
    time.sleep(1.0)
    if "planner" in how:
        os.kill(program.child("deploy.planner"), signal.SIGSTOP)
    everybody = ["watchdog", "loop", "planner", "log"] if "all" in how else []
    children = [program.child(f"deploy.{name}") for name in everybody]
    program.commands.take()
    with prompt():
        for child in children:
            os.kill(child, signal.SIGTERM)
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
def test_keys_that_kill_or_stop_a_program_spare_who_holds_the_robot(program):
    """Ctrl-\\ and Ctrl-Z go to all processes of the terminal's foreground group."""
    program.until("hybrid foot")
    for name in ("loop", "watchdog"):
        assert os.getpgid(program.child(f"deploy.{name}")) != os.getpgid(program.process.pid)
    program.process.send_signal(signal.SIGTSTP)
    time.sleep(1.0)
    program.commands.take()
    time.sleep(0.2)
    assert len(program.commands.take()) > 50  # the foot stand goes on
    program.process.send_signal(signal.SIGCONT)
    program.process.send_signal(signal.SIGINT)
    assert program.end()["stages_true"]["foot_stand"]


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


@pytest.mark.deploy
def test_the_run_is_over_when_the_stand_in_is_gone(tmp_path):
    run = Run(tmp_path)
    run.until("hybrid foot")
    os.kill(run.child("go2_robot"), signal.SIGKILL)
    began = time.monotonic()
    summary = run.end()
    assert time.monotonic() - began < 20
    assert run.process.returncode == 1
    assert summary["stages_true"] is None
    assert int(str(summary["ticks"])) > 100


@pytest.mark.deploy
def test_a_second_run_leaves_the_first_ones_files_alone(program):
    program.until("lie")
    command = [sys.executable, "deploy/go2.py", "--domain", str(DOMAIN + 1), "--out", str(program.out)]
    other = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert other.returncode == 2
    assert "another run writes to" in other.stderr
    program.process.send_signal(signal.SIGINT)
    assert program.end()["memory_mb"] is not None
