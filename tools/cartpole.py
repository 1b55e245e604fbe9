"""The paper's first experiment: `python tools/cartpole.py` (figures and a table into out/cartpole).

Mode schedules, MPPI, CEM and predictive sampling swing a cartpole up at equal numbers of rolled-out control
steps; iLQR gives the local optimum that their costs are measured against.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from rich.console import Console  # noqa: E402

from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from tools import cartpole_figures, study  # noqa: E402
from tools.cartpole_study import Job, Row, StudyCfg, jobs, optimum, search, work  # noqa: E402


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line.

    Attributes:
        out: folder to write to; a study that was stopped goes on from what is there.
        set: overrides of cfg/cartpole.toml, such as seeds=2.
    """

    out: Path = ROOT / "out" / "cartpole"
    set: tuple[str, ...] = ()


@study.stoppable
def main(args: Args) -> int:
    """Run what is missing, write the table and the figures."""
    console = Console()
    with one_line_errors():
        cfg = load(ROOT / "cfg" / "cartpole.toml", StudyCfg, args.set)
        study.at_least_one(cfg, "seeds", "optima")
        table = study.folder_of(args.out, cfg, Row, args.resume) / "results.csv"
    rows = study.carry_out(partial(work, cfg), jobs(cfg), table, Row, args, console)
    if rows is None:
        return 1
    study.write(args.out / "results.csv", rows)
    cartpole_figures.gaps(args.out / "gap.png", rows, cfg)
    job = Job("solve", "schedules", cfg.task.horizon, 0, cfg.task.num_modes, cfg.task.angle)
    best = cartpole_figures.reference(rows, job)
    cartpole_figures.sequence(args.out / "sequence.png", search(cfg, job), optimum(cfg, best.job), cfg)
    console.print(cartpole_figures.table(rows, cfg))
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
