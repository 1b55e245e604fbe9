"""See a search: what every switch would cost at one step of a run.

`python tools/landscape.py out/flip/seed_0.json --step 60` rolls all of Omega out from that step's state and
plan, draws the cost over (start, duration) for each mode, and prints which terms the best switch lowers.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402

from hmc import Evaluator, Schedule, SwitchSpace, Task, make_start  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task  # noqa: E402
from tools.closed_loop import RunCfg  # noqa: E402
from tools.figures import save  # noqa: E402


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        log: seed_*.json of tools/flip.py.
        step: control step whose search is shown; not one in the jump, whose memory is not in the log.
        out: picture to write; default: beside the log.
        worlds: rolled out together.
        set: overrides of cfg/flip.toml, as the run had them.
    """

    log: tyro.conf.Positional[Path]
    step: int = 60
    out: Path | None = None
    worlds: int = 512
    set: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Landscape:
    """What all switches of one schedule cost.

    Attributes:
        schedule: that is switched.
        cost: its own.
        costs: of each mode, by start and duration - 1, (M, T, T); NaN beyond the horizon.
        best: schedule of lowest cost.
        terms: before and after the best switch, term by term.
    """

    schedule: Schedule
    cost: float
    costs: np.ndarray
    best: Schedule
    terms: tuple[dict[str, float], dict[str, float]]


def landscape(task: Task, evaluator: Evaluator, schedule: Schedule) -> Landscape:
    """Roll out all of Omega."""
    space = SwitchSpace(len(task.modes), task.horizon)
    cost = evaluator.follow(schedule)
    indices = torch.arange(len(space))
    found = evaluator.costs(space.stitch(schedule, indices))
    mode, start, duration = (part.numpy() for part in space.split(indices))
    costs = np.full((len(task.modes), task.horizon, task.horizon), np.nan)
    costs[mode, start, duration - 1] = found.numpy()
    best = schedule.stitch(space[int(found.argmin())])
    return Landscape(schedule, cost, costs, best, (evaluator.terms(schedule), evaluator.terms(best)))


def draw(path: Path, found: Landscape, title: str) -> None:
    """A panel a mode; the colour is the cost over that of the schedule as it is."""
    names = found.schedule.names or tuple(map(str, range(len(found.costs))))
    change = found.costs - found.cost
    reach = np.nanquantile(np.abs(change[np.isfinite(change)]), 0.9) or 1.0
    figure, axes = plt.subplots(
        1, len(names), figsize=(4 * len(names), 3.8), constrained_layout=True, sharey=True
    )
    for axis, name, values in zip(np.atleast_1d(axes), names, change, strict=True):
        image = axis.imshow(
            np.where(np.isinf(values), reach, values).T,
            origin="lower",
            cmap="RdBu_r",
            vmin=-reach,
            vmax=reach,
        )
        if np.nanmin(values) == np.nanmin(change):
            start, duration = np.unravel_index(np.nanargmin(values), values.shape)
            axis.plot(start, duration, marker="o", markersize=9, markerfacecolor="none", color="black")
        axis.set_title(f"switch to {name}", fontsize=10)
        axis.set_xlabel("start [control steps]")
    np.atleast_1d(axes)[0].set_ylabel("duration [control steps]")
    figure.colorbar(image, ax=axes, label="change of cost")
    figure.suptitle(title, fontsize=10)
    save(figure, path)


def read(path: Path, step: int) -> dict[str, Any]:
    """A step's record."""
    steps: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["steps"]
    if not 0 <= step < len(steps):
        raise ValueError(f"{path} has steps 0 to {len(steps) - 1}, got --step {step}")
    entry = steps[step]
    if "jump" in (entry["mode"], steps[max(0, step - 1)]["mode"]):
        raise ValueError(
            f"{path}: step {step} is in the jump, whose memory is not in the log: take another one"
        )
    return {**entry, "before": steps[max(0, step - 1)]}


def parse(line: str, names: tuple[str, ...]) -> Schedule:
    """A schedule from its compact line, "foot x35 | jump x12"."""
    modes = [part.split(" x") for part in line.split(" | ")]
    return Schedule(tuple(names.index(name) for name, count in modes for _ in range(int(count))), names)


@torch.no_grad()
def main(args: Args) -> None:
    """Read, roll out, draw, say why."""
    with one_line_errors():
        entry = read(args.log, args.step)
        task = flip_task(load(ROOT / "cfg" / "flip.toml", RunCfg, args.set).task)
        schedule = parse(entry["schedule"], task.modes.names)
        if len(schedule) != task.horizon:
            raise ValueError(
                f"{args.log} was planned over {len(schedule)} steps: give --set task.horizon=..."
            )
    sim = task.make_sim(args.worlds)
    start = make_start(task, sim, entry["x"], entry["before"]["u"], entry["before"]["mode"], k=args.step)
    console = Console()
    with console.status("rolling out all switches"):
        found = landscape(task, Evaluator(task, sim, start), schedule)
    out = args.out or args.log.with_name(f"{args.log.stem}_step_{args.step}.png")
    better = float(np.nanmin(found.costs))
    draw(out, found, f"{schedule}: cost {found.cost:.2f}, with the best switch {better:.2f}: {found.best}")
    console.print(f"{schedule}\n{found.best}", highlight=False)
    for name, before in found.terms[0].items():
        console.print(f"{name:>12} {before:8.3f} -> {found.terms[1][name]:8.3f}", highlight=False)
    console.print(f"{out}")


if __name__ == "__main__":
    main(command_line(Args))
