"""The watchdog's process: damps the robot when the control process dies or hangs, and does not stop.

When the program that started it is killed, it stays for a while: the control process is told to end then,
too, and a robot that falls has to be damped until it lies.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from deploy.codec import FOC, JOINTS, MotorCommand, encode_command
from deploy.dds import Link, LinkError, Publisher
from deploy.messages import LowCmd_
from deploy.process import Job, real_time, told, until_told
from deploy.settings import DeployCfg, WatchdogCfg
from deploy.slots import Board, text
from deploy.timing import Silence
from hmc.cfg import load

PRIORITY = 60
DAMPED = 3.0  # s of damping after the control process: a robot on two legs falls meanwhile
_FLAGS, _EXITING = 5, 0x4  # field after the process's state; PF_EXITING of Linux


def damping(gain: float) -> bytes:
    """The LowCmd frame that resists motion with this gain [N m s/rad]."""
    zero = np.zeros(JOINTS)
    return encode_command(MotorCommand(zero, zero, zero, zero, np.full(JOINTS, gain), np.full(JOINTS, FOC)))


class Process:
    """Another process of this machine, which is not a child.

    A descriptor of it (pidfd_open(2)) tells its end only when all that it had has been given back: 15 ms
    after it was killed, where memory is locked. The kernel's account of it says at once that it is exiting.

    Args:
        pid: its number.
    """

    def __init__(self, pid: int):
        self._stat: int | None = None  # of a process that is gone by now
        with suppress(FileNotFoundError):
            self._stat = os.open(f"/proc/{pid}/stat", os.O_RDONLY)

    @property
    def ends(self) -> bool:
        """Whether it is on its way out, or gone; see proc_pid_stat(5)."""
        if self._stat is None:
            return True
        try:
            stat = os.pread(self._stat, 1024, 0)
        except ProcessLookupError:
            return True
        state, *fields = stat[stat.rindex(b")") + 2 :].split()  # what is before may hold anything
        return state in b"ZX" or bool(int(fields[_FLAGS]) & _EXITING)

    def close(self) -> None:
        """Give the descriptor back."""
        if self._stat is not None:
            os.close(self._stat)


class Watchdog:
    """Looks at the control process, and latches.

    Attributes:
        reason: why the robot is damped; "" while it is not.
        needed: whether the control process commands, so that somebody has to watch it.

    Args:
        board: slots.
        cfg: times.
    """

    def __init__(self, board: Board, cfg: WatchdogCfg):
        self.reason, self.needed = "", False
        self._board = board
        self._silence = Silence(cfg.hang, cfg.stall, 2 * cfg.period)
        self._say(0.0)  # whose publisher it is that others are going to see

    def look(self, gone: bool, now: float) -> bool:
        """Whether the robot is to be damped.

        Args:
            gone: whether the control process has ended.
            now: [s].
        """
        heart = self._board.heart.read()
        # a control process that has commanded nothing yet leaves the robot as it is
        if heart is not None:
            self.needed = bool(heart["commanding"])
        if not self.reason and heart is not None and self.needed:
            if heart["t"] != self._silence.heard:
                self._silence.hear(float(heart["t"]))
            if gone:
                self.reason = "the control process ended"
            elif self._silence.too_long(now):
                self.reason = f"the control process hung for {1e3 * (now - self._silence.heard):.0f} ms"
        self._say(now)
        return bool(self.reason)

    def _say(self, now: float) -> None:
        """Tell the control process that it looks, and what it has found."""
        guard = self._board.guard.blank()
        guard["t"], guard["pid"] = now, os.getpid()
        guard["latched"], guard["reason"] = bool(self.reason), text(self.reason)
        self._board.guard.write(guard)


def watch(
    watchdog: Watchdog,
    pid: int,
    publisher: Publisher,
    frame: bytes,
    period: float,
    stopped: Callable[[], bool],
    after: float,
    parent: int,
) -> None:
    """Watch the process of this number; publish the frame from the latch on.

    When `stopped()`, it ends, but not while it is needed, nor before the robot was damped for DAMPED seconds:
    whoever ends a group of processes tells this one and the control process at once. It ends `after` seconds
    after it has lost the process `parent` that started it, or has latched since.
    """
    now = time.monotonic()
    orphaned, damped = now if os.getppid() != parent else math.inf, math.inf
    it, gone = Process(pid), False
    while not (stopped() and (now - damped > DAMPED if watchdog.reason else not watchdog.needed)):
        time.sleep(period)
        gone = gone or it.ends
        now, latched = time.monotonic(), bool(watchdog.reason)
        if watchdog.look(gone, now):
            publisher.write(frame)
            damped = min(damped, now)
        if os.getppid() != parent and (orphaned == math.inf or bool(watchdog.reason) != latched):
            orphaned = now
        if now - orphaned > after:
            break
    it.close()


def main(job: Job) -> int:
    """Be the watchdog until SIGTERM, see `watch`; exit status 2 and one line if it cannot reach the robot."""
    stopped = until_told()
    cfg = load(job.cfg, DeployCfg, job.set)
    watchdog = Watchdog(Board(job.board), cfg.watchdog)
    try:
        publisher = Link(job.domain, job.interface).publisher("rt/lowcmd", LowCmd_)
    except LinkError as error:
        print(f"watchdog: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    if job.core is not None:  # nor does it wait for a planner where the control process leaves its core alone
        os.sched_setaffinity(0, {*os.sched_getaffinity(0), job.core})
    real_time(PRIORITY, job.real_time)  # now only: making a link takes 70 ms of a core
    period, after = cfg.watchdog.period, cfg.watchdog.after
    watch(watchdog, job.pid, publisher, damping(cfg.output.damping), period, stopped, after, job.parent)
    return 0


if __name__ == "__main__":
    sys.exit(main(told()))
