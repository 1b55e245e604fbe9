"""What the processes of a run share: how they are started, how they end, and their priority."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_PATHS = ("cfg", "path", "foot", "hand", "task")  # of a job
START_UP = 120.0  # s for a process to be ready
_PR_SET_PDEATHSIG = 1
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # of mlockall(2)
# matrices of 30 rows only lose by threads, which wait for each other in loops that fill a core
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Job:
    """What a process of a run is told.

    Attributes:
        board: descriptor of the slots.
        domain: of DDS.
        interface: network interface.
        cfg: settings file.
        set: overrides of it.
        pid: of the control process, for the watchdog.
        log: descriptor of the log's pipe: written to by the control process, read by the log's.
        path: of the log.
        dry_run: compute and log, but command nothing.
        release: let the robot's own controller be stopped.
        foot, hand: policy files; empty for those that come with the package.
        task: the planner's settings file.
        task_set: overrides of its table `task`.
        search: overrides of cfg/planner.toml.
        seed: of the planner.
        threads: of the planner's engine; 0 for one a core that the planner may use.
        speed: of the robot's clock; not 1 in slow motion alone.
        real_time: ask the kernel for real-time priority.
        core: of the control process; None for any.
        parent: number of the process that started it; `spawn` sets it.
    """

    board: int = -1
    domain: int = 1
    interface: str = "lo"
    cfg: str = str(ROOT / "cfg" / "deploy.toml")
    set: tuple[str, ...] = ()
    pid: int = 0
    log: int = -1
    path: str = ""
    dry_run: bool = False
    release: bool = False
    foot: str = ""
    hand: str = ""
    task: str = str(ROOT / "cfg" / "flip.toml")
    task_set: tuple[str, ...] = ()
    search: tuple[str, ...] = ()
    seed: int = 0
    threads: int = 0
    speed: float = 1.0
    real_time: bool = True
    core: int | None = None
    parent: int = 0


def spawn(module: str, job: Job, descriptors: Sequence[int], **streams: Any) -> subprocess.Popen[str]:
    """Start a module of `deploy` as a process that inherits these descriptors.

    It runs in the project's folder; what the job's paths are relative to is this process's. In a session of
    its own: what a key such as Ctrl-\\ or Ctrl-Z kills or stops is the program, not who holds the robot.
    """
    paths: dict[str, Any] = {
        name: str(Path(path).absolute()) for name in _PATHS if (path := getattr(job, name))
    }
    job = replace(job, parent=os.getpid(), **paths)
    command = [sys.executable, "-m", f"deploy.{module}", json.dumps(asdict(job))]
    return subprocess.Popen(
        command, cwd=ROOT, env=ENVIRONMENT, pass_fds=descriptors, text=True, start_new_session=True, **streams
    )


class Ended(RuntimeError):
    """A process ended that should not have; its exit status."""

    def __init__(self, name: str, status: int):
        why = f": a signal, no answer for {START_UP:g} s, or no memory was left" if status < 0 else ""
        super().__init__(f"{name} ended with status {status}{why}")
        self.status = status


def ready(process: subprocess.Popen[str], name: str) -> str:
    """The line in which a process says that it is ready; whatever it says before is not that.

    Raises:
        Ended: it ended before, or was ended as it took too long.
    """
    assert process.stdout is not None
    patience = threading.Timer(START_UP, process.kill)
    patience.start()
    try:
        for line in process.stdout:
            if line.startswith("ready"):
                return line
    finally:
        patience.cancel()
    raise Ended(name, process.wait())


def end(process: subprocess.Popen[str], wait: float = 10.0) -> None:
    """Tell a process to end, and see that it does within so long [s]."""
    process.terminate()
    try:
        process.wait(wait)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


def told() -> Job:
    """The job that this process was started with."""
    found: dict[str, Any] = json.loads(sys.argv[1])
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in found.items()
    }
    return Job(**values)


def until_told(parent: int = 0) -> Callable[[], bool]:
    """Whether SIGTERM has come; the terminal's Ctrl-C and its loss are the parent's business.

    Args:
        parent: number of the process whose death counts as SIGTERM, so that this one does not outlive the
            program; 0 for none. In a container it may well be process 1.
    """
    came: list[int] = []
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    if parent:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            came.append(signal.SIGTERM)
    return lambda: bool(came)


def real_time(priority: int, ask: bool = True) -> bool:
    """Ask the kernel for a real-time priority, before other threads start; whether it was granted.

    What is loaded by now is not looked at by the garbage collector any more, and what is in memory stays
    there, if the kernel lets it: to read a page of a library from the disk again takes tens of milliseconds.

    Args:
        priority: from 1 to 99.
        ask: False for the priority that the process has.
    """
    gc.collect()
    gc.freeze()
    ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    with suppress(PermissionError):
        if ask:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return ask
    return False


def share_cores() -> tuple[int | None, set[int]]:
    """The control process's own core, and those of everybody else, of the cores that this process may use.

    Who shares that core has to be driven from it at every state frame, and is not in time without real-time
    priority. A single core is everybody's.
    """
    cores = os.sched_getaffinity(0)
    own = max(cores) if len(cores) > 1 else None
    return own, cores - {own}


def allowed() -> bool:
    """Whether the kernel grants real-time priorities to this user."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        return True
    return False
