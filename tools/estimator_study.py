"""Compare the estimator with two published filters on simulated robots: `python tools/estimator_study.py`.

Every seed is another robot (links, joint zeros, friction, sensors) in the same motion; all filters read the
same frames. The policies that make the motions see the true state: the loop is not closed here.
"""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: small matrices only lose by threads

import numpy as np  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc.cli import one_line_errors  # noqa: E402
from tools.estimators.chi2 import band  # noqa: E402
from tools.estimators.figure import draw  # noqa: E402
from tools.estimators.measure import FILTERS, NEES, Score, measure  # noqa: E402
from tools.estimators.simulate import MOTIONS  # noqa: E402


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        seeds: number of robots.
        first_seed: seed of the first; the noise values were chosen on 1000 and up.
        seconds: length of each log [s].
        motions: which.
        filters: which.
        out: folder to write to.
        processes: logs at the same time, a core each; 0 for as many as there are cores.
    """

    seeds: int = 50
    first_seed: int = 0
    seconds: float = 6.0
    motions: tuple[str, ...] = MOTIONS
    filters: tuple[str, ...] = FILTERS
    out: Path = ROOT / "out" / "estimator"
    processes: int = 0


def _work(motion: str, seconds: float, seed: int, filters: tuple[str, ...]) -> list[Score]:
    torch.set_num_threads(1)
    return measure(motion, seconds, seed, filters)


def run_all(args: Args, console: Console) -> list[Score]:
    """Every motion with every seed; in the order of the arguments whatever ends first."""
    jobs = [(motion, args.seconds, seed) for motion in args.motions for seed in seeds(args)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.processes or os.cpu_count() or 1, mp_context=context) as pool:
        order = {pool.submit(_work, *job, args.filters): i for i, job in enumerate(jobs)}
        done: list[list[Score]] = [[] for _ in jobs]
        for future in track(as_completed(order), "logs", total=len(jobs), console=console):
            done[order[future]] = future.result()
    return [score for scores in done for score in scores]


def seeds(args: Args) -> range:
    return range(args.first_seed, args.first_seed + args.seeds)


def summarise(scores: Sequence[Score], motion: str, name: str) -> dict[str, Any]:
    """Means over the seeds in which the robot did what it should; NEES with its 95 % band."""
    rows = [score for score in scores if (score.motion, score.filter) == (motion, name) and score.kept]
    row: dict[str, Any] = {"motion": motion, "filter": name, "seeds": len(rows)}
    if not rows:
        return row
    for key in ("velocity", "tilt"):
        row[key] = float(np.sqrt(np.mean([getattr(score, key) ** 2 for score in rows])))
    row["height"] = float(np.mean([score.height for score in rows]))
    row["height_worst"] = float(np.max([score.height for score in rows]))
    row["worst"] = float(np.max([score.worst for score in rows]))
    row["us"] = float(np.median([score.us for score in rows]))
    if name == "ours":
        row["rejected"] = float(np.mean([score.rejected for score in rows]))
        row["falls"] = sum(score.falls for score in rows)
        row["used_slip"] = float(np.mean([score.used_slip for score in rows]))
        for i, (part, freedom) in enumerate(NEES.items()):
            row[f"nees_{part}"] = float(np.mean([score.nees[i] for score in rows]))
            row[f"band_{part}"] = band(freedom, len(rows))
    return row


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """A row a motion and filter."""
    view = Table(title="body state from the robot's own sensors")
    heads = ("motion", "filter", "seeds", "velocity RMSE [m/s]", "worst [m/s]", "tilt RMSE [deg]")
    for head in (
        *heads,
        "height, end [mm]",
        "rejected [%]",
        "falls",
        "time [us]",
        *(f"NEES {part}" for part in NEES),
    ):
        view.add_column(head, justify="right")
    for row in rows:
        cells = [row["motion"], row["filter"], str(row["seeds"])]
        if row["seeds"]:
            cells += [f"{row['velocity']:.4f}", f"{row['worst']:.3f}", f"{row['tilt']:.2f}"]
            cells += [f"{1e3 * row['height']:.1f}"]
            cells += [f"{100 * row['rejected']:.2f}" if "rejected" in row else "", str(row.get("falls", ""))]
            cells.append(f"{row['us']:.0f}")
            for part in NEES if "nees_velocity" in row else ():
                low, high = row[f"band_{part}"]
                value = row[f"nees_{part}"]
                color = "green" if low <= value <= high else "red"
                cells.append(f"[{color}]{value:.2f}[/] ({low:.2f}..{high:.2f})")
        view.add_row(*cells)
    return view


def write(out: Path, scores: Sequence[Score], rows: Sequence[dict[str, Any]], args: Args) -> None:
    """All scores as CSV, the summary as JSON."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "scores.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(Score) if field.name != "nees"] + list(NEES))
        for score in scores:
            values = asdict(score)
            nees = values.pop("nees")
            writer.writerow([*values.values(), *nees])
    settings = {"seeds": args.seeds, "first_seed": args.first_seed, "seconds": args.seconds}
    text = json.dumps({"settings": settings, "rows": rows}, indent=2)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")


def main(args: Args) -> int:
    """Run, print, write."""
    with one_line_errors():
        for name, known in ((args.motions, MOTIONS), (args.filters, FILTERS)):
            for item in name:
                if item not in known:
                    raise ValueError(f"{item!r}: expected one of {', '.join(known)}")
    console = Console()
    scores = run_all(args, console)
    rows = [summarise(scores, motion, name) for motion in args.motions for name in args.filters]
    write(args.out, scores, rows, args)
    console.print(table(rows))
    draw(args.out / "estimator.png", args.seconds, args.first_seed)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
