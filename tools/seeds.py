"""How much a policy depends on chance: `python tools/seeds.py --mode handstand --seeds 5` (into out/seeds).

Trains a mode with several seeds, a core each, exports every policy and measures it. A training that was
stopped, or whose worker was lost, goes on from its own latest checkpoint.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc.cfg import dump  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from tools import curves, study  # noqa: E402
from train import evaluate, ppo  # noqa: E402
from train.config import read_training  # noqa: E402
from train.export import export  # noqa: E402
from train.runner import read_checkpoint  # noqa: E402
from train.score import Score  # noqa: E402

# mode -> what it is measured by, as of train/evaluate.py
PROTOCOLS: dict[str, Any] = {
    "handstand": "stance",
    "footstand": "stance",
    "stand": "stance",
    "getup": "fallen",
    "walk": "walk",
}
STARTS_SEED = 1000  # of the episodes that all policies are measured in


@dataclass(frozen=True)
class SeedsCfg:
    """A study, but for how many seeds it has.

    Attributes:
        mode: that is trained.
        training: its settings, as text.
        episodes: that each policy is measured in.
        set: overrides that `training` was read with.
    """

    mode: str
    training: str
    episodes: int
    set: tuple[str, ...]


@dataclass(frozen=True)
class Job:
    """A training."""

    seed: int


@dataclass(frozen=True)
class Row:
    """What came of it.

    Attributes:
        job: which training.
        success: of how many of the `episodes` this is true.
        episodes: that were measured.
        power: of the joints while it holds [W].
        rate: change of the joint targets from step to step then, root mean square [rad].
        environment_steps: of training.
        minutes: of training.
    """

    job: Job
    success: int
    episodes: int
    power: float
    rate: float
    environment_steps: int
    minutes: float


@dataclass(frozen=True, eq=False)
class Trained:
    """What a worker hands back, whose folders may be another machine's: row, policy file, learning curves."""

    row: Row
    policy: bytes
    curve: curves.Curves


def work(cfg: SeedsCfg, folder: Path, job: Job) -> Trained:
    """Train to the end from where an earlier attempt came to, export and measure, on one core.

    Raises:
        KeyboardInterrupt: it was stopped before its last iteration.
    """
    torch.set_num_threads(1)
    here = folder / f"seed_{job.seed}"
    here.mkdir(parents=True, exist_ok=True)
    latest, policy = here / "latest.pt", here / "policy.onnx"
    mode: Any = cfg.mode
    args = ppo.Args(mode, engine="mujoco", threads=1, seed=job.seed, out=here, set=cfg.set)
    command = [f"--mode={mode}", "--engine=mujoco", "--threads=1", f"--seed={job.seed}"]
    command += ["--set", *cfg.set] if cfg.set else []
    with (here / "log.txt").open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
        runner = ppo.set_up(replace(args, resume=latest.exists()), command)
        ppo.train(runner, here)
    if not latest.exists() or read_checkpoint(latest)["iter"] + 1 < runner.last_iteration:
        raise KeyboardInterrupt
    export(latest, policy)
    infos = read_checkpoint(latest)["infos"]
    torch.manual_seed(STARTS_SEED)
    asked = evaluate.Args(policy, PROTOCOLS[cfg.mode], episodes=cfg.episodes, threads=1)
    good, found = evaluate.measured(
        *evaluate.set_up(asked), asked.starts, cfg.episodes, evaluate.conditions_of(None), threads=1
    )
    row = Row(
        job,
        int(good.sum()),
        cfg.episodes,
        found.power,
        found.rate,
        int(infos["steps"]),
        float(infos["seconds"]) / 60,
    )
    curve = replace(curves.read(here), title=f"{cfg.mode}, seed {job.seed}")
    return Trained(row, policy.read_bytes(), curve)


def keep(folder: Path, made: Trained) -> Row:
    """Write a seed's policy and curves into `folder`; its row."""
    name = f"seed_{made.row.job.seed}"
    with study.whole(folder / f"{name}.onnx") as policy:
        policy.write_bytes(made.policy)
    lines = {tag: [part.tolist() for part in line] for tag, line in made.curve.lines.items()}
    found = {"title": made.curve.title, "batch": made.curve.batch, "lines": lines}
    study.write_json(folder / f"{name}.json", found)
    return made.row


def curve_of(folder: Path, row: Row) -> curves.Curves:
    """The curves that `keep` wrote."""
    found = json.loads((folder / f"seed_{row.job.seed}.json").read_text(encoding="utf-8"))
    lines = {tag: (np.array(at), np.array(values)) for tag, (at, values) in found["lines"].items()}
    return curves.Curves(found["title"], found["batch"], lines)


def summarise(cfg: SeedsCfg, rows: list[Row]) -> dict[str, Any]:
    """What seeds.json holds."""
    seeds = {}
    for row in rows:
        low, high = Score(row.success, row.episodes).interval
        values = {name: value for name, value in vars(row).items() if name != "job"}
        seeds[str(row.job.seed)] = {**values, "low": low, "high": high}
    rates = [row.success / row.episodes for row in rows]
    spread = {"success_mean": float(np.mean(rates)), "success_min": min(rates), "success_max": max(rates)}
    return {"mode": cfg.mode, "measured": PROTOCOLS[cfg.mode], **spread, "seeds": seeds}


def publish(cfg: SeedsCfg, folder: Path, out: Path, rows: list[Row]) -> None:
    """Tables and figure of the seeds so far, into `out`."""
    study.write(out / "seeds.csv", rows)
    study.write_json(out / "seeds.json", summarise(cfg, rows))
    curves.draw([curve_of(folder, row) for row in rows], out / "curves.png")


def view(cfg: SeedsCfg, rows: list[Row]) -> Table:
    """A line a seed."""
    table = Table("seed", "success", "power [W]", "change [rad]", "million steps", "minutes")
    table.title = f"{cfg.mode}, measured from {PROTOCOLS[cfg.mode]}"
    for row in rows:
        table.add_row(
            str(row.job.seed),
            str(Score(row.success, row.episodes)),
            f"{row.power:.1f}",
            f"{row.rate:.3f}",
            f"{row.environment_steps / 1e6:.2f}",
            f"{row.minutes:.0f}",
        )
    return table


@dataclass(frozen=True)
class Args(study.Workers):
    """Command line.

    Attributes:
        mode: one of handstand, footstand, stand, getup, walk; its settings are in cfg/MODE.toml.
        seeds: how many, from 1 on.
        episodes: that each policy is measured in: in its stance, getup as it fell, walk as commanded.
        out: folder to write to; default out/seeds/MODE.
        set: overrides of cfg/MODE.toml, such as ppo.iterations=500.
    """

    mode: str = "handstand"
    seeds: int = 5
    episodes: int = 500
    out: Path | None = None
    set: tuple[str, ...] = ()


def settings(args: Args) -> SeedsCfg:
    """What is asked for; what makes no sense is a ValueError."""
    if args.mode not in PROTOCOLS:
        near = difflib.get_close_matches(args.mode, PROTOCOLS, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown mode {args.mode!r}: expected one of {', '.join(PROTOCOLS)}{hint}")
    study.at_least_one(args, "seeds", "episodes")
    training = dump(read_training(args.mode, args.mode, args.set))
    return SeedsCfg(args.mode, training, args.episodes, args.set)


@study.stoppable
def main(args: Args) -> int:
    """Train, export and measure what is missing."""
    console = Console()
    with one_line_errors():
        cfg = settings(args)
        out = (args.out or ROOT / "out" / "seeds" / args.mode).resolve()
        env: Any = read_training(args.mode, args.mode, args.set).env
        records = getattr(env.starts, "records", "")
        folder = study.folder_of(out, cfg, Row, args.resume, [ROOT / records] if records else [])
    tell = partial(publish, cfg, folder, out)
    jobs = [Job(seed) for seed in range(1, args.seeds + 1)]
    do, receive = partial(work, cfg, folder), partial(keep, folder)
    rows = study.carry_out(do, jobs, folder / "results.csv", Row, args, console, receive, tell)
    if rows is None:
        return 1
    tell(rows)
    console.print(view(cfg, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
