"""One flip as the filters see it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from tools.estimators.cheetah import Cheetah
from tools.estimators.invariant import Invariant
from tools.estimators.measure import outputs, play, truth
from tools.estimators.reference import run
from tools.estimators.sensors import sense
from tools.estimators.simulate import simulate
from tools.figures import save

COLORS = {"ours": "#2a6f97", "cheetah": "#d1495b", "invariant": "#edae49"}


def draw(path: Path, seconds: float, seed: int) -> None:
    """Velocity and its error, error of the gravity direction, height; shaded: no foot on the ground."""
    log = simulate("flip", seconds, seed)
    readings = sense(log, seed)
    estimates, _ = play(readings)
    t, true = readings.t, truth(log, readings.row)
    found = {
        "ours": outputs(estimates),
        "cheetah": run(Cheetah(), readings),
        "invariant": run(Invariant(), readings),
    }
    sigma = np.full(len(t), np.nan)
    for i, e in enumerate(estimates):
        if e is not None:
            sigma[i] = np.sqrt(np.trace(e.velocity_covariance()))
    figure, axes = plt.subplots(4, 1, sharex=True, figsize=(9, 8.5), constrained_layout=True)
    flight = ~(log.force[readings.row] > 1.0).any(1)
    for axis in axes:
        axis.fill_between(t, 0, 1, where=flight, transform=axis.get_xaxis_transform(), color="0.88", lw=0)
    for name, out in reversed(found.items()):
        color = COLORS[name]
        error = np.linalg.norm(out[:, :3] - true[:, :3], axis=1)
        tilt = np.degrees(np.arccos(np.clip((out[:, 3:6] * true[:, 3:6]).sum(1), -1, 1)))
        axes[0].plot(t, out[:, 0], color=color, lw=1, label=name)
        axes[1].semilogy(t, error, color=color, lw=1)
        axes[2].plot(t, tilt, color=color, lw=1)
        axes[3].plot(t, 1e3 * (out[:, 6] - true[:, 6]), color=color, lw=1)
    axes[0].plot(t, true[:, 0], color="black", lw=1, ls="--", label="true")
    axes[1].semilogy(t, sigma, color="black", lw=0.8, label="ours, its own standard deviation")
    axes[1].set_ylim(1e-3, 1)
    labels = (
        "velocity along x [m/s]",
        "velocity error [m/s]",
        "gravity error [deg]",
        "height error [mm]",
    )
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
    axes[0].legend(fontsize=8, ncols=2)
    axes[1].legend(fontsize=8)
    axes[0].set_title(f"foot stand, flip, handstand (seed {seed}); shaded: no foot touches", fontsize=10)
    axes[-1].set_xlabel("time [s]")
    save(figure, path)
