"""How the flip's cost and success grow with the horizon, the draws, the time a tick and the number of modes.

`python tools/growth.py` writes a table and a figure into out/growth, and goes on where it was stopped.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib  # noqa: E402

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc.cfg import override  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task, stance_cost, timeline  # noqa: E402
from tools import figures, study  # noqa: E402
from tools.closed_loop import RunCfg, planned, policies, run, study_cfg  # noqa: E402

IDLE = ("stand", "getup", "home", "crouch")  # in the order in which modes without use come in


@dataclass(frozen=True)
class FactorCfg:
    """One thing that is changed.

    Attributes:
        name: in the table.
        label: of the figure's axis.
        key: of cfg/flip.toml; of task.idle the value is how many modes there are, 3 or more.
        values: that it takes.
        set: further overrides that hold with it.
    """

    name: str
    label: str
    key: str
    values: tuple[float, ...]
    set: tuple[str, ...] = ()


@dataclass(frozen=True)
class GrowthCfg:
    """cfg/growth.toml.

    Attributes:
        trials: runs at each value.
        first_seed: of the first.
        base: overrides of cfg/flip.toml that always hold.
        factors: what is changed, one at a time.
        flip: cfg/flip.toml under `base`; by its cost all runs are judged.
    """

    trials: int = 5
    first_seed: int = 300
    base: tuple[str, ...] = ()
    factors: tuple[FactorCfg, ...] = ()
    flip: RunCfg = field(default_factory=RunCfg)


@dataclass(frozen=True)
class Job:
    """One run: what is changed, to what, and the seed of the start and of the draws."""

    factor: str
    value: float
    seed: int


@dataclass(frozen=True)
class Row:
    """What came of a run; times in ms, p95 of the ticks; coverage is the mean over the ticks."""

    job: Job
    success: bool
    cost: float
    plan_ms: float
    plan_ms_p95: float
    control_steps: float
    coverage: float


def jobs(cfg: GrowthCfg) -> list[Job]:
    """All of the study."""
    seeds = range(cfg.first_seed, cfg.first_seed + cfg.trials)
    return [
        Job(factor.name, value, seed) for factor in cfg.factors for value in factor.values for seed in seeds
    ]


def settings(cfg: GrowthCfg, job: Job) -> RunCfg:
    """Those of a run."""
    factor = next(each for each in cfg.factors if each.name == job.factor)
    if factor.key == "task.idle":
        item = f"task.idle={json.dumps(IDLE[: round(job.value) - 3])}"
    else:
        item = f"{factor.key}={job.value:g}"
    return override(cfg.flip, (*factor.set, item))


def work(cfg: GrowthCfg, job: Job) -> Row:
    """One run, on one core."""
    torch.set_num_threads(1)
    flip = settings(cfg, job)
    task = flip_task(flip.task, seed=job.seed, threads=1)
    judge = stance_cost(cfg.flip.task.cost, timeline(flip.task.command))
    done = run(planned(flip, task, job.seed), judge, flip, job.seed)
    return Row(
        job,
        done.stages.success,
        done.cost,
        float(done.plan_ms.mean()),
        float(np.percentile(done.plan_ms, 95)),
        sum(entry["control_steps"] for entry in done.log) / len(done.log),
        float(np.mean([entry["coverage"] for entry in done.log])),
    )


def points(cfg: GrowthCfg, rows: list[Row]) -> dict[str, list[dict[str, float]]]:
    """Of each factor, means at its values; cost and its spread are of the successful runs."""
    found: dict[str, list[dict[str, float]]] = {}
    for factor in cfg.factors:
        for value in factor.values:
            mine = [row for row in rows if (row.job.factor, row.job.value) == (factor.name, value)]
            good = [row.cost for row in mine if row.success]
            point = {
                "value": value,
                "success": float(sum(row.success for row in mine)),
                "runs": float(len(mine)),
                "cost": float(np.mean(good)) if good else float("nan"),
                "spread": float(np.std(good)) if good else float("nan"),
            }
            for name in ("plan_ms", "plan_ms_p95", "control_steps", "coverage"):
                point[name] = float(np.mean([getattr(row, name) for row in mine]))
            found.setdefault(factor.name, []).append(point)
    return found


def table(found: dict[str, list[dict[str, float]]]) -> Table:
    """A row a value."""
    view = Table(title="growth")
    columns = ("value", "success", "cost", "plan [ms]", "p95 [ms]", "control steps a tick", "coverage")
    for name in ("factor", *columns):
        view.add_column(name, justify="left" if name == "factor" else "right")
    for factor, values in found.items():
        for point in values:
            view.add_row(
                factor,
                f"{point['value']:g}",
                f"{point['success']:.0f} of {point['runs']:.0f}",
                f"{point['cost']:.2f}",
                f"{point['plan_ms']:.0f}",
                f"{point['plan_ms_p95']:.0f}",
                f"{point['control_steps']:.0f}",
                f"{point['coverage']:.2%}",
            )
    return view


def draw(path: Path, cfg: GrowthCfg, found: dict[str, list[dict[str, float]]]) -> None:
    """A panel a factor: share of successes (bars), cost of the successful runs (line)."""
    figure, axes = plt.subplots(
        1, len(cfg.factors), figsize=(3.4 * len(cfg.factors), 3.0), constrained_layout=True, squeeze=False
    )
    for axis, factor in zip(axes[0], cfg.factors, strict=True):
        values = found[factor.name]
        at = range(len(values))
        axis.bar(at, [point["success"] / point["runs"] for point in values], color="#4c9f70", alpha=0.45)
        axis.set_xticks(at, [f"{point['value']:g}" for point in values], fontsize=8)
        axis.set_ylim(0, 1.05)
        axis.set_xlabel(factor.label, fontsize=8)
        cost = axis.twinx()
        cost.errorbar(
            at,
            [point["cost"] for point in values],
            [point["spread"] for point in values],
            color="black",
            marker="o",
            markersize=3,
            linewidth=1,
        )
        cost.set_ylim(0, 5)
    axes[0][0].set_ylabel("success (bars)")
    cost.set_ylabel("executed cost (line)")
    figures.save(figure, path)


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line. Times a tick mean something only on cores that nothing else uses.

    Attributes:
        out: folder to write to; a study that was stopped goes on from what is there.
        set: overrides of cfg/growth.toml, such as trials=1.
    """

    out: Path = ROOT / "out" / "growth"
    set: tuple[str, ...] = ()


@study.stoppable
def main(args: Args) -> int:
    """Do what is left of the study, write everything."""
    with one_line_errors():
        cfg = study_cfg(ROOT / "cfg" / "growth.toml", GrowthCfg, args.set)
        study.at_least_one(cfg, "trials")
        tasks = [settings(cfg, job).task for job in jobs(cfg)]  # what is wrong with a key shows here
        folder = study.folder_of(args.out, cfg, Row, args.resume, policies(*tasks))
    console = Console()
    rows = study.carry_out(partial(work, cfg), jobs(cfg), folder / "rows.csv", Row, args, console)
    if rows is None:
        return 1
    found = points(cfg, rows)
    study.write_json(args.out / "growth.json", found)
    draw(args.out / "growth.png", cfg, found)
    console.print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
