"""Figures of a recorded run, and of a search."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hmc import Plan
from tools.study import whole

COLORS = {
    "foot": "#4c9f70",
    "jump": "#d1495b",
    "hand": "#edae49",
    "getup": "#6d597a",
    "stand": "#adb5bd",
    "walk": "#457b9d",
}


def timeline(
    path: Path,
    modes: Sequence[str],
    pitch: np.ndarray,
    height: np.ndarray,
    commands: Sequence[float],
    dt: float,
    title: str,
) -> None:
    """Pitch and height over time, on bands of the running mode.

    Args:
        path: .png to write.
        modes: name of the mode of each step (n,).
        pitch: [rad] (n,), +90 degrees nose down.
        height: of the base [m] (n,).
        commands: times at which something else is asked for [s].
        dt: control step [s].
        title: of the figure.
    """
    time = np.arange(len(modes)) * dt
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(9, 4.5), constrained_layout=True)
    for axis, values, label in zip(
        axes, (np.degrees(pitch), height), ("pitch [deg]", "base height [m]"), strict=True
    ):
        _bands(axis, modes, dt)
        axis.plot(time, values, color="black", linewidth=1.3)
        for command in commands:
            axis.axvline(command, color="black", linestyle=":", linewidth=1)
        axis.set_ylabel(label)
    axes[0].set_yticks([-90, -45, 0, 45, 90])
    axes[0].set_title(title, fontsize=10)
    axes[1].set_xlabel("time [s]; dotted: a command")
    shown = [name for name in COLORS if name in modes]
    handles = [Rectangle((0, 0), 1, 1, color=COLORS[name], alpha=0.35) for name in shown]
    axes[0].legend(handles, shown, loc="lower right", ncols=3, fontsize=8)
    save(figure, path)


def search(path: Path, plan: Plan) -> None:
    """How a plan of any task came about: its schedule after each accepted step, one below the other.

    The incumbent is on top, what a step overwrote is outlined.
    """
    schedules = plan.schedules
    names = plan.schedule.names or tuple(map(str, range(1 + max(map(max, schedules)))))
    scale = plt.get_cmap("viridis")(np.linspace(0.3, 0.95, len(names)))  # outlines are seen on all of these
    colors = [COLORS.get(name, shade) for name, shade in zip(names, scale, strict=True)]
    figure, axis = plt.subplots(figsize=(9, 0.28 * len(schedules) + 1.2), constrained_layout=True)
    for row, (schedule, cost) in enumerate(zip(schedules, plan.costs, strict=True)):
        for run in schedule.runs():
            axis.barh(row, run.duration, left=run.start, color=colors[run.mode], height=0.7)
        for switch in plan.steps[row - 1][0] if row > 0 else ():
            box = (switch.start, row - 0.35), switch.duration, 0.7
            axis.add_patch(Rectangle(*box, fill=False, linewidth=1.8, edgecolor="black"))
        axis.text(1.01 * len(schedule), row, f"{cost:.5g}", va="center", fontsize=9)
    axis.set_yticks(range(len(schedules)), ["incumbent", *map(str, range(1, len(schedules)))], fontsize=9)
    axis.set_xlim(0, 1.08 * len(plan.schedule))
    axis.set_ylim(len(schedules) - 0.4, -0.6)
    axis.set_xlabel("control step; at the right: cost")
    axis.set_ylabel("accepted steps")
    handles = [Rectangle((0, 0), 1, 1, color=color) for color in colors]
    axis.legend(handles, names, loc="lower left", bbox_to_anchor=(0, 1), ncols=len(names), fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def cost_terms(path: Path, names: Sequence[str], terms: np.ndarray, modes: Sequence[str], dt: float) -> None:
    """Stage cost of each term over time, stacked.

    Args:
        path: .png to write.
        names: of the terms.
        terms: stage cost a second of each step (n, terms).
        modes: name of the mode of each step (n,).
        dt: control step [s].
    """
    figure, axis = plt.subplots(figsize=(9, 3.2), constrained_layout=True)
    _bands(axis, modes, dt)
    axis.stackplot(np.arange(len(terms)) * dt, terms.T, labels=names, alpha=0.85)
    axis.set_ylabel("stage cost")
    axis.set_xlabel("time [s]")
    axis.legend(fontsize=8, ncols=3)
    save(figure, path)


def _bands(axis: Axes, modes: Sequence[str], dt: float) -> None:
    start = 0
    for step in range(1, len(modes) + 1):
        if step == len(modes) or modes[step] != modes[start]:
            axis.axvspan(
                start * dt, step * dt, color=COLORS.get(modes[start], "gray"), alpha=0.25, linewidth=0
            )
            start = step
    axis.margins(x=0)


def save(figure: Figure, path: Path) -> None:
    """Write a figure, in the format of the file's name, and close it."""
    with whole(path) as partial:
        figure.savefig(partial, dpi=130)
    plt.close(figure)
