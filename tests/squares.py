"""A study that costs nothing, for tests: in a module that workers can import."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from tools import study


@dataclass(frozen=True)
class Job:
    """A number to be squared."""

    number: int


@dataclass(frozen=True)
class Row:
    """Its square."""

    job: Job
    square: int


def work(folder: Path, fatal: int, job: Job) -> Row:
    """The square; what begins is written down. The `fatal` job's first worker is killed."""
    with (folder / "begun").open("a", encoding="utf-8") as begun:
        begun.write(f"{job.number}\n")
    died = folder / "died"
    if job.number == fatal and not died.exists():
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Row(job, job.number**2)


def work_on_a_node(folder: Path, head: str, job: Job) -> Row:
    """The square. The node other than `head` is lost: it ends with the second job that begins there."""
    import ray

    away = ray.get_runtime_context().get_node_id() != head
    (folder / f"{'away' if away else 'head'}_{job.number}").touch()
    if away and len(list(folder.glob("away_*"))) == 2:
        for process in (os.getppid(), os.getpid()):  # what runs the node, and this worker before it is done
            os.kill(process, signal.SIGKILL)
    give_up = time.monotonic() + 60
    while not away and len(list(folder.glob("away_*"))) < 2 and time.monotonic() < give_up:
        time.sleep(0.1)
    return Row(job, job.number**2)


def work_slowly(folder: Path, job: Job) -> Row:
    """The square, after a minute unless it is stopped, which takes a while to be written down."""
    try:
        (folder / f"begun_{job.number}").touch()
        time.sleep(60)
    except KeyboardInterrupt:
        time.sleep(0.5)
        (folder / f"saved_{job.number}").touch()
        raise
    return Row(job, job.number**2)


def main(folder: Path) -> int:
    """Such a study as a program, of three jobs on two processes."""
    return study.stoppable(_program)(folder)


def _program(folder: Path) -> int:
    jobs, workers = [Job(i) for i in range(3)], study.Workers(processes=2)
    table, console = folder / "table.csv", Console(width=200)
    found = study.carry_out(partial(work_slowly, folder), jobs, table, Row, workers, console)
    return 1 if found is None else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
