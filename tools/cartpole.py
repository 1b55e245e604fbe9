"""The paper's first experiment: `python tools/cartpole.py` (figures and a table into out/cartpole).

Mode schedules, MPPI, CEM and predictive sampling swing a cartpole up at equal numbers of rolled-out control
steps; iLQR gives the local optimum that their costs are measured against.
"""

from __future__ import annotations

import csv
import hashlib
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import Progress  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc import Budget, Plan, Receding, Task, plan  # noqa: E402
from hmc.cfg import dump, load  # noqa: E402
from hmc.cli import one_line_errors  # noqa: E402
from hmc.ilqr import Optimum, ilqr  # noqa: E402
from hmc.sampling import METHODS, SamplingCfg, SamplingMpc  # noqa: E402
from hmc.sim.cartpole import CartpoleSim  # noqa: E402
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state  # noqa: E402
from tools import cartpole_figures  # noqa: E402

ONE, ZERO = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
PLANNERS = ("schedules", *METHODS)


@dataclass(frozen=True)
class SamplerCfg:
    """One of the baselines.

    Attributes:
        noise: standard deviation of a knot's noise, in units of the force limit.
        spacing: control steps from one knot to the next.
        samples: rollouts an update.
        elites: of cem.
        temperature: of mppi.
    """

    noise: float = 1.0
    spacing: int = 4
    samples: int = 50
    elites: int = 8
    temperature: float = 0.1


@dataclass(frozen=True)
class SchedulesCfg:
    """The search over mode schedules, see `hmc.plan`."""

    samples: int = 64
    order: str = "uniform"
    pairs: int = 0


@dataclass(frozen=True)
class LoopCfg:
    """Receding-horizon control: length of a run [control steps], and whole rollouts' worth of control
    steps that a planner may spend at each."""

    steps: int = 100
    rollouts: int = 50


@dataclass(frozen=True)
class StudyCfg:
    """cfg/cartpole.toml.

    Attributes:
        horizons: T, in control steps.
        seeds: of each planner.
        rollouts: budget of one solution: this many times T control steps.
        starts: random inputs that iLQR begins from, for each seed.
        num_modes: numbers of modes to compare, at the task's horizon.
        angles: start angles to compare, likewise [rad].
        task: the cartpole.
        loop: receding-horizon control.
        schedules, mppi, cem, ps: the planners.
    """

    horizons: tuple[int, ...] = (20, 50, 100)
    seeds: int = 5
    rollouts: int = 1000
    starts: int = 3
    num_modes: tuple[int, ...] = (3, 5, 9, 17)
    angles: tuple[float, ...] = (math.pi, math.pi / 2)
    task: CartpoleCfg = field(default_factory=CartpoleCfg)
    loop: LoopCfg = field(default_factory=LoopCfg)
    schedules: SchedulesCfg = field(default_factory=SchedulesCfg)
    mppi: SamplerCfg = field(default_factory=SamplerCfg)
    cem: SamplerCfg = field(default_factory=SamplerCfg)
    ps: SamplerCfg = field(default_factory=SamplerCfg)


@dataclass(frozen=True)
class Job:
    """One number of the study.

    Attributes:
        part: "solve" (one horizon, from the start) or "loop" (receding horizon).
        planner: one of PLANNERS, or "ilqr".
        horizon: T.
        seed: of everything random.
        num_modes: of the schedules.
        angle: at the start [rad].
    """

    part: str
    planner: str
    horizon: int
    seed: int
    num_modes: int
    angle: float


@dataclass(frozen=True)
class Row:
    """A line of results.csv: a job, and the J it came to with what it spent."""

    part: str
    planner: str
    horizon: int
    seed: int
    num_modes: int
    angle: float
    cost: float
    control_steps: int
    seconds: float

    @property
    def job(self) -> Job:
        """What it is the result of."""
        return Job(self.part, self.planner, self.horizon, self.seed, self.num_modes, self.angle)


def jobs(cfg: StudyCfg) -> list[Job]:
    """All of the study, the longest first."""
    modes, angle, seeds = cfg.task.num_modes, cfg.task.angle, range(cfg.seeds)
    found = [
        Job(part, planner, horizon, seed, modes, angle)
        for horizon in sorted(cfg.horizons, reverse=True)
        for part, planners in (("loop", PLANNERS), ("solve", (*PLANNERS, "ilqr")))
        for planner in planners
        for seed in seeds
    ]
    found += [Job("solve", "schedules", cfg.task.horizon, s, m, angle) for m in cfg.num_modes for s in seeds]
    found += [
        Job("solve", planner, cfg.task.horizon, seed, modes, angle)
        for angle in cfg.angles
        for planner in (*PLANNERS, "ilqr")
        for seed in seeds
    ]
    return list(dict.fromkeys(found))


def task_of(cfg: StudyCfg, job: Job) -> tuple[Task, Tensor]:
    """A job's cartpole and the state it begins in."""
    settings = replace(cfg.task, horizon=job.horizon, num_modes=job.num_modes, angle=job.angle)
    return cartpole(settings), initial_state(settings)


def sampler(cfg: SamplerCfg, method: str, task: Task, horizon: int, seed: int, rollouts: int) -> SamplingMpc:
    """A baseline that spends `rollouts` whole rollouts a re-plan."""
    settings = SamplingCfg(
        method=method,
        horizon=horizon,
        samples=cfg.samples,
        temperature=cfg.temperature,
        elites=cfg.elites,
        knots=max(2, round(horizon / cfg.spacing)),
        noise=cfg.noise,
        replan_every=1,
        iterations=max(1, rollouts // cfg.samples),
        worlds=cfg.samples,
    )
    return SamplingMpc(method, settings, task.make_sim, task.cost, -ONE, ONE, seed=seed)


def search(cfg: StudyCfg, job: Job) -> Plan:
    """The search over mode schedules, from the mode without force."""
    task, x = task_of(cfg, job)
    idle = [job.num_modes // 2] * job.horizon
    budget = Budget(control_steps=cfg.rollouts * job.horizon)
    return plan(task, x, schedule=idle, seed=job.seed, budget=budget, **asdict(cfg.schedules))


def optimum(cfg: StudyCfg, job: Job) -> Optimum:
    """The best of iLQR's local optima from random inputs."""
    task, x = task_of(cfg, job)
    sim = task.make_sim(1)
    assert isinstance(sim, CartpoleSim)
    generator = torch.Generator().manual_seed(job.seed)
    first = torch.empty(cfg.starts, job.horizon, 1, dtype=torch.float64).uniform_(-1, 1, generator=generator)
    found = [ilqr(sim.advance, task.cost, sim.dt, x, begin, -ONE, ONE) for begin in first]
    return min(found, key=lambda each: each.cost)


def solve(cfg: StudyCfg, job: Job) -> tuple[float, int]:
    """J of one horizon from the start, and the control steps it took."""
    if job.planner == "ilqr":
        return optimum(cfg, job).cost, 0
    if job.planner == "schedules":
        found = search(cfg, job)
        return found.cost, found.control_steps
    task, x = task_of(cfg, job)
    alone = sampler(getattr(cfg, job.planner), job.planner, task, job.horizon, job.seed, cfg.rollouts)
    solution = alone.solve(x, ZERO, cfg.rollouts * job.horizon)
    return solution.cost, solution.control_steps


def loop(cfg: StudyCfg, job: Job) -> tuple[float, int]:
    """Executed cost of a run under receding-horizon control, and the control steps rolled out."""
    task, x = task_of(cfg, job)
    world, cost, spent = task.make_sim(1), 0.0, 0
    world.reset(x[None], ZERO[None])
    if job.planner == "schedules":
        budget = Budget(control_steps=cfg.loop.rollouts * job.horizon)
        idle = [job.num_modes // 2] * job.horizon
        receding = Receding(task, schedule=idle, seed=job.seed, budget=budget, **asdict(cfg.schedules))
    else:
        settings = getattr(cfg, job.planner)
        mpc = sampler(settings, job.planner, task, job.horizon, job.seed, cfg.loop.rollouts)
        memory = mpc.reset(x[None], ZERO[None], torch.tensor([0]))
    for i in range(cfg.loop.steps):
        k, x, before = torch.tensor([i]), world.x(), world.u()
        if job.planner == "schedules":
            tick = receding.tick(x[0], before[0], world.save()[0])
            u, spent = tick.u[None], spent + tick.plan.control_steps
        else:
            u, memory = mpc.act(x, before, memory, k)
            spent = mpc.control_steps
        cost += float(task.cost.stage_terms(x, u, before, k).sum()) * world.dt
        world.step(u)
    return cost + float(task.cost.terminal_terms(world.x(), torch.tensor([cfg.loop.steps])).sum()), spent


def work(cfg: StudyCfg, job: Job) -> Row:
    """One job, on one core."""
    torch.set_num_threads(1)
    began = time.perf_counter()
    with torch.no_grad():
        cost, spent = (loop if job.part == "loop" else solve)(cfg, job)
    return Row(**asdict(job), cost=cost, control_steps=spent, seconds=time.perf_counter() - began)


def run_all(cfg: StudyCfg, todo: list[Job], processes: int, console: Console) -> Iterator[Row]:
    """Rows as they come, from a pool of processes."""
    context = multiprocessing.get_context("spawn")
    with Progress(console=console) as bar, ProcessPoolExecutor(processes, mp_context=context) as pool:
        shown = bar.add_task("the study", total=len(todo))
        waiting = {pool.submit(work, cfg, job) for job in todo}
        try:
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in ended:
                    bar.advance(shown)
                    yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def read(path: Path) -> list[Row]:
    """The rows of a results file."""
    with path.open(newline="", encoding="utf-8") as lines:
        kinds = {"str": str, "int": int, "float": float}
        return [
            Row(**{each.name: kinds[str(each.type)](line[each.name]) for each in fields(Row)})
            for line in csv.DictReader(lines)
        ]


def write(path: Path, rows: list[Row]) -> None:
    """A results file that is either whole or not there, in the order of the jobs."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [each.name for each in fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    os.replace(partial, path)


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        out: folder to write to; a study that was stopped goes on from what is there.
        processes: jobs that run at the same time, a core each; 0 for as many as there are cores.
        set: overrides of cfg/cartpole.toml, such as seeds=2.
    """

    out: Path = ROOT / "out" / "cartpole"
    processes: int = 0
    set: tuple[str, ...] = ()


def main(args: Args) -> int:
    """Run what is missing, write the table and the figures."""
    console = Console()
    with one_line_errors():
        cfg = load(ROOT / "cfg" / "cartpole.toml", StudyCfg, args.set)
        folder = args.out / hashlib.sha256(dump(cfg).encode()).hexdigest()[:12]
        folder.mkdir(parents=True, exist_ok=True)
    table = folder / "results.csv"
    rows = {row.job: row for row in read(table)} if table.exists() else {}
    every = jobs(cfg)
    todo = [job for job in every if job not in rows]
    try:
        for row in run_all(cfg, todo, args.processes or os.cpu_count() or 1, console):
            rows[row.job] = row
            write(table, [rows[job] for job in every if job in rows])
    except KeyboardInterrupt:
        console.print(f"stopped with {len(rows)} of {len(every)} done: the same command goes on from there")
        return 1
    cartpole_figures.gaps(args.out / "gap.png", list(rows.values()), cfg)
    job = Job("solve", "schedules", cfg.task.horizon, 0, cfg.task.num_modes, cfg.task.angle)
    cartpole_figures.sequence(args.out / "sequence.png", search(cfg, job), optimum(cfg, job), cfg)
    write(args.out / "results.csv", [rows[job] for job in every])
    console.print(cartpole_figures.table(list(rows.values()), cfg))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
