"""The stand-in as a process: DDS, the motion switcher, orders, a clock and a log around `StandIn`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deploy.dds import LOOPBACK, SIMULATION_DOMAIN, Link, LinkError
from deploy.messages import LowCmd_, LowState_, WirelessController_
from deploy.motion_switcher import MotionSwitcherService
from deploy.process import real_time, share_cores
from tools.robot.orders import Desk, obey
from tools.robot.standin import PERIOD, Settings, StandIn, Truth

CONTROLLER = "mcf"  # what the motion switcher calls the robot's own controller
PRIORITY = 40
COMPANY = 0.3  # s that other robots get to be found
LATEST = 0.05  # s behind the clock, at most; then the robot loses time instead of hurrying after it


@dataclass(frozen=True)
class Args:
    """A Go2 that is not there, on the robot's own topics.

    Attributes:
        robot: the robot.
        domain: of DDS.
        interface: network interface.
        port: UDP port of this machine for orders, see `tools.robot.orders`; 0 for any free one.
        order: orders at the start, JSON objects.
        log: file for the truth, .npz; none is written without.
        seconds: of simulated time, then it ends.
        speed: of its clock: 0.5 takes 2 s for one of its own, where the machine is too slow for more.
        lockstep: wait for a command after every state instead of keeping time: for tests that repeat.
        parent: number of the process that started it and without which it ends; 0 for none.
    """

    robot: Settings = field(default_factory=Settings)
    domain: int = SIMULATION_DOMAIN
    interface: str = LOOPBACK
    port: int = 0
    order: tuple[str, ...] = ()
    log: Path | None = None
    seconds: float = float("inf")
    speed: float = 1.0
    lockstep: bool = False
    parent: int = 0

    def __post_init__(self) -> None:
        if not 0.001 <= self.speed <= 1000:
            raise ValueError(f"speed of the clock must be 0.001 to 1000, got {self.speed}")
        if not 0 <= self.port < 2**16:
            raise ValueError(f"port for orders must be 0 to {2**16 - 1}, got {self.port}")
        if not self.seconds >= 0:
            raise ValueError(f"seconds of simulated time must be 0 or more, got {self.seconds}")


TRUTH = np.dtype(
    [
        ("tick", np.uint32),
        ("qpos", np.float64, 19),
        ("qvel", np.float64, 18),
        ("torque", np.float64, 12),
        ("foot_force", np.float64, 4),
        ("released", np.bool_),
        ("accepted", np.int64),
        ("refused", np.int64),
        # when its state frame left, but for delays and faults, by this machine's monotonic clock [s]
        ("left", np.float64),
    ]
)


class Log:
    """The truth, step by step, in memory until it is written: 0.2 MB a second.

    It lies in few large blocks. As an object a step, half an hour of it is millions of them, and the clock
    misses its steps whenever the garbage collector walks over all of them.
    """

    BLOCK = 4096  # steps

    def __init__(self, path: Path | None):
        self._path = path
        self._blocks: list[NDArray[Any]] = []
        self._steps = 0

    def add(self, truth: Truth, left: float) -> None:
        """Keep a step, whose state frame left then [s]."""
        if self._path is None:
            return
        at = self._steps % self.BLOCK
        if at == 0:
            self._blocks.append(np.zeros(self.BLOCK, TRUTH))
        self._blocks[-1][at] = (*truth, left)
        self._steps += 1

    def write(self) -> None:
        """Write the file: an array (steps, ...) for each field of TRUTH."""
        if self._path is not None and self._steps:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            steps = np.concatenate(self._blocks)[: self._steps]
            columns: dict[str, Any] = {name: steps[name] for name in TRUTH.names or ()}
            stem = self._path.name.removesuffix(".npz")
            part = self._path.with_name(f"{stem}.part.npz")  # until it is whole
            try:
                np.savez(part, **columns)  # compressed, half an hour takes longer than anybody waits for it
                part.replace(self._path.with_name(f"{stem}.npz"))
            finally:
                part.unlink(missing_ok=True)


def run(args: Args, stopped: Callable[[], bool], say: Callable[[str], None]) -> None:
    """Be the robot until `stopped()` or the time is over.

    Args:
        args: what robot, where.
        stopped: asked at every step.
        say: told when the robot is ready, and in the end how it kept time.

    Raises:
        LinkError: the network interface cannot be used, or a robot is there already.
        ValueError: an order is none.
        RuntimeError: the simulated robot diverged; the log is written first.
    """
    link = Link(args.domain, args.interface)
    robot = StandIn(args.robot)
    for order in args.order:
        obey(robot, order)
    _refuse_company(link, args)
    commands, states = link.subscriber("rt/lowcmd", LowCmd_), link.publisher("rt/lowstate", LowState_)
    remote = link.publisher("rt/wirelesscontroller", WirelessController_)
    switcher = MotionSwitcherService(link, "" if robot.released else CONTROLLER)
    desk, log = Desk(args.port), Log(args.log)
    try:
        outgoing, truth = robot.step([]), robot.truth()
        where = f"domain {args.domain} on {args.interface}, orders at UDP port {desk.port}"
        say(f"ready: {where}, {priority()}")
        clock = Clock(PERIOD / args.speed)
        while robot.time < args.seconds and not stopped():
            if not args.lockstep:
                clock.wait()
            left = time.monotonic()
            for frame in outgoing:  # measured now, and worked out before: a robot's clock waits for nothing
                states.write(frame)
            switcher.serve()
            robot.release(switcher.name == "")
            desk.serve(robot)
            if args.lockstep:
                frames = commands.take(0.1)
                if not frames:  # nobody there yet, or a frame was lost: say it again
                    continue
            else:
                frames = commands.take()
            log.add(truth, left)
            outgoing, truth = robot.step(frames), robot.truth()
            if truth.tick % 20 == 0:
                remote.write(_pressed(robot).serialize(use_version_2=False))
    finally:  # what led to a robot's divergence is what the truth is wanted for
        desk.close()
        log.write()
    say(f"ended after {robot.time:.3f} s; {clock.report()}; refused commands: {dict(robot.refused)}")


def _refuse_company(link: Link, args: Args) -> None:
    """A controller must not hear two robots, least of all a real one and this."""
    time.sleep(COMPANY)
    if others := link.rivals("rt/lowstate"):
        raise LinkError(
            f"there is a robot in domain {args.domain} on {args.interface} already: {', '.join(others)}. "
            "End it (one that was killed counts for 3 s more), or take another --domain."
        )


def _pressed(robot: StandIn) -> WirelessController_:
    lx, ly, rx, ry = robot.remote[1:]
    return WirelessController_(lx, ly, rx, ry, int(robot.remote.buttons))


def priority() -> str:
    """Ask the kernel for real-time priority, and say what came of it.

    With it, the stand-in stays off the control process's core, in which a robot has no part either. Without
    it, it takes what is free.
    """
    if real_time(PRIORITY):
        os.sched_setaffinity(0, share_cores()[1])
        return "real-time priority"
    return "normal priority (real-time needs CAP_SYS_NICE)"


class Clock:
    """Keeps a period [s], and counts how late it was."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._next = time.monotonic()
        self._late: list[float] = []

    def wait(self) -> None:
        """Until the next step is due."""
        self._next += self._period
        now = time.monotonic()
        if now < self._next:
            time.sleep(self._next - now)
            now = time.monotonic()
        late = now - self._next
        self._late.append(late)
        if late > LATEST:
            self._next = now

    def report(self) -> str:
        """Lateness of the steps."""
        if not self._late:
            return "not timed"
        p50, p99, worst = 1e3 * np.quantile(self._late, [0.5, 0.99, 1.0])
        lost = sum(late > LATEST for late in self._late)
        return f"late by {p50:.2f} / {p99:.2f} / {worst:.2f} ms (half, 99 %, worst), time lost {lost} times"
