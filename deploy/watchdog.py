"""The watchdog's process: damps the robot when the control process dies or hangs, and does not stop."""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Callable

import numpy as np

from deploy.codec import FOC, JOINTS, MotorCommand, encode_command
from deploy.dds import Link, Publisher
from deploy.messages import LowCmd_
from deploy.process import Job, real_time, told, until_told
from deploy.settings import DeployCfg, WatchdogCfg
from deploy.slots import Board, text
from hmc.cfg import load

PRIORITY = 60


def damping(gain: float) -> bytes:
    """The LowCmd frame that resists motion with this gain [N m s/rad]."""
    zero = np.zeros(JOINTS)
    return encode_command(MotorCommand(zero, zero, zero, zero, np.full(JOINTS, gain), np.full(JOINTS, FOC)))


class Watchdog:
    """Looks at the control process, and latches.

    Silence is counted in looks: when the whole machine stood still, the watchdog with it, the control process
    gets the time to beat that it has otherwise, up to `stall`.

    Attributes:
        reason: why the robot is damped; "" while it is not.

    Args:
        board: slots.
        cfg: times.
    """

    def __init__(self, board: Board, cfg: WatchdogCfg):
        self.reason = ""
        self._board, self._cfg = board, cfg
        self._beat = self._looked = -math.inf  # time of the last heartbeat and look [s]
        self._silent = 0.0  # since that heartbeat, as far as it was looked [s]

    def look(self, gone: bool, now: float) -> bool:
        """Whether the robot is to be damped.

        Args:
            gone: whether the control process has ended.
            now: [s].
        """
        heart = self._board.heart.read()
        # a control process that has commanded nothing yet leaves the robot as it is
        if not self.reason and heart is not None and heart["commanding"]:
            age = now - float(heart["t"])
            if heart["t"] != self._beat:
                self._beat, self._silent = float(heart["t"]), 0.0
            self._silent += min(age - self._silent, now - self._looked, 2 * self._cfg.period)
            if gone:
                self.reason = "the control process ended"
            elif self._silent > self._cfg.hang or age > self._cfg.stall:
                self.reason = f"the control process hung for {1e3 * age:.0f} ms"
        self._looked = now
        guard = self._board.guard.blank()
        guard["t"], guard["pid"] = now, os.getpid()
        guard["latched"], guard["reason"] = bool(self.reason), text(self.reason)
        self._board.guard.write(guard)
        return bool(self.reason)


def watch(
    watchdog: Watchdog,
    pid: int,
    publisher: Publisher,
    frame: bytes,
    period: float,
    stopped: Callable[[], bool],
) -> None:
    """Watch the process of this number until `stopped()`; publish the frame from the latch on."""
    descriptor = os.pidfd_open(pid)
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    gone = False
    while not stopped():
        if gone:
            time.sleep(period)
        else:
            gone = bool(poll.poll(1e3 * period))
        if watchdog.look(gone, time.monotonic()):
            publisher.write(frame)
    os.close(descriptor)


def main(job: Job) -> None:
    """Be the watchdog until SIGTERM."""
    stopped = until_told()
    cfg = load(job.cfg, DeployCfg, job.set)
    real_time(PRIORITY)
    publisher = Link(job.domain, job.interface).publisher("rt/lowcmd", LowCmd_)
    watchdog = Watchdog(Board(job.board), cfg.watchdog)
    watch(watchdog, job.pid, publisher, damping(cfg.output.damping), cfg.watchdog.period, stopped)


if __name__ == "__main__":
    main(told())
