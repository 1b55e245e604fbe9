"""Processes of the deployment that are killed or stopped in each phase: how soon the robot is damped."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.buttons import Port
from deploy.codec import decode_command
from deploy.dds import Link
from deploy.messages import LowCmd_
from deploy.process import ENVIRONMENT, ROOT, Job, spawn
from deploy.safety import Phase
from deploy.settings import WatchdogCfg
from deploy.slots import Board
from deploy.slots import said as told
from hmc.go2.stances import FOOTSTAND

pytestmark = [pytest.mark.deploy, pytest.mark.clock]

DOMAIN = 10 + os.getpid() % 100
QUICK = ("lie.seconds=0.4", "stand.seconds=0.8")
STEEP = -70.0  # deg of pitch that count as the foot stand
KILLED, STOPPED = 0.02, WatchdogCfg().hang + 0.02  # s until the first damping frame
SOON = 0.1  # s
COMMANDED = (Phase.LIE, Phase.STAND, Phase.READY, Phase.HYBRID)


class Deployed:
    """Stand-in, control process, watchdog and planner, and the operator's remote.

    Attributes:
        control, watchdog, planner: processes.
        robot: stand-in's process.
        truth: file of its log, once it has ended.
        link, board: what the processes have between them.
        commands: whatever is commanded.
    """

    def __init__(self, stack: ExitStack, folder: Path):
        self.board = Board()
        stack.callback(self.board.close)
        self.truth = folder / "truth.npz"
        self.link = Link(DOMAIN)
        self.commands = self.link.subscriber("rt/lowcmd", LowCmd_, depth=5000)
        command = [sys.executable, "tools/go2_robot.py", "--domain", str(DOMAIN), "--log", str(self.truth)]
        command += ["--robot.start", "lying"]
        self.robot = subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
        stack.callback(end, self.robot)
        port = re.search(r"orders at UDP port (\d+)", said(self.robot))
        assert port
        self._remote = Port(int(port[1]))
        stack.callback(self._remote.close)
        slots = [self.board.descriptor]
        base = {"board": self.board.descriptor, "domain": DOMAIN, "set": QUICK, "release": True}
        self.control = spawn("loop", Job(**base), slots, stdout=subprocess.PIPE)
        stack.callback(end, self.control)
        assert said(self.control).startswith("ready")
        self.watchdog = spawn("watchdog", Job(**base, pid=self.control.pid), slots)
        stack.callback(end, self.watchdog)
        self.planner = spawn("planner", Job(**base), slots)
        stack.callback(end, self.planner)

    @property
    def phase(self) -> Phase:
        """As the control process tells it."""
        status = self.board.status.read()
        return Phase.PASSIVE if status is None else Phase(int(status["phase"]))

    @property
    def reason(self) -> str:
        """Why the control process damps, or what it is waiting for."""
        status = self.board.status.read()
        return "" if status is None else told(status["reason"].item())

    @property
    def stands(self) -> bool:
        """Whether the robot is in the foot stand, as the control process tells it."""
        status = self.board.status.read()
        return self.phase == Phase.HYBRID and status is not None and float(status["pitch"]) < STEEP

    def reach(self, phase: Phase) -> None:
        """Press START until this phase, in which nobody presses it any more; the foot stand is waited for."""
        until = time.monotonic() + 60.0
        while self.phase < phase:
            self._remote.press("START")
            self._wait(0.1, lambda: self.phase >= phase)
            self._remote.press()
            self._wait(0.1, lambda: self.phase >= phase)
            assert time.monotonic() < until, self.reason
        while phase == Phase.HYBRID and not self.stands:
            time.sleep(0.01)
            assert time.monotonic() < until, self.reason
        assert self.phase == phase, self.reason

    def _wait(self, seconds: float, until: Callable[[], bool]) -> None:
        last = time.monotonic() + seconds
        while time.monotonic() < last and not until():
            time.sleep(0.005)

    def damped_after(self, strike: Callable[[], object], most: float = 1.0) -> float:
        """Time from a strike to the first damping command [s]; no other one follows it."""
        while self.commands.take():
            pass
        with prompt():
            strike()
            struck = time.monotonic()
            found = None
            while found is None and time.monotonic() < struck + most:
                frames = self.commands.take(0.005)
                if not all(map(moves, frames)):
                    found = time.monotonic()
        assert found is not None
        time.sleep(0.1)
        assert not any(map(moves, self.commands.take()))
        return found - struck


def moves(frame: bytes) -> bool:
    """Whether a command does more than to resist motion."""
    return bool(decode_command(frame).motors.kp.any())


def said(process: subprocess.Popen[str]) -> str:
    """The next line that it prints."""
    assert process.stdout is not None
    return process.stdout.readline()


def end(process: subprocess.Popen[str]) -> None:
    """End a process, also one that is stopped."""
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGCONT)
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


@contextmanager
def prompt() -> Iterator[None]:
    """Real-time priority, where it is granted: or the test's own wait for a core is measured."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture
def deployed(tmp_path: Path) -> Iterator[Deployed]:
    with ExitStack() as stack:
        yield Deployed(stack, tmp_path)


@pytest.mark.parametrize(("number", "most"), [(signal.SIGKILL, KILLED), (signal.SIGSTOP, STOPPED)])
@pytest.mark.parametrize("phase", COMMANDED, ids=lambda phase: phase.name.lower())
def test_a_control_process_that_is_killed_or_stopped(tmp_path, capsys, phase, number, most) -> None:
    """In the foot stand, where the planner has the cores, five times."""
    took = []
    for _ in range(5 if phase == Phase.HYBRID else 1):
        with ExitStack() as stack:
            it = Deployed(stack, tmp_path)
            it.reach(phase)
            time.sleep(0.2 if phase in (Phase.READY, Phase.HYBRID) else 0.05)
            assert it.phase == phase, it.reason
            took.append(it.damped_after(partial(os.kill, it.control.pid, number)))
    with capsys.disabled():
        times = ", ".join(f"{1e3 * one:.1f}" for one in sorted(took))
        print(
            f"\n{phase.name.lower()}, {number.name}: damped after {times} ms, the worst {1e3 * max(took):.1f}"
        )
    assert max(took) < most


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_foot_stand_goes_on_without_the_planner(deployed: Deployed, number: signal.Signals) -> None:
    deployed.reach(Phase.HYBRID)
    time.sleep(1.0)
    deployed.planner.send_signal(number)
    before, until = deployed.board.status.read(), time.monotonic() + 4.0
    while time.monotonic() < until:
        assert deployed.phase == Phase.HYBRID, deployed.reason
        time.sleep(0.02)
    with suppress(ProcessLookupError):
        deployed.planner.send_signal(signal.SIGCONT)
    time.sleep(1.0)  # what was planned before comes too late
    assert deployed.phase == Phase.HYBRID, deployed.reason
    after = deployed.board.status.read()
    assert before is not None
    assert after is not None
    assert after["missed"] - before["missed"] <= 2
    end(deployed.robot)
    with np.load(deployed.truth) as truth:
        x = torch.from_numpy(np.concatenate([truth["qpos"], truth["qvel"]], axis=1)[-2000:])
    assert bool(FOOTSTAND.held(x).all()), "4 s of it"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_without_the_watchdog_the_control_process_damps(deployed, capsys, number) -> None:
    deployed.reach(Phase.READY)
    took = deployed.damped_after(lambda: deployed.watchdog.send_signal(number))
    with capsys.disabled():
        print(f"\nno watchdog, {number.name}: damped after {1e3 * took:.1f} ms")
    assert took < SOON


def test_beside_another_program_that_commands_the_control_process_damps(deployed, capsys) -> None:
    deployed.reach(Phase.READY)
    time.sleep(0.5)
    others = []

    def appear() -> None:
        others.append(deployed.link.publisher("rt/lowcmd", LowCmd_))
        while not others[0].peers:  # nobody would hear it yet
            time.sleep(0.001)

    took = deployed.damped_after(appear, 3.0)
    with capsys.disabled():
        print(f"\nanother program: damped after {1e3 * took:.1f} ms")
    assert took < SOON
