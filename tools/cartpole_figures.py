"""Figures and table of the cartpole study."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from rich.table import Table

from hmc.ilqr import Optimum
from hmc.planner import Plan
from tools.cartpole_study import Job, Row, StudyCfg
from tools.figures import save

NAMES = {"schedules": "mode schedules (ours)", "mppi": "MPPI", "cem": "CEM", "ps": "predictive sampling"}
COLORS = {"schedules": "#d1495b", "mppi": "#30638e", "cem": "#edae49", "ps": "#4c9f70"}


def reference(rows: list[Row], like: Job) -> Row:
    """The lowest of iLQR's local optima of a job's horizon and angle."""
    same = (like.horizon, like.angle)
    found = [r for r in rows if r.job.planner == "ilqr" and (r.job.horizon, r.job.angle) == same]
    return min(found, key=lambda row: row.cost)


def gap(rows: list[Row], row: Row) -> float:
    """(J - J_iLQR) / T, the paper's measure."""
    return (row.cost - reference(rows, row.job).cost) / row.job.horizon


def of(rows: list[Row], **settings: object) -> list[Row]:
    """The rows whose job has these settings."""
    return [row for row in rows if all(getattr(row.job, name) == each for name, each in settings.items())]


def pick(rows: list[Row], cfg: StudyCfg, part: str, planner: str) -> dict[int, list[Row]]:
    """Rows of one planner by horizon, with the study's own number of modes and start angle."""
    own = {"num_modes": cfg.task.num_modes, "angle": cfg.task.angle}
    return {t: of(rows, part=part, planner=planner, horizon=t, **own) for t in sorted(cfg.horizons)}


def gaps(path: Path, rows: list[Row], cfg: StudyCfg) -> None:
    """Optimality gap and receding-horizon cost over the horizon, mean and standard deviation over seeds."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), constrained_layout=True)
    for planner in NAMES:
        solved, run = (pick(rows, cfg, part, planner) for part in ("solve", "loop"))
        _band(left, planner, {t: [gap(rows, row) for row in found] for t, found in solved.items()})
        _band(right, planner, {t: [row.cost for row in found] for t, found in run.items()})
    left.axhline(0, color="black", linewidth=0.8)
    left.set_ylabel("(J - J of iLQR) / T")
    left.set_title(f"one horizon, {cfg.rollouts} T control steps", fontsize=10)
    right.set_ylabel("executed cost")
    right.set_title(f"receding horizon, {cfg.loop.rollouts} T control steps a tick", fontsize=10)
    for axis in (left, right):
        axis.set_xlabel("horizon T [control steps]")
    right.legend(fontsize=8)
    save(figure, path)


def _band(axis: Axes, planner: str, values: dict[int, list[float]]) -> None:
    mean, std = (np.array([f(v) for v in values.values()]) for f in (np.mean, np.std))
    axis.plot(list(values), mean, color=COLORS[planner], label=NAMES[planner], marker="o", markersize=3)
    axis.fill_between(list(values), mean - std, mean + std, color=COLORS[planner], alpha=0.2, linewidth=0)


def sequence(path: Path, found: Plan, best: Optimum, cfg: StudyCfg) -> None:
    """A schedule's modes, and its input beside that of iLQR."""
    time = np.arange(len(found.schedule)) * cfg.task.dt
    levels = np.linspace(-1, 1, cfg.task.num_modes) * cfg.task.params.gear
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 4.2), constrained_layout=True)
    axes[0].step(time, list(found.schedule), where="post", color=COLORS["schedules"])
    axes[0].set_ylabel("mode")
    axes[0].set_yticks(range(cfg.task.num_modes), [f"{level:+.0f} N" for level in levels])
    axes[0].set_title(f"J = {found.cost:.2f}, iLQR {best.cost:.2f}", fontsize=10)
    force = best.controls[:, 0].numpy() * cfg.task.params.gear
    axes[1].plot(time, force, color=COLORS["mppi"], label="iLQR")
    axes[1].step(
        time, levels[list(found.schedule)], where="post", color=COLORS["schedules"], label="schedule"
    )
    axes[1].set_ylabel("force [N]")
    axes[1].set_xlabel("time [s]")
    axes[1].legend(fontsize=8)
    save(figure, path)


def table(rows: list[Row], cfg: StudyCfg) -> Table:
    """Mean and standard deviation over seeds: gap, receding-horizon cost, and what they depend on."""
    view = Table(title="the cartpole")
    for name in ("", *NAMES.values()):
        view.add_column(name, justify="right")

    def line(label: str, cells: list[list[float]]) -> None:
        view.add_row(label, *(f"{np.mean(c):.3f} ± {np.std(c):.3f}" if c else "" for c in cells))

    for part, label in (("solve", "gap"), ("loop", "run")):
        for horizon in sorted(cfg.horizons):
            picked = [pick(rows, cfg, part, planner)[horizon] for planner in NAMES]
            values = [[gap(rows, r) if part == "solve" else r.cost for r in each] for each in picked]
            line(f"{label}, T = {horizon}", values)
            limit = horizon * (cfg.rollouts if part == "solve" else cfg.loop.steps * cfg.loop.rollouts)
            line(
                f"share of the limit used, T = {horizon}",
                [[r.control_steps / limit for r in each] for each in picked],
            )
    for part, label in (("solve", "gap"), ("loop", "run")):
        for horizon in cfg.compare:
            here = of(rows, part=part, horizon=horizon)

            def cells(planner: str, count: int, angle: float, here: list[Row] = here) -> list[float]:
                mine = of(here, planner=planner, num_modes=count, angle=angle)
                return [gap(rows, row) if row.job.part == "solve" else row.cost for row in mine]

            for count in cfg.num_modes:
                line(f"{label}, T = {horizon}, {count} modes", [cells("schedules", count, cfg.task.angle)])
            for angle in cfg.angles:
                found = [cells(each, cfg.task.num_modes, angle) for each in NAMES]
                line(f"{label}, T = {horizon}, from {np.degrees(angle):.0f} deg", found)
    return view
