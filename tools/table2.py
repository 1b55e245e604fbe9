"""The paper's Table II: every controller on the flip, `python tools/table2.py` (into out/table2).

Fixed sequences and thresholds are tuned on starts of their own first; then every controller runs the same
trials.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task, policy_path  # noqa: E402
from tools import study, table2_figures  # noqa: E402
from tools.closed_loop import policies, study_cfg  # noqa: E402
from tools.table2_study import (  # noqa: E402
    CONTROLLERS,
    Row,
    Rule,
    Table2Cfg,
    jobs,
    keep,
    orders,
    sequences,
    switches,
    told,
    tune,
    work,
)

COLUMNS = (
    *("controller", "foot stand", "jump flip", "handstand", "cost, mean", "spread"),
    *("control steps a tick", "time a tick [ms]"),
)


def tuned(cfg: Table2Cfg, path: Path, console: Console) -> dict[str, Rule]:
    """The rules of the controllers that have one; what was tuned once is kept in `path`."""
    found = {"untuned": Rule(0, cfg.untuned)}
    if path.exists():
        kept = json.loads(path.read_text(encoding="utf-8"))
        found |= {name: Rule(**values) for name, values in kept.items()}
    grids = (
        ("sequence", sequences(cfg), None),
        ("pitch", switches(cfg), None),
        ("ppo", orders(cfg), told(cfg)),
    )
    for name, rules, modes in grids:
        if name in found:
            continue
        with console.status(f"tuning: {CONTROLLERS[name]}, {len(rules)} rules"):
            found[name], cost = tune(cfg, rules, modes)
        console.print(f"{CONTROLLERS[name]}: {found[name]}, mean cost {cost:.2f}", highlight=False)
        study.write_json(path, {name: asdict(rule) for name, rule in found.items()})
    return found


def summarise(rows: list[Row]) -> dict[str, dict[str, Any]]:
    """Each controller's stage counts, costs and effort."""
    found = {}
    for name in dict.fromkeys(row.job.controller for row in rows):
        mine = [row for row in rows if row.job.controller == name]
        costs = [row.cost for row in mine]
        found[name] = {
            "trials": len(mine),
            "foot_stand": sum(row.foot_stand for row in mine),
            "jump_flip": sum(row.jump_flip for row in mine),
            "handstand": sum(row.handstand for row in mine),
            "cost_mean": float(np.mean(costs)),
            "cost_std": float(np.std(costs)),
            "costs": costs,
            "control_steps": float(np.mean([row.control_steps for row in mine])),
            "plan_ms": float(np.mean([row.plan_ms for row in mine])),
        }
    return found


def cells(name: str, values: dict[str, Any]) -> list[str]:
    """A controller's line of the table."""
    of = values["trials"]
    return [
        CONTROLLERS[name],
        *(f"{values[stage]} of {of}" for stage in ("foot_stand", "jump_flip", "handstand")),
        f"{values['cost_mean']:.2f}",
        f"{values['cost_std']:.2f}",
        f"{values['control_steps']:,.0f}",
        f"{values['plan_ms']:.0f}",
    ]


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line.

    Attributes:
        out: folder to write to; a study that was stopped goes on from what is there.
        set: overrides of cfg/table2.toml, such as trials=2; with flip. before it, of cfg/flip.toml.
    """

    out: Path = ROOT / "out" / "table2"
    set: tuple[str, ...] = ()


@study.stoppable
def main(args: Args) -> int:
    """Run what is missing; write tables and figures."""
    console = Console()
    with one_line_errors():
        cfg = study_cfg(ROOT / "cfg" / "table2.toml", Table2Cfg, args.set)
        flip_task(cfg.flip.task)  # what is wrong with a policy file shows here
        told(cfg)
        study.at_least_one(cfg, "trials")
        files = *policies(cfg.flip.task), policy_path("unified", cfg.unified)
        folder = study.folder_of(args.out, cfg, Row, args.resume, files)
    (folder / "runs").mkdir(exist_ok=True)
    with study.alone(folder):
        rules = tuned(cfg, folder / "rules.json", console)
    do, receive = partial(work, cfg, rules), partial(keep, folder / "runs")
    rows = study.carry_out(do, jobs(cfg), folder / "results.csv", Row, args, console, receive)
    if rows is None:
        return 1
    summary = summarise(rows)
    study.write_json(args.out / "table2.json", summary)
    study.write(args.out / "table2.csv", rows)
    view = Table(*COLUMNS, title=f"the flip, {cfg.trials} trials each")
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for name, values in summary.items():
        view.add_row(*cells(name, values))
        lines.append("| " + " | ".join(cells(name, values)) + " |")
    (args.out / "table2.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    table2_figures.draw(args.out, folder / "runs", cfg)
    console.print(view)
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
