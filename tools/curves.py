"""Learning curves of training runs: `python tools/curves.py out/train/handstand out/train/footstand`.

Runs on several engines or with several seeds are compared by when each comes to the same success.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # noqa: E402

from hmc.cli import command_line, one_line_errors  # noqa: E402
from tools.figures import save  # noqa: E402
from train.runner import read_checkpoint  # noqa: E402

CURVES = {
    "/success/stance": "held from the stance",
    "/success/way": "reached from the open grid",
    "/success/home": "reached from four legs",
    "/success/recorded": "caught in flips",
    "/success/standing": "done from four legs",
    "/success/fallen": "done from where it fell",
    "/success/stances": "done from two legs",
}


STEPS = "Perf/environment_steps"  # up to the end of each iteration, of all processes
TIMES = ("Perf/collection_time", "Perf/learning_time")  # of each iteration [s]


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        runs: folders of train/ppo.py.
        level: success whose first time is told of each run.
        out: picture to write.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    level: float = 0.9
    out: Path = ROOT / "out" / "train" / "learning.png"


@dataclass(frozen=True, eq=False)
class Curves:
    """One training run.

    Attributes:
        title: what was trained.
        batch: environment steps an iteration, where the log does not count them.
        lines: tensorboard tag -> (iterations, values), (n,) each.
    """

    title: str
    batch: int
    lines: dict[str, tuple[np.ndarray, np.ndarray]]

    def millions(self, at: np.ndarray) -> np.ndarray:
        """Environment steps [million] up to the end of iterations `at`, (n,)."""
        known, steps = self.lines.get(STEPS, (np.zeros(0), np.zeros(0)))
        found = (at + 1) * float(self.batch)
        if len(known):
            found = np.where(at < known[0], found, np.interp(at, known, steps))
        return np.asarray(found / 1e6)


def read(folder: Path) -> Curves:
    """What a training run has logged; a resumed run counts from its last start at each iteration."""
    config = json.loads(read_checkpoint(folder / "latest.pt")["infos"]["meta"]["config"])
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    lines = {}
    for tag in (*CURVES, "/success/frontier", *TIMES, STEPS):
        if tag in events.Tags()["scalars"]:
            last = {event.step: event.value for event in events.Scalars(tag)}
            lines[tag] = np.array(sorted(last)), np.array([last[step] for step in sorted(last)])
    return Curves(config["env"]["mode"], config["env"]["worlds"] * config["ppo"]["steps"], lines)


def reached(run: Curves, tag: str, level: float) -> tuple[float, float] | None:
    """Environment steps [million] and training time [min] up to where a curve first comes to a level."""
    steps, values = run.lines[tag]
    there = steps[values >= level]
    if len(there) == 0:
        return None
    spent = (seconds[at <= there[0]].sum() for at, seconds in (run.lines[tag] for tag in TIMES))
    return float(run.millions(there[:1])[0]), float(sum(spent) / 60)


def draw(runs: Sequence[Curves], out: Path) -> None:
    """All runs side by side, as a picture."""
    figure, axes = plt.subplots(
        1, len(runs), figsize=(5 * len(runs), 3.4), sharey=True, squeeze=False, constrained_layout=True
    )
    for axis, run in zip(axes[0], runs, strict=True):
        for number, (tag, words) in enumerate(CURVES.items()):
            if tag in run.lines:
                steps, values = run.lines[tag]
                axis.plot(run.millions(steps), values, color=f"C{number}", label=words)
        if "/success/frontier" in run.lines:  # the curriculum's places: 1 the stance, -1 the other one
            steps, values = run.lines["/success/frontier"]
            axis.plot(run.millions(steps), values, color="grey", linestyle=":", label="furthest open place")
        axis.set_title(run.title)
        axis.set_xlabel("environment steps [million]")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="lower right")
    places = any("/success/frontier" in run.lines for run in runs)
    axes[0, 0].set_ylim(-1.05 if places else -0.05, 1.05)
    axes[0, 0].set_ylabel("share of episodes; place" if places else "share of episodes")
    save(figure, out)


def main(args: Args) -> None:
    """Draw all runs side by side."""
    with one_line_errors():
        if not args.runs:
            raise ValueError("no runs are given: name one or more folders of train/ppo.py")
        runs = [read(folder) for folder in args.runs]
        args.out.parent.mkdir(parents=True, exist_ok=True)
    draw(runs, args.out)
    for run in runs:
        for tag in filter(run.lines.__contains__, CURVES):
            found = reached(run, tag, args.level)
            when = "not reached" if found is None else f"{found[0]:.2f} million steps, {found[1]:.1f} minutes"
            print(f"{run.title}, {CURVES[tag]} {args.level:g}: {when}")
    print(args.out)


if __name__ == "__main__":
    main(command_line(Args))
