"""Look at a run of the robot again: `python tools/replay.py out/deploy/run.mcap`.

Draws what the log holds, and runs its state frames through the estimator once more: with today's code and
settings of the estimator, from the readings that the run believed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from deploy.checks import StateChecks  # noqa: E402
from deploy.estimator import Estimator  # noqa: E402
from deploy.log import metadata, read  # noqa: E402
from deploy.modes import NAMES  # noqa: E402
from deploy.observe import pitch, vertical  # noqa: E402
from deploy.safety import Phase  # noqa: E402
from deploy.settings import DeployCfg, InputCfg  # noqa: E402
from hmc.cfg import override  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        log: run.mcap of deploy/go2.py.
        out: figure to write; default: replay.png beside the log.
    """

    log: tyro.conf.Positional[Path]
    out: Path | None = None


@dataclass(frozen=True)
class Replay:
    """A log and what the estimator makes of it.

    Attributes:
        ticks: control steps, as in the log.
        again: estimated states by the robot's clock [ms], (37,) each, of the estimator run anew.
        refused: frames that are not believed; without those that never came.
    """

    ticks: list[dict[str, Any]]
    again: dict[int, np.ndarray]
    refused: int

    def difference(self) -> tuple[float, float]:
        """Largest difference of height [m] and attitude [rad] between the log's estimate and the new one."""
        rows = [tick for tick in self.ticks if any(tick["variance"]) and tick["ms"] in self.again]
        if not rows:
            return np.nan, np.nan
        old = np.array([tick["x"] for tick in rows])
        new = np.array([self.again[tick["ms"]] for tick in rows])
        height = float(np.abs(old[:, 2] - new[:, 2]).max())
        p, q = old[:, 3:7], new[:, 3:7]  # q and -q are one attitude
        apart = np.sort([np.linalg.norm(p - q, axis=1), np.linalg.norm(p + q, axis=1)], axis=0)
        return height, float(4 * np.arctan2(apart[0], apart[1]).max())


def replay(path: Path) -> Replay:
    """Read a log and run its frames through checks and estimator.

    Raises:
        LogError: not a log of this version.
    """
    ticks: list[dict[str, Any]] = [content for topic, _, content in read(path) if topic == "tick"]
    anew = {tick["anew"] for tick in ticks}  # where the robot had stood up
    checks, estimator = StateChecks(limits(path)), Estimator()
    again: dict[int, np.ndarray] = {}
    for topic, _, content in read(path):
        if topic != "rt/lowstate" or (state := checks.take(content, 0.0)) is None:
            continue
        t = 0.001 * checks.ms
        force = state.foot_force.astype(np.float64)
        found = estimator.update(t, state.gyro, state.acc, state.q, state.dq, state.tau, force)
        if found is not None:
            again[checks.ms] = found.x
        if checks.ms in anew:
            estimator.reset()
    return Replay(ticks, again, sum(count for kind, count in checks.counts.items() if kind != "gap"))


def limits(path: Path) -> InputCfg:
    """What a frame had to be like in the run that wrote a log."""
    lines = metadata(path).get("settings", "").splitlines()
    return override(DeployCfg(), [line for line in lines if line.startswith("input.")]).input


def draw(it: Replay, path: Path) -> None:
    """Phases and modes, pitch and height, speed, targets, lateness."""
    t = np.array([tick["k"] for tick in it.ticks]) * 0.02
    x = np.array([tick["x"] if any(tick["variance"]) else [np.nan] * 37 for tick in it.ticks])  # or unknown
    figure, axes = plt.subplots(5, 1, figsize=(10, 12), sharex=True, layout="constrained")
    axes[0].step(t, [tick["phase"] for tick in it.ticks], where="post")
    axes[0].set_yticks(list(Phase), [phase.name.lower() for phase in Phase])
    modes = axes[0].twinx()
    modes.step(t, [tick["mode"] for tick in it.ticks], where="post", color="C1")
    modes.set_yticks(range(len(NAMES)), NAMES)
    axes[1].plot(t, [np.degrees(pitch(vertical(row))) for row in x[:, 3:7]], label="pitch [deg]")
    axes[1].plot(t, 100 * x[:, 2], label="height [cm]")
    axes[2].plot(t, x[:, 19:22], label=["vx", "vy", "vz"])
    axes[2].set_ylabel("velocity, world [m/s]")
    axes[3].plot(t, [tick["u"] for tick in it.ticks], lw=0.7)
    axes[3].set_ylabel("joint targets [rad]")
    axes[4].semilogy(t, np.maximum([tick["late"] for tick in it.ticks], 1e-2), ".", ms=2)
    axes[4].set_ylabel("lateness [ms]")
    axes[4].set_xlabel("time [s]")
    for axis in axes[1:3]:
        axis.legend()
    figure.savefig(path)
    plt.close(figure)


def main(args: Args) -> None:
    """Replay, draw, print."""
    with one_line_errors():
        it = replay(args.log)
        if not it.ticks:
            raise ValueError(f"log {args.log}: holds no control step")
        out = args.out or args.log.with_name("replay.png")
        draw(it, out)
    height, angle = it.difference()
    print(
        f"{len(it.ticks)} control steps, {len(it.again)} states estimated again, {it.refused} frames refused"
    )
    print(
        f"largest difference from the log: height {1e3 * height:.2f} mm, attitude {np.degrees(angle):.3f} deg"
    )
    print(out)


if __name__ == "__main__":
    main(command_line(Args))
