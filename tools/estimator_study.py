"""Compare the estimator with two published filters on simulated robots: `python tools/estimator_study.py`.

Every seed is another robot (links, joint zeros, friction, sensors) in the same motion; all filters read the
same frames. The policies that make the motions see the true state: the loop is not closed here.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: small matrices only lose by threads

import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from deploy.estimator import EstimatorCfg  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from tools import study  # noqa: E402
from tools.closed_loop import RunCfg, policies  # noqa: E402
from tools.estimators.chi2 import band  # noqa: E402
from tools.estimators.figure import draw  # noqa: E402
from tools.estimators.measure import COUNT, FILTERS, NEES, SETTLE, Job, Score, measure  # noqa: E402
from tools.estimators.sensors import SensorCfg  # noqa: E402
from tools.estimators.simulate import MOTIONS  # noqa: E402


@dataclass(frozen=True)
class StudyCfg:
    """What is compared.

    Attributes:
        estimator: settings of ours.
        sensors: errors of the robots' sensors.
    """

    estimator: EstimatorCfg = field(default_factory=EstimatorCfg)
    sensors: SensorCfg = field(default_factory=SensorCfg)


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line.

    Attributes:
        seeds: number of robots.
        first_seed: seed of the first; the noise values were chosen on 1000 and up.
        seconds: length of each log [s].
        motions: which.
        filters: which.
        out: folder to write to; a study that was stopped goes on from what is there.
    """

    seeds: int = 50
    first_seed: int = 0
    seconds: float = 6.0
    motions: tuple[str, ...] = MOTIONS
    filters: tuple[str, ...] = FILTERS
    out: Path = ROOT / "out" / "estimator"


def jobs(args: Args) -> list[Job]:
    """Every motion with every seed and filter."""
    return [
        Job(motion, args.seconds, seed, name)
        for motion in args.motions
        for seed in study.seeds_of(args)
        for name in args.filters
    ]


def work(cfg: StudyCfg, job: Job) -> Score:
    """One job, in a process of its own."""
    torch.set_num_threads(1)
    return measure(job, cfg.estimator, cfg.sensors)


def summarise(scores: Sequence[Score], motion: str, name: str) -> dict[str, Any]:
    """Means over the seeds in which the robot did what it should; NEES with its 95 % band."""
    rows = [
        score for score in scores if (score.job.motion, score.job.filter) == (motion, name) and score.kept
    ]
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
        for part, freedom in NEES.items():
            row[f"nees_{part}"] = float(np.mean([getattr(score, f"nees_{part}") for score in rows]))
            row[f"band_{part}"] = band(freedom, len(rows))
    return row


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """A row a motion and filter."""
    view = Table(title="body state from the robot's own sensors")
    heads = ("motion", "filter", "seeds", "velocity RMSE [m/s]", "worst [m/s]", "tilt RMSE [deg]")
    for head in (
        *heads,
        "height, end: mean, worst [mm]",
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
            cells += [f"{1e3 * row['height']:.1f}, {1e3 * row['height_worst']:.1f}"]
            cells += [f"{100 * row['rejected']:.2f}" if "rejected" in row else "", str(row.get("falls", ""))]
            cells.append(f"{row['us']:.0f}")
            for part in NEES if "nees_velocity" in row else ():
                low, high = row[f"band_{part}"]
                value = row[f"nees_{part}"]
                color = "green" if low <= value <= high else "red"
                cells.append(f"[{color}]{value:.2f}[/] ({low:.2f}..{high:.2f})")
        view.add_row(*cells)
    return view


@study.stoppable
def main(args: Args) -> int:
    """Run what is missing, print, write."""
    with one_line_errors():
        for name, known in ((args.motions, MOTIONS), (args.filters, FILTERS)):
            for item in name:
                if item not in known:
                    raise ValueError(f"{item!r}: expected one of {', '.join(known)}")
        cfg = StudyCfg()
        if not jobs(args):
            raise ValueError("nothing to compare: --motions and --filters take one or more each")
        if not SETTLE + COUNT <= args.seconds < math.inf:
            raise ValueError(
                f"seconds must be at least {SETTLE + COUNT:g}, of which no figure counts in the first "
                f"{SETTLE:g}, got {args.seconds:g}"
            )
        flip = ROOT / "cfg" / "flip.toml"
        files = flip, *policies(load(flip, RunCfg).task)
        scores_at = study.folder_of(args.out, cfg, Score, args.resume, files) / "scores.csv"
    console = Console()
    scores = study.carry_out(partial(work, cfg), jobs(args), scores_at, Score, args, console)
    if scores is None:
        return 1
    kinds = dict.fromkeys((score.job.motion, score.job.filter) for score in scores)
    rows = [summarise(scores, *kind) for kind in kinds]
    study.write(args.out / "scores.csv", scores)
    settings = {"seeds": args.seeds, "first_seed": args.first_seed, "seconds": args.seconds}
    study.write_json(args.out / "summary.json", {"settings": settings, "rows": rows})
    console.print(table(rows))
    if "flip" in args.motions:
        draw(args.out / "estimator.png", args.seconds, args.first_seed)
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
