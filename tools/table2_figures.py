"""Figures of the comparison of controllers: where their robots were, which modes ran, what it cost."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

from hmc.go2.model import DT
from hmc.go2.observe import pitch
from tools.figures import COLORS, save
from tools.table2_study import CONTROLLERS, Table2Cfg, jobs

OTHER = "#5b7db1"  # a controller without modes


class Trace:
    """One recorded run.

    Attributes:
        pitch: [deg], unwrapped over time, (n,).
        rate: of the pitch, the base's angular velocity about its y axis [rad/s], (n,).
        modes: names, (n,).
        cost: executed so far, (n,).
    """

    def __init__(self, path: Path):
        with np.load(path) as data:
            x, self.modes = torch.from_numpy(data["x"])[:-1], data["modes"]
            self.cost = data["terms"].sum(1).cumsum()
        self.pitch = np.degrees(np.unwrap(pitch(x.double()).numpy()))
        self.rate = x[:, 23].numpy()


def draw(out: Path, runs: Path, cfg: Table2Cfg) -> None:
    """table2_visited.png, table2_modes.png and table2_cost.png into `out`, from the traces in `runs`."""
    traces: dict[str, list[Trace]] = {}
    for job in jobs(cfg):
        traces.setdefault(job.controller, []).append(Trace(runs / f"{job.controller}_{job.seed}.npz"))
    _visited(out / "table2_visited.png", traces)
    _timelines(out / "table2_modes.png", traces, cfg)
    _costs(out / "table2_cost.png", traces, cfg)


def _visited(path: Path, traces: dict[str, list[Trace]]) -> None:
    """Pitch and pitch rate of every control step, coloured by the mode that ran."""
    columns = 4
    rows = -(-len(traces) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(11, 2.7 * rows), sharex=True, sharey=True, constrained_layout=True
    )
    for axis in axes.flat[len(traces) :]:
        axis.set_visible(False)
    for axis, (name, mine) in zip(axes.flat, traces.items(), strict=False):
        angle, rate, mode = (
            np.concatenate([getattr(t, part) for t in mine]) for part in ("pitch", "rate", "modes")
        )
        for each in dict.fromkeys(mode.tolist()):
            axis.scatter(
                angle[mode == each], rate[mode == each], s=3, color=COLORS.get(each, OTHER), label=each
            )
        axis.set_title(CONTROLLERS[name], fontsize=9)
        axis.set_xlim(-280, 280)
        axis.set_xticks([-180, -90, 0, 90, 180])
        axis.set_ylim(-12, 16)
        axis.legend(fontsize=7, markerscale=3, loc="upper left")
    figure.supxlabel("pitch [deg]: -90 foot stand, +90 handstand", fontsize=9)
    figure.supylabel("pitch rate [rad/s]", fontsize=9)
    save(figure, path)


def _timelines(path: Path, traces: dict[str, list[Trace]], cfg: Table2Cfg) -> None:
    """The mode of each step of each trial as a bar, the pitch as a line in it."""
    figure, axis = plt.subplots(figsize=(9, 6), constrained_layout=True)
    labels, row = [], 0
    for name, mine in traces.items():
        labels.append((row + (len(mine) - 1) / 2, CONTROLLERS[name]))
        for trace in mine:
            _bar(axis, trace, row)
            row += 1
        row += 1
    axis.axvline(cfg.flip.task.command * DT, color="black", linestyle=":", linewidth=1)
    axis.set_yticks([at for at, _ in labels], [text for _, text in labels], fontsize=8)
    axis.set_xlabel("time [s]; dotted: the command; line: pitch from -90 to +90 degrees")
    axis.invert_yaxis()
    axis.margins(x=0)
    save(figure, path)


def _bar(axis: Axes, trace: Trace, row: int) -> None:
    modes, start = trace.modes.tolist(), 0
    for step in range(1, len(modes) + 1):
        if step == len(modes) or modes[step] != modes[start]:
            axis.barh(
                row,
                (step - start) * DT,
                left=start * DT,
                height=0.9,
                color=COLORS.get(modes[start], OTHER),
                alpha=0.6,
            )
            start = step
    share = np.clip(trace.pitch, -90, 90) / 90
    axis.plot(np.arange(len(modes)) * DT, row - 0.4 * share, color="black", linewidth=0.7)


def _costs(path: Path, traces: dict[str, list[Trace]], cfg: Table2Cfg) -> None:
    """Cost executed so far, mean and range of the trials."""
    figure, axis = plt.subplots(figsize=(8, 4), constrained_layout=True)
    for name, mine in traces.items():
        costs = np.stack([trace.cost for trace in mine])
        time = np.arange(costs.shape[1]) * DT
        (line,) = axis.plot(time, costs.mean(0), label=CONTROLLERS[name])
        axis.fill_between(time, costs.min(0), costs.max(0), alpha=0.2, color=line.get_color())
    axis.axvline(cfg.flip.task.command * DT, color="black", linestyle=":", linewidth=1)
    axis.set_xlabel("time [s]; dotted: the command")
    axis.set_ylabel("cost so far")
    axis.set_yscale("symlog", linthresh=1.0)
    axis.set_ylim(bottom=0.0)
    axis.legend(fontsize=8)
    axis.margins(x=0)
    save(figure, path)
