"""The harder test: `python tools/robustness.py` flips robots that are not the planner's model.

Other friction, masses, motors, gains and latency, wrong joint zeros, noisy estimates and pushes: all at once,
planned on the nominal model and on an ensemble, and each factor by itself. Results go into out/robustness.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib  # noqa: E402

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task  # noqa: E402
from tools import figures, study  # noqa: E402
from tools.closed_loop import policies, study_cfg  # noqa: E402
from tools.robustness_study import PLANNERS, RobustnessCfg, Row, jobs, work  # noqa: E402
from train.score import Score  # noqa: E402


def score(rows: list[Row]) -> Score:
    """Successes of some runs."""
    return Score(sum(row.success for row in rows), len(rows))


def summarise(rows: list[Row]) -> dict[str, Any]:
    """What summary.json holds."""
    found: dict[str, Any] = {"trials": 0}
    for planner in PLANNERS:
        mine = [row for row in rows if (row.job.planner, row.job.factor) == (planner, "all")]
        if mine:
            found["trials"] = len(mine)
            found[f"success_{planner}"] = score(mine).success
            found[f"interval_{planner}"] = score(mine).interval
            found[f"failures_{planner}"] = {str(row.job.seed): row.story for row in mine if not row.success}
    sweeps: dict[str, dict[str, list[int]]] = {}
    for factor, value in dict.fromkeys((row.job.factor, row.job.value) for row in rows):
        if factor != "all":
            some = [row for row in rows if (row.job.factor, row.job.value) == (factor, value)]
            sweeps.setdefault(factor, {})[f"{value:g}"] = [score(some).success, len(some)]
    return {**found, "sweeps": sweeps}


def draw(path: Path, sweeps: dict[str, dict[str, list[int]]]) -> None:
    """A panel a factor: successes against its value, with Wilson's intervals."""
    columns = 4
    lines = -(-len(sweeps) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(11, 2.4 * lines), sharey=True, constrained_layout=True
    )
    for axis in axes.flat[len(sweeps) :]:
        axis.set_visible(False)
    for axis, (factor, values) in zip(axes.flat, sweeps.items(), strict=False):
        scores = [Score(*counts) for counts in values.values()]
        at, rates = range(len(scores)), [each.rate for each in scores]
        off = [[abs(each.rate - each.interval[side]) for each in scores] for side in (0, 1)]
        axis.errorbar(at, rates, yerr=off, fmt="o", capsize=3, color="#4c9f70")
        axis.set_xticks(at, values.keys(), fontsize=8)
        axis.set_ylim(-0.05, 1.05)
        axis.set_title(factor, fontsize=9)
    figure.supylabel("share of flips that succeed", fontsize=9)
    figures.save(figure, path)


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line.

    Attributes:
        out: folder to write to; a test that was stopped goes on from what is there.
        set: overrides of cfg/robustness.toml, such as trials=10; with flip. before it, of cfg/flip.toml.
    """

    out: Path = ROOT / "out" / "robustness"
    set: tuple[str, ...] = ()


@study.stoppable
def main(args: Args) -> int:
    """Run what is missing; write summary, table and figure."""
    console = Console()
    with one_line_errors():
        cfg = study_cfg(ROOT / "cfg" / "robustness.toml", RobustnessCfg, args.set)
        flip_task(cfg.flip.task)  # what is wrong with a policy file shows here
        if not jobs(cfg):
            raise ValueError("trials and sweep_trials, or the sweeps, leave nothing to do: ask for some runs")
        files = policies(cfg.flip.task)
        table = study.folder_of(args.out, cfg, Row, args.resume, files) / "results.csv"
    rows = study.carry_out(partial(work, cfg), jobs(cfg), table, Row, args, console)
    if rows is None:
        return 1
    summary = summarise(rows)
    study.write(args.out / "results.csv", rows)
    study.write_json(args.out / "summary.json", summary)
    if summary["sweeps"]:
        draw(args.out / "sweeps.png", summary["sweeps"])
    view = Table("factor", "value", "success", title="flips of robots that are not the model")
    for planner in PLANNERS:
        if mine := [row for row in rows if (row.job.planner, row.job.factor) == (planner, "all")]:
            view.add_row("all at once", f"planned on the {planner}", str(score(mine)))
    for factor, values in summary["sweeps"].items():
        for value, counts in values.items():
            view.add_row(factor, value, str(Score(*counts)))
    console.print(view)
    for row in rows:
        if not row.success and row.job.factor == "all":
            console.print(f"{row.job.planner} seed {row.job.seed}: {row.story}", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
