"""The Go2 under the planner: `python deploy/go2.py` on a stand-in, `--interface eth0` on the robot."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # not this folder, whose modules are deploy's

from rich.console import Console  # noqa: E402

from deploy.buttons import HELP, HOLD, Keyboard, Operator, Port, Presser  # noqa: E402
from deploy.dds import LOOPBACK, ROBOT_DOMAIN, SIMULATION_DOMAIN  # noqa: E402
from deploy.log import pipe  # noqa: E402
from deploy.loop import policies  # noqa: E402
from deploy.memory import Memory  # noqa: E402
from deploy.process import ENVIRONMENT, Ended, Job, allowed, end, ready, share_cores, spawn  # noqa: E402
from deploy.safety import Phase  # noqa: E402
from deploy.settings import DeployCfg  # noqa: E402
from deploy.slots import Board  # noqa: E402
from deploy.timing import Stolen  # noqa: E402
from deploy.view import View  # noqa: E402
from deploy.watchdog import DAMPED  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402

LOOK = 0.05  # s
# what ends a run: a lost terminal, too
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


@dataclass(frozen=True)
class Args:
    """Foot stand, flip, handstand. Without arguments: on a stand-in for the robot, which is started beside.

    On a robot, the operator has the remote: START goes on to the next phase, SELECT lies down or damps,
    L2 and B damp at once. docs/deploy.md has the checklist.

    Attributes:
        interface: the robot's network interface; lo is the stand-in's.
        domain: of DDS; default: 0 on a robot, 1 on lo.
        dry_run: compute and log, but never command.
        release: let the robot's own controller be stopped; its legs give way: lay it down before.
        out: folder for the log and the summary.
        seed: of the stand-in and of the planner's draws.
        robot: settings of the stand-in, see tools/go2_robot.py, such as state-delay=0.002 states.drop=0.01.
        foot: policy file of the foot stand; default: the one that comes with the package.
        hand: policy file of the handstand, likewise.
        set: overrides of cfg/deploy.toml, such as plan.expires=50.
        task_set: overrides of the task in cfg/flip.toml, after those of cfg/planner.toml, such as substeps=2.
        search: overrides of cfg/planner.toml, such as search.draws=16.
        threads: of the planner's engine; 0 for one a core that the planner may use.
        hold: of the foot stand before the handstand is asked for, on the stand-in [s].
        keys: the keyboard has the remote's buttons, and pushes; on the stand-in only.
        speed: of the stand-in's clock, for slow motion where the machine is busy; 1 on a robot.
        real_time: ask the kernel for real-time priority.
        awake: keep the control process's core from halting between state frames, which takes power; with
            real-time priority only.
    """

    interface: str = LOOPBACK
    domain: int | None = None
    dry_run: bool = False
    release: bool = False
    out: Path = ROOT / "out" / "deploy"
    seed: int = 0
    robot: tuple[str, ...] = ()
    foot: str = ""
    hand: str = ""
    set: tuple[str, ...] = ()
    task_set: tuple[str, ...] = ()
    search: tuple[str, ...] = ()
    threads: int = 0
    hold: float = HOLD
    keys: bool = False
    speed: float = 1.0
    real_time: bool = True
    awake: bool = True

    @property
    def simulated(self) -> bool:
        """Whether the robot is the stand-in."""
        return self.interface == LOOPBACK

    @property
    def stand_in(self) -> list[str]:
        """What tools/go2_robot.py is told; ValueError for settings without a value."""
        told = ["--speed", str(self.speed), "--robot.start", "lying", "--robot.seed", str(self.seed)]
        for setting in self.robot:
            name, equals, value = setting.partition("=")
            if not equals:
                raise ValueError(f"--robot takes settings such as state-delay=0.002, got {setting!r}")
            told += [f"--robot.{name}", value]
        return told

    def job(self) -> Job:
        """What every process is told."""
        domain = (
            self.domain if self.domain is not None else SIMULATION_DOMAIN if self.simulated else ROBOT_DOMAIN
        )
        return Job(
            domain=domain,
            interface=self.interface,
            set=self.set,
            dry_run=self.dry_run,
            release=self.release or self.simulated,
            foot=self.foot,
            hand=self.hand,
            task_set=self.task_set,
            search=self.search,
            seed=self.seed,
            threads=self.threads,
            speed=self.speed,
            real_time=self.real_time,
        )


@contextlib.contextmanager
def once() -> Iterator[None]:
    """What ends a run does so once: a key that is pressed again after this cuts nothing of its end short."""
    try:
        yield
    finally:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """What ends a run waits until what is started here is known to those who end it."""
    came: list[int] = []
    before = {number: signal.signal(number, lambda it, _: came.append(it)) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


@contextlib.contextmanager
def reserved(folder: Path) -> Iterator[None]:
    """A folder for this run alone, with nothing of an earlier one.

    Raises:
        ValueError: another run writes there.
        OSError: this one cannot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"another run writes to {folder}: end it, or take another --out") from None
        for name in ("run.mcap", "truth.npz", "truth.part.npz", "summary.json"):
            (folder / name).unlink(missing_ok=True)
        (folder / "run.mcap").touch()  # what cannot be written there is said before the robot moves
        yield
    finally:
        os.close(held)


@contextlib.contextmanager
def stand_in(args: Args, domain: int) -> Iterator[tuple[Port, subprocess.Popen[str]]]:
    """The stand-in as a process, lying, and its port; its truth goes to truth.npz when it ends."""
    command = [sys.executable, "tools/go2_robot.py", "--domain", str(domain), "--parent", str(os.getpid())]
    command += ["--log", str((args.out / "truth.npz").absolute()), *args.stand_in]
    # a session of its own: Ctrl-C is ours to pass on, when the robot has been damped
    process = subprocess.Popen(
        command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        port = re.search(r"orders at UDP port (\d+)", ready(process, "the stand-in"))
        assert port
        orders = Port(int(port[1]))
        yield orders, process
        orders.close()
    finally:
        end(process)


def _end_all(processes: list[subprocess.Popen[str]]) -> None:
    for process in processes:
        end(process)


def _stay_damped(board: Board) -> None:
    """Give the watchdog its time, if anything was commanded."""
    heart = board.heart.read()
    if heart is not None and heart["commanding"]:
        time.sleep(DAMPED)


def run(
    args: Args,
    console: Console,
    memory: Memory,
    port: Port | None = None,
    robot: subprocess.Popen[str] | None = None,
) -> None:
    """Start all processes, show the run until it is over, end them so that the robot stays damped.

    On a robot that is damped, or whose control process has ended, it is over when the operator says so.

    Args:
        args: command line.
        console: to say what happens.
        memory: told of the processes.
        port: of the stand-in.
        robot: the stand-in.
    """
    board, (source, drain) = Board(), pipe()
    sink = os.fdopen(drain, "wb", buffering=0)  # may be closed twice
    base = {**vars(args.job()), "board": board.descriptor}
    with contextlib.ExitStack() as stack, once():
        stack.callback(board.close)
        stack.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        base["core"], others = share_cores()
        os.sched_setaffinity(0, others)  # of the view, and of all who are started until they ask for more
        watch: list[subprocess.Popen[str]] = []
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE}
        with undisturbed():
            log = spawn("log", Job(**{**base, "log": source, "path": str(args.out / "run.mcap")}), [source])
            os.close(source)
            stack.callback(log.wait)  # it ends when nobody has the other end of the pipe
            stack.callback(sink.close)
            stack.callback(_end_all, watch)
            stack.callback(_stay_damped, board)
            planner = spawn("planner", Job(**base), [board.descriptor], **pipes)
            stack.callback(end, planner)
        if robot is None:  # before its own controller is stopped, what is wrong with the settings is said
            ready(planner, "the planner")
        with undisturbed():
            if args.awake and base["core"] is not None and args.real_time and allowed():
                stack.callback(end, spawn("awake", Job(**base), []))
            job = Job(**{**base, "log": sink.fileno()})
            control = spawn("loop", job, [board.descriptor, sink.fileno()], **pipes)
            stack.callback(end, control)  # before all others, whose end takes its time
            sink.close()
        console.print(f"control process: {ready(control, 'the control process').strip()}", highlight=False)
        if not args.dry_run:
            with undisturbed():
                watch.append(spawn("watchdog", Job(**{**base, "pid": control.pid}), [board.descriptor]))
        operator: Presser | None = None
        if port is not None:
            operator = Keyboard(port) if args.keys else Operator(port, args.hold)
            stack.callback(operator.close)
        if args.keys:
            console.print(HELP, highlight=False)
        pids = {"control": control.pid, "planner": planner.pid, "log": log.pid}
        if watch:
            pids["watchdog"] = watch[0].pid
        memory.begin(pids)
        with View(console) as view:
            follow(board, (control, robot or control), planner, watch, operator, view, memory)
        heart = board.heart.read()
        if operator is None and heart is not None and heart["commanding"]:
            console.print("the control process has ended, the watchdog damps the robot: Ctrl-C ends it")
            signal.pause()


def follow(
    board: Board,
    needed: Sequence[subprocess.Popen[str]],
    planner: subprocess.Popen[str],
    watch: Sequence[subprocess.Popen[str]],
    operator: Presser | None,
    view: View,
    memory: Memory,
) -> None:
    """Show the status until a process that is needed ends, or the operator in simulation has seen enough.

    Raises:
        Ended: planner or watchdog could not start. A robot that moves already is left to its operator.
    """
    phase = Phase.PASSIVE
    while all(process.poll() is None for process in needed):
        time.sleep(LOOK)
        memory.look()
        status = board.status.read()
        if status is None:
            continue
        view.show(status)
        phase = max(phase, Phase(int(status["phase"])))
        waits = phase == Phase.PASSIVE if operator is None else phase < Phase.HYBRID
        if waits and planner.poll():
            raise Ended("the planner", planner.returncode)
        for watchdog in watch:
            if phase == Phase.PASSIVE and watchdog.poll() is not None:
                raise Ended("the watchdog", watchdog.returncode)
        if operator is not None and operator.see(status):
            return


def checked(args: Args) -> None:
    """Refuse what can be seen to be wrong before anything is started.

    Raises:
        ValueError: a setting, a policy's file, or options that do not go together.
    """
    load(args.job().cfg, DeployCfg, args.set)
    policies(args.foot, args.hand)
    _ = args.stand_in
    if not 0 < args.speed <= 1 or (args.speed != 1 and not args.simulated):
        raise ValueError(f"speed is above 0 and at most 1 on the stand-in, 1 on a robot; got {args.speed:g}")
    if args.keys and not (args.simulated and sys.stdin.isatty()):
        raise ValueError("--keys needs the stand-in and a terminal: on a robot, the operator has the remote")


def main(args: Args) -> int:
    """Run, summarise, return the exit status: 0 for all stages, 1 for fewer, 2 where it could not start."""
    with contextlib.ExitStack() as stack:
        with one_line_errors():
            checked(args)
            stack.enter_context(reserved(args.out))
        return perform(args)


def perform(args: Args) -> int:
    """As `main`, of arguments that are checked."""
    console, memory, stolen = Console(), Memory(), Stolen()
    robot: subprocess.Popen[str] | None = None
    for number in ENDING:
        signal.signal(number, signal.default_int_handler)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            if args.simulated:
                with stand_in(args, args.job().domain) as (port, robot):
                    run(args, console, memory, port, robot)
            else:
                run(args, console, memory)
    except Ended as ended:
        if ended.status != 2:  # else the process has said itself what was wrong
            print(f"error: {ended}", file=sys.stderr)
        return 2 if ended.status == 2 else 1
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    lost = robot is not None and robot.returncode != 0
    if robot is not None and lost:
        print(f"error: the stand-in ended with status {robot.returncode} in the middle", file=sys.stderr)
    from deploy.summary import summarise, write  # loads torch: seconds that the start need not wait for

    with one_line_errors():
        truth = args.out / "truth.npz"
        summary = {
            **summarise(args.out / "run.mcap", truth if truth.exists() else None),
            "memory_mb": memory.found,
            "stolen": share if (share := stolen.share) is None else round(share, 4),
        }
        console.print_json(data=summary)
        write(args.out / "summary.json", summary)
    reached = summary["stages_true"] if args.simulated else summary["stages"]
    return 0 if reached and reached["success"] and not lost else 1


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
