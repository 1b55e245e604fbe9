"""See a search: what every switch would cost at one step of a run, or of a plan, and why the best is taken.

`python tools/landscape.py out/flip/seed_0.json --step 60` rolls all of Omega out from that step's state and
plan; `python tools/landscape.py --task cartpole --step 2` does so around a plan's schedule after two accepted
steps. Either draws the cost over (start, duration) for each mode, and says which terms the best one lowers.
Of a plan, also the schedule after each accepted step is drawn, as a timeline.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402
from matplotlib.colors import ListedColormap  # noqa: E402
from matplotlib.patches import Patch  # noqa: E402
from rich.console import Console  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc import Budget, Evaluator, Plan, Schedule, Start, Switch, SwitchSpace, Task, make_start, plan  # noqa: E402
from hmc.cfg import load, override  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task  # noqa: E402
from hmc.running import Running  # noqa: E402
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state  # noqa: E402
from tools.closed_loop import RunCfg, disturbed_start  # noqa: E402
from tools.figures import save, search  # noqa: E402

BARRED, DIVERGED = "#222222", "#e0c341"


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        log: seed_*.json of tools/flip.py, where the task is the flip.
        task: flip, or cartpole, whose plan is made here.
        step: of the flip, the control step whose search is shown. Of a plan, how many accepted steps are in
            the schedule that is shown.
        out: picture to write; default: beside the log, or in out.
        worlds: rolled out together.
        control_steps: budget of the cartpole's plan.
        set: overrides of cfg/flip.toml, as the run had them, or of the cartpole's settings.
    """

    log: tyro.conf.Positional[Path | None] = None
    task: Literal["flip", "cartpole"] = "flip"
    step: int = 0
    out: Path | None = None
    worlds: int = 512
    control_steps: int = 100_000
    set: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Landscape:
    """What all switches of one schedule cost.

    Attributes:
        schedule: that is switched.
        cost: its own.
        costs: of each mode, by start and duration - 1, (M, T, T); NaN beyond the horizon, inf where the
            rollout diverged or a rule bars it.
        barred: where the rules do not allow the schedule, whatever its states, (M, T, T).
        switch: the best one; None where none lowers the cost.
        terms: before and after it, term by term.
    """

    schedule: Schedule
    cost: float
    costs: np.ndarray
    barred: np.ndarray
    switch: Switch | None
    terms: tuple[dict[str, float], dict[str, float]]

    @property
    def best(self) -> Schedule:
        """The schedule with the best switch, if there is one."""
        return self.schedule if self.switch is None else self.schedule.stitch(self.switch)


def landscape(task: Task, evaluator: Evaluator, schedule: Schedule, tolerance: float = 1e-6) -> Landscape:
    """Roll out all of Omega; a switch counts if it lowers the cost by more than this share, as in `plan`."""
    space = SwitchSpace(len(task.modes), task.horizon)
    cost = evaluator.follow(schedule)
    indices = torch.arange(len(space))
    switched = space.stitch(schedule, indices)
    found = evaluator.costs(switched)
    mode, start, duration = (part.numpy() for part in space.split(indices))
    costs = np.full((len(task.modes), task.horizon, task.horizon), np.nan)
    costs[mode, start, duration - 1] = found.numpy()
    barred = np.zeros(costs.shape, dtype=bool)
    if task.rules is not None:
        of = evaluator.start
        barred[mode, start, duration - 1] = task.rules.broken(task.modes, switched, of.mode, of.ran).numpy()
    lowest = int(found.argmin())
    better = float(found[lowest]) < (cost - tolerance * abs(cost) if np.isfinite(cost) else cost)
    switch = space[lowest] if better else None
    after = schedule if switch is None else schedule.stitch(switch)
    return Landscape(
        schedule, cost, costs, barred, switch, (evaluator.terms(schedule), evaluator.terms(after))
    )


def draw(path: Path, found: Landscape, title: str) -> None:
    """A panel a mode; the colour is the cost over that of the schedule as it is, a circle the best switch."""
    names = found.schedule.names or tuple(map(str, range(len(found.costs))))
    horizon = len(found.schedule)
    change = found.costs - found.cost if np.isfinite(found.cost) else found.costs
    finite = np.abs(change[np.isfinite(change)])
    reach = (np.quantile(finite, 0.9) if len(finite) else 0.0) or 1.0
    figure, axes = plt.subplots(1, len(names), figsize=(4 * len(names), 4.6), constrained_layout=True,
                                sharey=True, squeeze=False)  # fmt: skip
    place = {"origin": "lower", "extent": (-0.5, horizon - 0.5, 0.5, horizon + 0.5)}
    for mode, (axis, name, values) in enumerate(zip(axes[0], names, change, strict=True)):
        image = axis.imshow(
            np.where(np.isinf(values), np.nan, values).T, cmap="RdBu_r", vmin=-reach, vmax=reach, **place
        )
        endless = np.where(found.barred[mode], 0.0, np.where(np.isinf(values), 1.0, np.nan))
        axis.imshow(endless.T, cmap=ListedColormap([BARRED, DIVERGED]), vmin=0, vmax=1, **place)
        if found.switch is not None and found.switch.mode == mode:
            at = found.switch.start, found.switch.duration
            axis.plot(*at, marker="o", markersize=9, markerfacecolor="none", color="black")
        axis.set_title(f"switch to {name}", fontsize=10)
        axis.set_xlabel("start [control steps]")
    axes[0][0].set_ylabel("duration [control steps]")
    figure.colorbar(image, ax=axes, label="change of cost; beyond the scale as its end")
    endless = np.isinf(change) & ~found.barred
    kinds = (BARRED, "against the rules", found.barred), (DIVERGED, "diverged, or not to be entered", endless)
    handles = [Patch(color=color, label=label) for color, label, where in kinds if where.any()]
    if handles:
        axes[0][-1].legend(handles=handles, loc="upper right", fontsize=8)
    figure.suptitle(title, fontsize=10)
    save(figure, path)


def reason(before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """Why a switch: how much each term changed, the largest fall first."""
    change = {name: after[name] - before[name] for name in before}
    ordered = sorted(change.items(), key=lambda each: each[1])
    return ", ".join(f"{name} {value:+.4g}" for name, value in ordered)


def read(path: Path, step: int) -> tuple[int, list[dict[str, Any]]]:
    """A run's seed, and its records up to that of a step."""
    log = json.loads(path.read_text(encoding="utf-8"))
    steps: list[dict[str, Any]] = log["steps"]
    if not 0 <= step < len(steps):
        raise ValueError(f"{path} has steps 0 to {len(steps) - 1}, got --step {step}")
    return log["seed"], steps[: step + 1]


def parse(line: str, names: tuple[str, ...]) -> Schedule:
    """A schedule from its compact line, "foot x35 | jump x12"."""
    modes = [part.split(" x") for part in line.split(" | ")]
    return Schedule(tuple(names.index(name) for name, count in modes for _ in range(int(count))), names)


def of_log(args: Args) -> tuple[Task, Start, Schedule]:
    """A flip's step: the task with the run's own noise, the state, and the plan that came of it."""
    if args.log is None:
        raise ValueError("the flip's search is read from a log: give seed_*.json of tools/flip.py")
    seed, steps = read(args.log, args.step)
    cfg = load(ROOT / "cfg" / "flip.toml", RunCfg, args.set)
    task = flip_task(cfg.task, seed=seed)
    schedule = parse(steps[-1]["schedule"], task.modes.names)
    if len(schedule) != task.horizon:
        raise ValueError(f"{args.log} was planned over {len(schedule)} steps: give --set task.horizon=...")
    return task, start_of(task, steps, disturbed_start(cfg.start, seed)[1]), schedule


@torch.no_grad()
def start_of(task: Task, steps: list[dict[str, Any]], u: Tensor) -> Start:
    """Where the last of these steps was planned from; `u` is the input before the first, (nu,).

    What the running mode remembers is not in the log: it runs again from where it was entered, which gives
    the same but for the log's six digits.
    """
    k = len(steps) - 1
    names, states = [entry["mode"] for entry in steps], [torch.tensor(entry["x"]).double() for entry in steps]
    inputs = [u, *(torch.tensor(entry["u"]).double() for entry in steps)]
    entered = k
    while entered > 0 and names[entered - 1] == names[k - 1]:
        entered -= 1
    now = Running(task.modes)
    for at in range(entered, k):
        now.act(task.modes.index(names[at]), states[at], inputs[at], at)
    return make_start(task, task.make_sim(1), states[k], inputs[k], now.mode, now.memory, k, ran=now.ran)


def of_cartpole(args: Args, console: Console) -> tuple[Task, Start, Plan]:
    """A plan of the cartpole made here, its steps told."""
    cfg = override(CartpoleCfg(), args.set)
    task = cartpole(cfg)
    idle = [cfg.num_modes // 2] * cfg.horizon
    start = make_start(task, task.make_sim(1), initial_state(cfg))
    found = plan(task, start, schedule=idle, budget=Budget(control_steps=args.control_steps))
    if not 0 <= args.step < len(found.schedules):
        raise ValueError(f"the plan has 0 to {len(found.steps)} accepted steps, got --step {args.step}")
    before = found.incumbent_terms
    for number, ((switches, after), cost) in enumerate(zip(found.steps, found.costs[1:], strict=True), 1):
        what = ", ".join(f"{task.modes.names[s.mode]} from {s.start} for {s.duration}" for s in switches)
        console.print(f"{number:3}: {what}: cost {cost:.4g}: {reason(before, after)}", highlight=False)
        before = after
    return task, start, found


@torch.no_grad()
def main(args: Args) -> None:
    """Read or plan, roll out, draw, say why."""
    console = Console()
    with one_line_errors():
        flip = args.task == "flip"
        if flip:
            task, start, schedule = of_log(args)
        else:
            task, start, made = of_cartpole(args, console)
            schedule = made.schedules[args.step]
    sim = task.make_sim(args.worlds)
    with console.status("rolling out all switches"):
        found = landscape(task, Evaluator(task, sim, start), schedule)
    default = ROOT / "out" / f"{args.task}_step_{args.step}.png"
    if args.log is not None:
        default = args.log.with_name(f"{args.log.stem}_step_{args.step}.png")
    out = args.out or default
    out.parent.mkdir(parents=True, exist_ok=True)
    better = "no switch lowers it"
    if found.switch is not None:
        better = f"with the best switch {np.nanmin(found.costs):.2f}: {found.best}"
    draw(out, found, f"{schedule}: cost {found.cost:.2f}, {better}")
    pictures = [out]
    if not flip:
        pictures.append(out.with_name(f"{out.stem}_plan{out.suffix}"))
        search(pictures[-1], made)
    console.print(f"{schedule}\n{found.best}", highlight=False)
    for name, before in found.terms[0].items():
        console.print(f"{name:>12} {before:8.3f} -> {found.terms[1][name]:8.3f}", highlight=False)
    why = "no switch lowers the cost" if found.switch is None else f"why: {reason(*found.terms)}"
    console.print(why, highlight=False)
    for picture in pictures:
        console.print(f"{picture}")


if __name__ == "__main__":
    main(command_line(Args))
