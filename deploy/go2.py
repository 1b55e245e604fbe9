"""The Go2 under the planner: `python deploy/go2.py` on a stand-in, `--interface eth0` on the robot."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
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
from deploy.process import ENVIRONMENT, Job, allowed, share_cores, spawn  # noqa: E402
from deploy.safety import Phase  # noqa: E402
from deploy.settings import DeployCfg  # noqa: E402
from deploy.slots import Board  # noqa: E402
from deploy.timing import Stolen  # noqa: E402
from deploy.view import View  # noqa: E402
from deploy.watchdog import DAMPED  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402

LOOK = 0.05  # s
START_UP = 60.0  # s for a process to be ready
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
        set: overrides of cfg/deploy.toml, such as plan.lead=100.
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


class Ended(RuntimeError):
    """A process ended that should not have; its exit status."""

    def __init__(self, name: str, status: int):
        super().__init__(f"{name} ended with status {status}")
        self.status = status


@contextlib.contextmanager
def stand_in(args: Args, domain: int) -> Iterator[Port]:
    """The stand-in as a process, lying; its truth goes to truth.npz when it ends."""
    command = [sys.executable, "tools/go2_robot.py", "--domain", str(domain), "--parent", str(os.getpid())]
    command += ["--log", str((args.out / "truth.npz").absolute()), *args.stand_in]
    # a session of its own: Ctrl-C is ours to pass on, when the robot has been damped
    process = subprocess.Popen(
        command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        port = re.search(r"orders at UDP port (\d+)", _ready(process, "the stand-in"))
        assert port
        orders = Port(int(port[1]))
        yield orders
        orders.close()
    finally:
        _end(process)


def _ready(process: subprocess.Popen[str], name: str) -> str:
    """The line in which a process says that it is ready."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line.startswith("ready"):
        raise Ended(name, process.wait())
    return line


def _end(process: subprocess.Popen[str], wait: float = 10.0) -> None:
    process.terminate()
    try:
        process.wait(wait)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


def _end_all(processes: list[subprocess.Popen[str]]) -> None:
    for process in processes:
        _end(process)


def _stay_damped(board: Board) -> None:
    """Give the watchdog its time, if anything was commanded; no Ctrl-C cuts it short."""
    heart = board.heart.read()
    if heart is not None and heart["commanding"]:
        before = {number: signal.signal(number, signal.SIG_IGN) for number in ENDING}
        time.sleep(DAMPED)
        for number, handler in before.items():
            signal.signal(number, handler)


def run(args: Args, console: Console, port: Port | None) -> Memory:
    """Start all processes, show the run until it is over, end them so that the robot stays damped.

    On a robot that is damped, or whose control process has ended, it is over when the operator says so.

    Returns:
        What memory they took.
    """
    board, (source, sink) = Board(), pipe()
    job = args.job()
    base = {**vars(job), "board": board.descriptor}
    with contextlib.ExitStack() as stack:
        stack.callback(board.close)
        stack.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        base["core"], others = share_cores()
        os.sched_setaffinity(0, others)  # of the view, and of all who are started until they ask for more
        log = spawn("log", Job(**{**base, "log": source, "path": str(args.out / "run.mcap")}), [source])
        stack.callback(log.wait)  # it ends when the control process has
        os.close(source)
        watch: list[subprocess.Popen[str]] = []
        stack.callback(_end_all, watch)
        stack.callback(_stay_damped, board)
        planners: list[subprocess.Popen[str]] = []
        stack.callback(_end_all, planners)
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE}
        control = spawn("loop", Job(**{**base, "log": sink}), [board.descriptor, sink], **pipes)
        os.close(sink)
        if args.awake and base["core"] is not None and args.real_time and allowed():
            stack.callback(_end, spawn("awake", Job(**base), []))
        stack.callback(_end, control)  # before all others, whose end takes its time
        console.print(f"control process: {_ready(control, 'the control process').strip()}", highlight=False)
        if not args.dry_run:
            watch.append(spawn("watchdog", Job(**{**base, "pid": control.pid}), [board.descriptor]))
        planner = spawn("planner", Job(**base), [board.descriptor])
        planners.append(planner)
        operator: Presser | None = None
        if port is not None:
            operator = Keyboard(port) if args.keys else Operator(port, args.hold)
            stack.callback(operator.close)
        if args.keys:
            console.print(HELP, highlight=False)
        pids = {"control": control.pid, "planner": planner.pid, "log": log.pid}
        if watch:
            pids["watchdog"] = watch[0].pid
        memory = Memory(pids)
        follow(board, control, planner, operator, stack.enter_context(View(console)), memory)
        if operator is None and not args.dry_run:
            console.print("the control process has ended, the watchdog damps the robot: Ctrl-C ends it")
            signal.pause()
        return memory


def follow(
    board: Board,
    control: subprocess.Popen[str],
    planner: subprocess.Popen[str],
    operator: Presser | None,
    view: View,
    memory: Memory,
) -> None:
    """Show the status until the control process ends, or the operator in simulation says that it is over.

    Raises:
        Ended: the planner could not start. A robot that moves already is left to its operator.
    """
    phase = Phase.PASSIVE
    while control.poll() is None:
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
        if operator is not None and operator.see(status):
            return


def main(args: Args) -> int:
    """Run, summarise, return the exit status: 0 for all stages, 1 for fewer, 2 where it could not start."""
    console = Console()
    with one_line_errors():
        load(args.job().cfg, DeployCfg, args.set)
        policies(args.foot, args.hand)
        _ = args.stand_in  # what is wrong with it, said before anything is started
        if not 0 < args.speed <= 1 or (args.speed != 1 and not args.simulated):
            raise ValueError(
                f"speed is above 0 and at most 1 on the stand-in, 1 on a robot; got {args.speed:g}"
            )
        if args.keys and not (args.simulated and sys.stdin.isatty()):
            raise ValueError(
                "--keys needs the stand-in and a terminal: on a robot, the operator has the remote"
            )
        args.out.mkdir(parents=True, exist_ok=True)
        for name in ("run.mcap", "truth.npz", "summary.json"):
            (args.out / name).unlink(missing_ok=True)
    truth = args.out / "truth.npz" if args.simulated else None
    memory, stolen = Memory({}), Stolen()
    for number in ENDING:
        signal.signal(number, signal.default_int_handler)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            if args.simulated:
                with stand_in(args, args.job().domain) as port:
                    memory = run(args, console, port)
            else:
                memory = run(args, console, None)
    except Ended as ended:
        if ended.status < 0:  # else the process has said itself what was wrong
            print(f"error: {ended}: a signal, or no memory was left", file=sys.stderr)
        return 2 if ended.status == 2 else 1
    from deploy.summary import summarise, write  # loads torch: seconds that the start need not wait for

    with one_line_errors():
        summary = {**summarise(args.out / "run.mcap", truth), "memory_mb": memory.found}
        summary["stolen"] = share if (share := stolen.share) is None else round(share, 4)
    write(args.out / "summary.json", summary)
    console.print_json(data=summary)
    reached = summary["stages_true"] if args.simulated else summary["stages"]
    return 0 if reached and reached["success"] else 1


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
