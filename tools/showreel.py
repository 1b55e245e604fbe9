"""All modes of the Go2 in one closed loop: from lying on its side to a handstand, over a course of goals."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc import Receding, Task  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2 import model as go2  # noqa: E402
from hmc.go2.conditions import Robots  # noqa: E402
from hmc.go2.course import CourseCfg, GoalCfg, course_task  # noqa: E402
from hmc.go2.observe import pitch  # noqa: E402
from hmc.go2.stances import HOLDS  # noqa: E402
from hmc.receding import SearchCfg  # noqa: E402
from tools import figures, render  # noqa: E402
from tools.closed_loop import MODEL, RunCfg, study_cfg  # noqa: E402
from tools.pool import ENDS, kill_is_ctrl_c, why  # noqa: E402
from tools.study import Workers, can_write, run_all, seeds_of, write_json  # noqa: E402

ARRIVED = 0.3  # m: so near to its place a robot is there
HOLD = 0.5  # s that a goal is held without a break, to be reached; the last one, at the end of its time
DOWN = 0.5  # s on the ground, where it should not be, and the course begins anew
FRAMES = 14  # of the strip of a run
SETTLE = 1.0  # s in which the robot that is laid on its side comes to rest


@dataclass(frozen=True)
class ReelCfg:
    """cfg/showreel.toml.

    Attributes:
        seconds: after which a run is given up [s].
        mpc: whether the jump improves its guess on the way by sampling MPC.
        task: the course.
        search: effort at each control step.
        flip: cfg/flip.toml, whose jump it is.
    """

    seconds: float = 60.0
    mpc: bool = False
    task: CourseCfg = field(default_factory=CourseCfg)
    search: SearchCfg = field(default_factory=SearchCfg)
    flip: RunCfg = field(default_factory=RunCfg)

    def __post_init__(self) -> None:
        if self.seconds <= 0:
            raise ValueError(f"seconds must be more than 0, got {self.seconds:g}")

    def make_task(self, seed: int = 0) -> Task:
        """The course, on one core."""
        jump = replace(self.flip.task.jump, mpc=self.mpc)
        return course_task(self.task, jump, seed=seed, threads=1)


@dataclass
class Reel:
    """One seed's run.

    Attributes:
        seed: of the start and the draws.
        log: one record a control step.
        success: whether every goal was reached in one go, the last one held to its end.
        tries: how often the course was begun.
        furthest: goals reached in the best of them.
    """

    seed: int
    log: list[dict[str, Any]]
    success: bool
    tries: int
    furthest: int


class Course:
    """Where the robot is on the course: a goal that is missed, or a fall, and it begins anew.

    Attributes:
        k: control step of the course.
        tries: how often it was begun.
        done: goals reached in this try.
        furthest: in the best one.
    """

    def __init__(self, cfg: CourseCfg):
        self.goals, self.ends = cfg.goals, cfg.ends()
        self.k, self.tries, self.done, self.furthest = 0, 1, 0, 0
        self._down = self._held = 0
        self._reached = False

    @property
    def goal(self) -> GoalCfg:
        """What is asked for now."""
        return self.goals[min(self.done, len(self.goals) - 1)]

    @property
    def finished(self) -> bool:
        """Whether all goals are reached."""
        return self.done == len(self.goals)

    def advance(self, x: Tensor) -> bool:
        """Count a control step that ended in state x (37,); whether the course begins anew."""
        self.k += 1
        lies = bool(go2.clearances(x[None])["trunk"][0] < 0.01)
        self._down = self._down + 1 if lies and self.done > 0 else 0
        self._held = self._held + 1 if self._holds(x) else 0
        # what comes next may begin before the time is over; the last goal is there to stay
        last = self.done == len(self.goals) - 1
        self._reached = self._held * go2.DT >= HOLD or (self._reached and not last)
        if self._down * go2.DT < DOWN:
            if self.k < self.ends[self.done]:
                return False
            if self._reached:
                self.done, self._held, self._reached = self.done + 1, 0, False
                self.furthest = max(self.furthest, self.done)
                return False
        self.k, self.done, self._down, self._held, self._reached = 0, 0, 0, 0, False
        self.tries += 1
        return True

    def _holds(self, x: Tensor) -> bool:
        place = torch.tensor(self.goal.at or x[:2].tolist(), dtype=x.dtype)
        return bool(HOLDS[self.goal.hold].held(x[None])[0]) and float((x[:2] - place).norm()) < ARRIVED


def laid_down(seed: int) -> tuple[Tensor, Tensor]:
    """A robot laid on a side, from where some roll onto their back: state (37,) and last input (12,)."""
    generator = torch.Generator().manual_seed(seed)
    left, roll, yaw, *joints = (2 * torch.rand(15, generator=generator, dtype=torch.float64) - 1).tolist()
    x = torch.zeros(37, dtype=torch.float64)
    half = 0.5 * math.copysign(math.pi / 2 - 0.2 + 0.1 * roll, left)
    rolled = torch.tensor([[math.cos(half), math.sin(half), 0.0, 0.0]], dtype=torch.float64)
    turned = torch.tensor([[math.cos(math.pi / 2 * yaw), 0.0, 0.0, math.sin(math.pi / 2 * yaw)]]).double()
    x[3:7] = go2.product(turned, rolled)[0]
    x[7:19] = (go2.HOME + 0.2 * torch.tensor(joints)).clamp(go2.Q_LOWER, go2.Q_UPPER)
    x[2] = 0.01 - go2.lowest(x[None])[0]
    u = x[7:19].clone()
    robot = Robots(MODEL, x[None], u[None], seed=seed)
    for _ in range(round(SETTLE / go2.DT)):
        robot.step(u[None])
    return robot.x[0], u


@torch.no_grad()
def reel(cfg: ReelCfg, seed: int) -> Reel:
    """One closed loop over the course, on one core."""
    torch.set_num_threads(1)
    task = cfg.make_task(seed)
    loop = Receding(task, seed=seed, schedule=["getup"] * task.horizon, **cfg.search.options())
    x, u = laid_down(seed)
    robot = Robots(MODEL, x[None], u[None], seed=seed)
    course = Course(cfg.task)
    log: list[dict[str, Any]] = []
    while not course.finished and len(log) * go2.DT < cfg.seconds:
        x, u = robot.x[0], robot.u[0]
        began = time.perf_counter()
        tick = loop.tick(x, u, robot.sim.save()[0])
        log.append(
            {
                "time": len(log) * go2.DT,
                "mode": task.modes.names[tick.mode],
                "goal": course.done,
                "try": course.tries,
                "cost": tick.plan.cost,
                "schedule": str(tick.plan.schedule),
                "plan_ms": 1e3 * (time.perf_counter() - began),
                "x": [round(v, 6) for v in x.tolist()],
            }
        )
        robot.step(tick.u[None])
        if course.advance(robot.x[0]):
            loop.rewind(course.k)
    return Reel(seed, log, course.finished, course.tries, course.furthest)


def write_reel(out: Path, done: Reel, cfg: ReelCfg, video: bool, console: Console) -> None:
    """One run's log, figure and video into `out`."""
    log = out / f"seed_{done.seed}.json"
    write_json(log, {"seed": done.seed, "success": done.success, "tries": done.tries, "steps": done.log})
    x = torch.tensor([entry["x"] for entry in done.log])
    goals = [cfg.task.goals[min(entry["goal"], len(cfg.task.goals) - 1)].hold for entry in done.log]
    changes = [i for i in range(1, len(goals)) if done.log[i]["goal"] != done.log[i - 1]["goal"]]
    figures.timeline(
        out / f"seed_{done.seed}_timeline.png",
        [entry["mode"] for entry in done.log],
        pitch(x).numpy(),
        x[:, 2].numpy(),
        [i * go2.DT for i in changes],
        go2.DT,
        f"seed {done.seed}: {'all goals' if done.success else f'{done.furthest} goals'}, {done.tries} tries",
    )
    if video and (reason := render.render_run(render.Args(log, frames=FRAMES))):
        console.print(reason)


def summarise(runs: list[Reel]) -> dict[str, Any]:
    """What summary.json holds."""
    times = np.concatenate([[entry["plan_ms"] for entry in run.log] for run in runs])
    return {
        "seeds": len(runs),
        "success": sum(run.success for run in runs),
        "tries": {run.seed: run.tries for run in runs},
        "furthest": {run.seed: run.furthest for run in runs},
        "seconds": {run.seed: round(len(run.log) * go2.DT, 2) for run in runs},
        "plan_ms_p50": float(np.percentile(times, 50)),
        "plan_ms_p99": float(np.percentile(times, 99)),
    }


def table(runs: list[Reel], goals: int) -> Table:
    """A row a seed."""
    view = Table(title="the course")
    for name in ("seed", "all goals", "tries", "goals reached", "time [s]"):
        view.add_column(name, justify="right")
    for run in runs:
        sign = "[green]yes[/]" if run.success else "[red]no[/]"
        seconds = f"{len(run.log) * go2.DT:.1f}"
        view.add_row(str(run.seed), sign, str(run.tries), f"{run.furthest} of {goals}", seconds)
    return view


@dataclass(frozen=True)
class Args(Workers):
    """Command line.

    Attributes:
        seeds: number of runs.
        first_seed: seed of the first.
        out: folder to write to.
        video: render a video of each run, if OpenGL is there.
        set: overrides of cfg/showreel.toml, such as search.draws=8.
    """

    seeds: int = 10
    first_seed: int = 0
    out: Path = ROOT / "out" / "showreel"
    video: bool = True
    set: tuple[str, ...] = ()


def main(args: Args) -> int:
    """Run all seeds, write everything, return the exit status."""
    with one_line_errors():
        seeds = seeds_of(args)
        cfg = study_cfg(ROOT / "cfg" / "showreel.toml", ReelCfg, args.set)
        cfg.make_task()  # what is wrong with a policy file shows here
        can_write(args.out / "summary.json")
    console = Console()
    runs: list[Reel] = []
    try:
        with kill_is_ctrl_c():
            for done in run_all(partial(reel, cfg), seeds, args, console):
                with one_line_errors():  # such as of a full disk
                    write_reel(args.out, done, cfg, args.video, console)
                runs.append(done)
    except ENDS as end:
        console.print(f"{why(end)} with {len(runs)} of {len(seeds)} runs done")
    runs.sort(key=lambda done: done.seed)
    if not runs:
        return 1
    summary = summarise(runs)
    write_json(args.out / "summary.json", summary)
    console.print(table(runs, len(cfg.task.goals)))
    return 0 if summary["success"] else 1


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
