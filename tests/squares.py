"""A study that costs nothing, for tests: in a module that workers can import."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path


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
