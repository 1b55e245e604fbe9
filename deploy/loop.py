"""The control process: frames of the wire through `Control`, with slots, log and clock around it.

A command leaves after every state frame, not every tick: one that is lost is made good within 2 ms, not 20,
and a robot that damps itself when it hears nothing hears enough. Between ticks it is the same frame.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.codec import FrameError, RobotState, decode_state
from deploy.control import Control
from deploy.dds import Link, LinkError, Subscriber
from deploy.log import COMMAND, PLAN, STATE, TICK, TICK_RECORD, Recorder
from deploy.messages import LowCmd_, LowState_
from deploy.modes import FOOT, HAND, NAMES, Plan
from deploy.motion_switcher import MotionSwitcher, MotionSwitcherError
from deploy.observe import pitch
from deploy.process import ROOT, Job, real_time, told, until_told
from deploy.safety import Phase
from deploy.settings import DeployCfg
from deploy.slots import Board, said, tally, text
from deploy.timing import Lateness, Silence
from hmc.cfg import load
from hmc.go2 import facts
from hmc.go2.network import Network

PRIORITY = 50
WAIT = 0.005  # s for a frame
HEARD = 3.0  # s for the first one
COMPANY = 0.4  # s for other controllers to be found
LAST = 0.3  # s of damping before a program that is told to end does
ROUND = 0.05  # s between two looks for other controllers, and words to the view at least
STRANGERS = 16  # publishers that are new to it, in such a look
LATE = 0.02  # s after the frames came: who commands only then looks at the watchdog once more
FOLDED = 0.6  # rad off the pose in which the robot lies, at most, where its own controller may be stopped
_PRESENCE = 1.0  # s without a word of a planner that waits
_SILENT = 3.0  # s without a plan, while modes run


class Refusal(RuntimeError):
    """The robot is not in a state to be started; says what to do."""


def preflight(link: Link, states: Subscriber, cfg: DeployCfg, release: bool, dry_run: bool = False) -> None:
    """See that the robot is there, alone, free and charged; in a dry run only that it is there.

    Raises:
        Refusal: it is not.
    """
    heard, told, until = 0, list[RobotState](), time.monotonic() + HEARD
    while not told and (left := until - time.monotonic()) > 0:
        frames = states.take(left)
        heard += len(frames)
        told = [state for frame in frames if (state := _whole(frame)) is not None]
        if heard and dry_run:
            return
    if not heard:
        why = (
            "something publishes rt/lowstate, but is silent: is the robot asleep?"
            if states.peers
            else "nobody publishes rt/lowstate: is the robot on and its cable in, and are the interface and "
            "the DDS domain right (0 on the robot's network, 1 on lo for the stand-in)?"
        )
        raise Refusal(f"no state frame within {HEARD:g} s; {why}")
    if not told:
        raise Refusal("no state frame has a right checksum: is this a Go2?")
    time.sleep(COMPANY)
    if others := link.rivals("rt/lowcmd"):
        raise Refusal(f"another program commands the motors: {', '.join(others)}: end it first")
    if (charge := told[-1].charge) < cfg.input.min_charge:
        raise Refusal(f"the battery has {charge} %, at least {cfg.input.min_charge} % is needed: charge it")
    try:
        switcher = MotionSwitcher(link)
        if (name := switcher.active()) and release:
            off = np.abs(told[-1].q - cfg.lie.joints)
            if not off.max() <= FOLDED:
                raise Refusal(
                    f"the robot does not lie: {facts.JOINTS[int(off.argmax())]} is {off.max():.1f} rad off "
                    "its folded place, and without its own controller the legs give way: lay it down first"
                )
            switcher.release()
        elif name:
            raise Refusal(f"the robot's own controller {name!r} runs: lay the robot down, then use --release")
    except MotionSwitcherError as error:
        raise Refusal(str(error)) from None


def _whole(frame: bytes) -> RobotState | None:
    """The state in a frame that came undamaged."""
    with suppress(FrameError):
        if (state := decode_state(frame)).crc_ok:
            return state
    return None


class Loop:
    """The control process's loop.

    Args:
        link: to the robot.
        states: of the robot.
        board: slots.
        control: what decides.
        recorder: of the log.
        dry_run: command nothing.
        speed: of the robot's clock.
    """

    def __init__(
        self,
        link: Link,
        states: Subscriber,
        board: Board,
        control: Control,
        recorder: Recorder,
        dry_run: bool,
        speed: float = 1.0,
    ):
        cfg = control.cfg.watchdog
        self._link, self._states, self._board = link, states, board
        self._control, self._recorder, self._dry_run = control, recorder, dry_run
        self._speed = speed
        self._commands = None if dry_run else link.publisher("rt/lowcmd", LowCmd_)
        self._lateness = Lateness()
        self._phase, self._hint, self._logged = Phase.PASSIVE, "", b""
        self._plans = 0  # number of the slot's value read last
        self._planned = 0.0  # when it was [s]
        self._quiet = ""  # that there are no plans any more
        self._company = 0.0  # when other controllers were looked for [s]
        self._shown = 0.0  # when the view was told [s]
        self._began = time.monotonic()
        self._silent = False
        self._guard = Silence(cfg.lost, cfg.stall, WAIT)  # of the watchdog
        self._commanding = False  # as far as the watchdog was told

    def turn(self) -> None:
        """Wait for state frames, command, tell the others."""
        control, board = self._control, self._board
        frames = self._states.take(WAIT)
        now = time.monotonic()
        self._listen(now)
        ticked = False
        for frame in frames:
            control.settle()  # the one before
            ticked = control.react(frame, now) or ticked
        if not frames:
            control.idle(now)
        sent = self._send(now)
        left = time.monotonic()
        control.settle()
        command = control.command
        if command != sent:  # it damps
            self._send(now)
        self._beat(left)
        for frame in frames:
            self._recorder.add(STATE, frame)
        if command is not None and command != self._logged:
            self._recorder.add(COMMAND, command)
            self._logged = command
        # what follows is never before a command, and one of it at a time
        if ticked:
            self._tell(now, left)
        elif board.plan.count != self._plans:
            self._planned = now
            self._take()
        elif now - self._company > ROUND and not self._dry_run:
            self._company = now
            self._look_around()
        changed = control.phase != self._phase or control.machine.hint != self._hint
        if ticked or changed or now - self._shown > ROUND:  # without state frames there are no ticks
            self._shown = now
            self._show(left)
        if changed:
            self._phase, self._hint = control.phase, control.machine.hint
            why = control.machine.reason or self._hint
            self._recorder.event("phase", phase=self._phase.name.lower(), k=control.k, reason=why)

    def _send(self, now: float) -> bytes | None:
        """Send the command, if there is one, for what came `now`; it."""
        late = time.monotonic() - now > LATE
        if late:  # this process stood still, and the watchdog may have taken over
            self._listen(time.monotonic())
        command = self._control.command
        if command is not None and self._commands is not None and not self._silent:
            if not self._commanding:  # the watchdog has to know before the robot does
                self._beat(now)
            self._commands.write(command)
        return command

    def _beat(self, t: float) -> None:
        """Tell the watchdog that this process lives."""
        control, heart = self._control, self._board.heart.blank()
        self._commanding = control.command is not None and not self._dry_run
        heart["t"], heart["commanding"] = t, self._commanding
        heart["latched"], heart["reason"] = control.phase == Phase.DAMPING, text(control.machine.reason)
        self._board.heart.write(heart)

    def _listen(self, now: float) -> None:
        """Read what the watchdog has to say, and whether a planner is there."""
        control, board = self._control, self._board
        guard = board.guard.read()
        if guard is not None and guard["latched"] and not self._silent:
            self._silent = True  # the watchdog damps the robot by now, and two must not command
            control.fail(said(guard["reason"].item()))
        if not self._dry_run:
            looked = 0.0 if guard is None else float(guard["t"])
            control.wait = "" if looked > 0 else "the watchdog has not started yet"
            if looked > 0 and looked != self._guard.heard:
                self._guard.hear(looked)
            if looked > 0 and self._guard.too_long(now):
                control.fail("the watchdog does not live any more")
        told = board.plan.read() if control.phase == Phase.READY else None
        control.planner = told is not None and now - float(told["t"]) < _PRESENCE

    def _look_around(self) -> None:
        """Fail where another program commands the motors as well."""
        guard = self._board.guard.read()
        ours = () if guard is None else (int(guard["pid"]),)
        if others := self._link.rivals("rt/lowcmd", ours, STRANGERS):
            self._control.fail(f"another program commands the motors: {others[0]}")

    def _take(self) -> None:
        """A plan has come."""
        self._plans = self._board.plan.count
        record = self._board.plan.read()
        if record is None or record["number"] <= 0:
            return
        try:
            plan = Plan.read(record)
        except ValueError as error:
            self._recorder.event("bad plan", reason=str(error))
            return
        self._control.performer.offer(plan)
        fields = {
            "number": plan.number,
            "base": plan.base,
            "begin": plan.begin,
            "k": self._control.k,
            "modes": "".join(str(mode) for mode in plan.modes),
            "cost": round(float(record["cost"]), 4),
            "seconds": round(float(record["seconds"]), 4),
        }
        self._recorder.add(PLAN, json.dumps(fields).encode())

    def _tell(self, now: float, left: float) -> None:
        """Tell planner and log of a tick."""
        control, performer = self._control, self._control.performer
        late = self._lateness.add(0.001 * control.due_ms / self._speed, left)
        quiet = control.phase == Phase.HYBRID and now - self._planned > _SILENT / self._speed
        if quiet != bool(self._quiet):
            self._quiet = "the planner is silent: the stance goes on; SELECT damps" if quiet else ""
            self._recorder.event("planner", silent=quiet, k=control.k)
        if control.phase == Phase.HYBRID:
            control.situation["t"] = now
            self._board.state.write(control.situation)
        estimate, plan, tick = control.estimate, performer.plan, np.zeros((), TICK)
        tick["k"], tick["ms"], tick["phase"], tick["mode"] = (
            control.k,
            control.checks.ms,
            control.phase,
            performer.mode,
        )
        tick["plan"], tick["late"], tick["compute"] = plan.number if plan else 0, late, 1e3 * (left - now)
        tick["due"], tick["left"] = control.due_ms, left
        tick["u"] = np.nan_to_num(control.target)
        tick["anew"] = round(1e3 * max(control.estimator.anew, -0.001))
        if estimate is not None:
            tick["x"], tick["variance"], tick["contact"] = estimate.x, estimate.P.diagonal(), estimate.contact
        self._recorder.add(TICK_RECORD, tick.tobytes())

    def _show(self, left: float) -> None:
        """Tell the view."""
        control, performer, status = self._control, self._control.performer, self._board.status.blank()
        estimate, plan = control.estimate, performer.plan
        status["t"], status["k"], status["phase"], status["mode"] = (
            left,
            control.k,
            control.phase,
            performer.mode,
        )
        status["plan_age"] = -1 if plan is None else control.k - plan.base
        status["ticks"], status["missed"], status["late"] = (
            len(self._lateness),
            control.missed,
            self._lateness.bins,
        )
        status["faults"] = tally({**control.checks.counts, "not logged": self._recorder.lost})
        status["plans"] = performer.counts["taken"]
        status["late_plans"] = performer.counts["late"] + performer.counts["stale"]
        status["charge"] = control.state.charge if control.state else 0
        status["reason"] = text(control.machine.reason or self._quiet or control.machine.hint)
        if estimate is not None:
            status["pitch"], status["height"] = np.degrees(pitch(estimate.C[2])), estimate.x[2]
        self._board.status.write(status)

    def end(self) -> None:
        """Damp the robot for a moment and say how it went; then the watchdog damps it."""
        control = self._control
        control.fail("the program was told to end")
        until = time.monotonic() + (LAST if control.command is not None else 0.0)
        while time.monotonic() < until:
            self.turn()
        self._recorder.event(
            "end",
            phase=control.phase.name.lower(),
            missed=control.missed,
            faults=dict(control.checks.counts),
            plans=dict(control.performer.counts),
            lost=self._recorder.lost,
        )


def policies(foot: str, hand: str) -> dict[int, Network]:
    """The policies of the modes that have one; ValueError if a file is not for this robot."""
    given = {FOOT: foot, HAND: hand}
    own = {mode: ROOT / "hmc" / "go2" / "policies" / f"{NAMES[mode]}stand.onnx" for mode in given}
    made = {mode: Network(Path(path) if path else own[mode]) for mode, path in given.items()}
    for mode, network in made.items():
        network.expect(f"{NAMES[mode]}stand")
    for network in made.values():  # the first inference takes several times as long as others: not in a tick
        network.run(np.zeros((1, facts.OBS_SIZE), np.float32))
    return made


def run(job: Job, stopped: Callable[[], bool]) -> None:
    """Control the robot until `stopped()`."""
    cfg = load(job.cfg, DeployCfg, job.set)
    slow = replace(cfg.input, max_age=cfg.input.max_age / job.speed, stall=cfg.input.stall / job.speed)
    cfg = replace(cfg, input=slow)
    control = Control(cfg, policies(job.foot, job.hand))
    quick = real_time(PRIORITY, job.real_time)
    link = Link(job.domain, job.interface)
    states = link.subscriber("rt/lowstate", LowState_)
    preflight(link, states, cfg, job.release, job.dry_run)
    loop = Loop(link, states, Board(job.board), control, Recorder(job.log), job.dry_run, job.speed)
    print(f"ready: {'real-time' if quick else 'normal'} priority", flush=True)
    states.take()  # those that came meanwhile are old
    while not stopped():
        loop.turn()
    loop.end()


def main(job: Job) -> int:
    """Be the control process until SIGTERM; exit status 2 and one line if the robot cannot be started."""
    stopped = until_told(job.parent)
    if job.core is not None:
        os.sched_setaffinity(0, {job.core})
    try:
        run(job, stopped)
    except (Refusal, LinkError, ValueError) as error:
        print(f"go2: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(told()))
