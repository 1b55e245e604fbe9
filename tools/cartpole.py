"""The paper's first experiment: `python tools/cartpole.py` (figures and a table into out/cartpole).

Mode schedules, MPPI, CEM and predictive sampling swing a cartpole up at equal numbers of rolled-out control
steps; iLQR gives the local optimum that their costs are measured against.
"""

from __future__ import annotations

import csv
import hashlib
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import Progress  # noqa: E402

from hmc.cfg import dump, load  # noqa: E402
from hmc.cli import one_line_errors  # noqa: E402
from tools import cartpole_figures  # noqa: E402
from tools.cartpole_study import Job, Row, StudyCfg, jobs, optimum, search, work  # noqa: E402

KINDS = {"str": str, "int": int, "float": float}


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

    def values(kind: type, line: dict[str, str]) -> dict[str, Any]:
        names = {each.name: str(each.type) for each in fields(kind) if each.name != "job"}
        return {name: KINDS[of](line[name]) for name, of in names.items()}

    with path.open(newline="", encoding="utf-8") as lines:
        return [Row(Job(**values(Job, line)), **values(Row, line)) for line in csv.DictReader(lines)]


def write(path: Path, rows: list[Row]) -> None:
    """A results file that is either whole or not there."""
    partial = path.with_name(path.name + ".partial")
    lines = [{**values.pop("job"), **values} for values in map(asdict, rows)]
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
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
