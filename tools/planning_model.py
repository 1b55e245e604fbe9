"""What a coarser planning model buys and costs: fewer physics steps, solver iterations or contacts.

`python tools/planning_model.py` compares the engine's speed on what a search rolls out, lets each model plan
flips of the robot, which stays as fine as it is, writes a table into out/planning_model, and goes on where it
was stopped.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc import Evaluator, Schedule, SwitchSpace, make_start  # noqa: E402
from hmc.cfg import override  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task, stance_cost, timeline  # noqa: E402
from hmc.sim.ids import Ids  # noqa: E402
from tools import study  # noqa: E402
from tools.closed_loop import RunCfg, disturbed_start, planned, policies, run, study_cfg  # noqa: E402

STAGES = ("foot_stand", "jump_flip", "handstand")


@dataclass(frozen=True)
class ModelCfg:
    """One planning model.

    Attributes:
        name: in the table.
        set: overrides of cfg/flip.toml that make it.
    """

    name: str
    set: tuple[str, ...] = ()


@dataclass(frozen=True)
class StudyCfg:
    """cfg/planning_model.toml.

    Attributes:
        trials: flips planned on each model.
        first_seed: of the first.
        worlds: schedules that speed is measured on.
        repeats: of that.
        base: overrides of cfg/flip.toml that always hold.
        models: that are compared; ratios are to the first of them.
        flip: cfg/flip.toml under `base`; by its cost all runs are judged.
    """

    trials: int = 20
    first_seed: int = 600
    worlds: int = 32
    repeats: int = 5
    base: tuple[str, ...] = ()
    models: tuple[ModelCfg, ...] = ()
    flip: RunCfg = field(default_factory=RunCfg)


@dataclass(frozen=True)
class Job:
    """One run: the model's name, and the seed of the start and of the draws."""

    model: str
    seed: int


@dataclass(frozen=True)
class Row:
    """What came of a run: its stages, its cost, and medians of the ticks' planning time [ms] and means of the
    control steps that they rolled out."""

    job: Job
    foot_stand: bool
    jump_flip: bool
    handstand: bool
    cost: float
    plan_ms: float
    control_steps: float

    @property
    def success(self) -> bool:
        """Whether all stages were reached."""
        return all(getattr(self, stage) for stage in STAGES)


def jobs(cfg: StudyCfg) -> list[Job]:
    """All of the study; a seed on all models before the next one, so that a study that is stopped is even."""
    return [Job(model.name, cfg.first_seed + i) for i in range(cfg.trials) for model in cfg.models]


def settings(cfg: StudyCfg, name: str) -> RunCfg:
    """Those of runs that are planned on a model."""
    model = next(each for each in cfg.models if each.name == name)
    return override(cfg.flip, model.set)


def work(cfg: StudyCfg, job: Job) -> Row:
    """One run, on one core."""
    torch.set_num_threads(1)
    flip = settings(cfg, job.model)
    task = flip_task(flip.task, seed=job.seed, threads=1)
    judge = stance_cost(cfg.flip.task.cost, timeline(flip.task.command))
    done = run(planned(flip, task, job.seed), judge, flip, job.seed)
    steps = float(np.mean([entry["control_steps"] for entry in done.log]))
    return Row(job, **vars(done.stages), cost=done.cost, plan_ms=float(np.median(done.plan_ms)),
               control_steps=steps)  # fmt: skip


Steps = list[tuple[Ids, Tensor, Tensor]]  # of each: which worlds, snapshots of them, inputs


@torch.no_grad()
def rolled_out(cfg: StudyCfg) -> Steps:
    """The control steps of some single switches of a flip, from a foot stand, on the first model."""
    flip = settings(cfg, cfg.models[0].name)
    task = replace(flip_task(flip.task, threads=1), rules=None)
    sim, horizon = task.make_sim(cfg.worlds), task.horizon
    x, u = disturbed_start(flip.start, cfg.first_seed)
    start = make_start(task, sim, x, u, k=flip.task.command - horizon // 2)
    flying = range(horizon // 3, horizon // 2)
    schedule = Schedule(tuple(1 if k in flying else 2 * (k >= horizon // 2) for k in range(horizon)))
    space = SwitchSpace(len(task.modes), horizon)
    at = torch.randperm(len(space), generator=torch.Generator().manual_seed(0))[: cfg.worlds]
    steps: Steps = []
    step = sim.step

    def keep(u: Tensor, ids: Ids = None) -> None:
        steps.append((ids, sim.save(ids), u.clone()))
        step(u, ids)

    sim.step = keep  # type: ignore[method-assign]
    Evaluator(task, sim, start).costs(space.stitch(schedule, at))
    return steps


def speeds(cfg: StudyCfg) -> dict[str, float]:
    """Control steps a second of each model's engine over those of the first one's, from the same states under
    the same inputs, one thread; they take turns at every step. The median over repeats, in processor time."""
    steps = rolled_out(cfg)
    sims = [flip_task(settings(cfg, each.name).task, threads=1).make_sim(cfg.worlds) for each in cfg.models]
    took = np.zeros((cfg.repeats + 1, len(sims)))  # the first one warms up
    for repeat in took:
        for turn, (ids, rows, u) in enumerate(steps):
            for at in np.roll(np.arange(len(sims)), turn):
                sims[at].load(rows, ids)
                began = time.process_time()
                sims[at].step(u, ids)
                repeat[at] += time.process_time() - began
    ratio = np.median(took[1:, :1] / took[1:], axis=0)
    return {model.name: float(each) for model, each in zip(cfg.models, ratio, strict=True)}


def table(cfg: StudyCfg, rows: list[Row], fast: dict[str, float]) -> Table:
    """A row a model; cost is of the flips that succeed."""
    view = Table(title="planning models")
    columns = ("engine's steps/s", "flips", "foot stand", "jump", "handstand", "cost", "control steps a tick",
               "plan p50 [ms]")  # fmt: skip
    for name in ("model", *columns):
        view.add_column(name, justify="left" if name == "model" else "right")
    for model in cfg.models:
        mine = [row for row in rows if row.job.model == model.name]
        good = [row.cost for row in mine if row.success]
        view.add_row(
            model.name,
            f"{fast[model.name]:.2f}",
            f"{len(good)} of {len(mine)}" if mine else "",
            *(str(sum(getattr(row, stage) for row in mine)) for stage in STAGES),
            f"{np.mean(good):.2f}" if good else "",
            f"{np.mean([row.control_steps for row in mine]):.1f}" if mine else "",
            f"{np.median([row.plan_ms for row in mine]):.0f}" if mine else "",
        )
    return view


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line. Planning times mean something only on cores that nothing else uses; ratios always do.

    Attributes:
        out: folder to write to; a study that was stopped goes on from what is there.
        set: overrides of cfg/planning_model.toml, such as trials=1.
    """

    out: Path = ROOT / "out" / "planning_model"
    set: tuple[str, ...] = ()


@study.stoppable
def main(args: Args) -> int:
    """Do what is left of the study, write everything."""
    with one_line_errors():
        cfg = study_cfg(ROOT / "cfg" / "planning_model.toml", StudyCfg, args.set)
        study.at_least_one(cfg, "trials", "worlds", "repeats")
        # what is wrong with a key shows here
        tasks = [settings(cfg, model.name).task for model in cfg.models]
        known = replace(cfg, trials=0)  # more trials come on top
        folder = study.folder_of(args.out, known, Row, args.resume, policies(*tasks))
    console = Console()
    measured = folder / "speed.json"
    if not measured.exists():
        with study.alone(folder), console.status("the engine's speed on each model"):
            study.write_json(measured, speeds(cfg))
    fast = json.loads(measured.read_text(encoding="utf-8"))
    rows = study.carry_out(partial(work, cfg), jobs(cfg), folder / "rows.csv", Row, args, console)
    if rows is None:
        return 1
    study.write(args.out / "planning_model.csv", rows)
    console.print(table(cfg, rows, fast))
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
