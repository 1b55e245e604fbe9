"""In which order to draw switches: `python tools/orders.py` compares them on the cartpole and on the flip.

Every order may spend the same control steps: the cartpole those of cfg/cartpole.toml, for one horizon and in
the receding loop, the flip as many a tick as cfg/orders.toml says. A table goes into out/orders, and a study
that was stopped goes on from what is there.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task  # noqa: E402
from hmc.solvers import ORDERS  # noqa: E402
from tools import cartpole_study, study  # noqa: E402
from tools.closed_loop import RunCfg, planned, policies, run, split, study_cfg  # noqa: E402

PARTS = {"solve": "cartpole, one horizon", "loop": "cartpole, receding", "flip": "flip"}


@dataclass(frozen=True)
class OrdersCfg:
    """cfg/orders.toml.

    Attributes:
        seeds: of each order on each system.
        horizons: of the cartpole.
        first_flip: seed of the first flip.
        control_steps: that a tick of the flip may roll out, however many draws that is.
        base: overrides of cfg/flip.toml.
        flip: that under `base`.
        cartpole: cfg/cartpole.toml.
    """

    seeds: int = 5
    horizons: tuple[int, ...] = (40, 70, 100)
    first_flip: int = 700
    control_steps: int = 60
    base: tuple[str, ...] = ()
    flip: RunCfg = field(default_factory=RunCfg)
    cartpole: cartpole_study.StudyCfg = field(default_factory=cartpole_study.StudyCfg)

    def __post_init__(self) -> None:
        study.at_least_one(self, "control_steps")
        if min(self.horizons, default=1) < 1:
            raise ValueError(f"horizons must be at least 1 control step, got {self.horizons}")
        if self.first_flip < 0:
            raise ValueError(f"first_flip must be at least 0, got {self.first_flip}")


@dataclass(frozen=True)
class Job:
    """One run: a key of PARTS, the horizon, the order, the seed."""

    part: str
    horizon: int
    order: str
    seed: int


@dataclass(frozen=True)
class Row:
    """What came of it: J or the executed cost, control steps rolled out, whether a flip succeeded."""

    job: Job
    cost: float
    control_steps: float
    success: bool


def settings(items: tuple[str, ...]) -> OrdersCfg:
    """Of the files, with overrides."""
    own, pole = split(items, "cartpole.")
    cfg = study_cfg(ROOT / "cfg" / "orders.toml", OrdersCfg, own)
    return replace(cfg, cartpole=load(ROOT / "cfg" / "cartpole.toml", cartpole_study.StudyCfg, pole))


def jobs(cfg: OrdersCfg) -> list[Job]:
    """All of the study."""
    kinds = [(part, horizon) for horizon in cfg.horizons for part in ("solve", "loop")]
    kinds.append(("flip", cfg.flip.task.horizon))
    return [
        Job(part, horizon, order, seed)
        for seed in range(cfg.seeds)
        for part, horizon in kinds
        for order in ORDERS
    ]


def work(cfg: OrdersCfg, job: Job) -> Row:
    """One run, on one core."""
    torch.set_num_threads(1)
    if job.part == "flip":
        search = replace(cfg.flip.search, order=job.order, draws=10**6, control_steps=cfg.control_steps)
        flip, seed = replace(cfg.flip, search=search), cfg.first_flip + job.seed
        task = flip_task(flip.task, seed=seed, threads=1)
        done = run(planned(flip, task, seed), task.cost, flip, seed)
        steps = float(np.mean([entry["control_steps"] for entry in done.log]))
        return Row(job, done.cost, steps, done.stages.success)
    own = replace(cfg.cartpole, schedules=replace(cfg.cartpole.schedules, order=job.order))
    like = own.task
    row = cartpole_study.work(
        own, cartpole_study.Job(job.part, "schedules", job.horizon, job.seed, like.num_modes, like.angle)
    )
    return Row(job, row.cost, row.control_steps, True)


def table(rows: list[Row]) -> Table:
    """A row a system: mean and standard deviation of the cost in each order; of those flips that succeed."""
    view = Table(title="orders of the draws")
    for name in ("", "T", *ORDERS, "control steps"):
        view.add_column(name, justify="right" if name else "left")
    for part, horizon in dict.fromkeys((row.job.part, row.job.horizon) for row in rows):
        cells, steps = [], []
        for order in ORDERS:
            mine = [
                row
                for row in rows
                if (row.job.part, row.job.horizon, row.job.order) == (part, horizon, order)
            ]
            costs = [row.cost for row in mine if row.success] or [math.nan]
            share = f"{sum(row.success for row in mine)} of {len(mine)}: " if part == "flip" else ""
            cells.append(f"{share}{np.mean(costs):.2f} ± {np.std(costs):.2f}")
            steps.append(f"{np.mean([row.control_steps for row in mine] or [math.nan]):,.0f}")
        view.add_row(PARTS[part], str(horizon), *cells, ", ".join(steps))
    return view


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line.

    Attributes:
        out: folder to write to; a study that was stopped goes on from what is there.
        set: overrides of cfg/orders.toml, such as seeds=1; with flip. or cartpole. before it, of these files.
    """

    out: Path = ROOT / "out" / "orders"
    set: tuple[str, ...] = ()


@study.stoppable
def main(args: Args) -> int:
    """Do what is left of the study, write everything."""
    with one_line_errors():
        cfg = settings(args.set)
        study.at_least_one(cfg, "seeds")
        known = replace(cfg, seeds=0)  # more of them come on top
        folder = study.folder_of(args.out, known, Row, args.resume, policies(cfg.flip.task))
    console = Console()
    rows = study.carry_out(partial(work, cfg), jobs(cfg), folder / "rows.csv", Row, args, console)
    if rows is None:
        return 1
    study.write(args.out / "orders.csv", rows)
    console.print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
