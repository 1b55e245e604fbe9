"""Search the motion that turns a robot on its back onto its feet or belly: `python tools/roll_motion.py`.

The cross-entropy method over a few points of all twelve joints, from states of robots that were dropped and
lie on their backs. What it finds belongs into cfg/showreel.toml; it prints how many other robots it turns.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc.cli import one_line_errors  # noqa: E402
from hmc.go2 import model as go2  # noqa: E402
from hmc.go2.course import RollCfg  # noqa: E402
from hmc.sim.mujoco import MujocoSim  # noqa: E402
from train.fallen import dropped  # noqa: E402
from train.score import Score  # noqa: E402

REST = 15  # control steps after the motion until it is judged
UPRIGHT = 0.7  # cosine of the tilt that is as good as any
TURNED = 0.3  # cosine of the tilt from which on a robot is no longer on its back or side


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        points: of the motion.
        spacing: control steps between them.
        robots: on their backs that a motion is tried on.
        samples: motions an iteration.
        elites: best of them, that the next ones are drawn around.
        iterations: number of iterations.
        validate: other robots that the result is tried on.
        seed: of robots and motions.
        threads: of the engine; 0 for all cores.
    """

    points: int = 4
    spacing: int = 12
    robots: int = 16
    samples: int = 40
    elites: int = 6
    iterations: int = 6
    validate: int = 200
    seed: int = 0
    threads: int = 0


def on_their_backs(n: int, threads: int) -> Tensor:
    """States and inputs (n, 37 + 12) of robots that lie on their backs."""
    found: list[Tensor] = []
    while sum(map(len, found)) < n:
        rows = dropped(max(256, 8 * n), threads=threads)
        back = go2.vertical(rows[:, 3:7])[:, 2] < -0.9
        found.append(rows[back & (rows[:, 19:22].norm(dim=1) < 0.1)])
    return torch.cat(found)[:n]


def upright(sim: MujocoSim, rows: Tensor, motions: Tensor) -> Tensor:
    """Cosine of the tilt in which robots (S, 49) end after motions (N, steps, 12), (N, S)."""
    n, s = len(motions), len(rows)
    sim.reset(rows[:, :37].repeat(n, 1), rows[:, 37:].repeat(n, 1))
    for step in range(motions.shape[1] + REST):
        u = motions[:, min(step, motions.shape[1] - 1)]
        sim.step(u.repeat_interleave(s, 0))
    return go2.vertical(sim.x()[:, 3:7].float())[:, 2].nan_to_num(-1.0).reshape(n, s)


def search(args: Args, console: Console) -> Tensor:
    """The best points found, (points, 12) [rad]."""
    rows = on_their_backs(args.robots, args.threads)
    sim = MujocoSim(go2.load_model(), args.robots * args.samples, threads=args.threads)
    mean = go2.HOME.repeat(args.points, 1)
    spread = torch.full_like(mean, 0.8)
    best, top = mean, -1.0
    for iteration in range(args.iterations):
        drawn = mean + spread * torch.randn(args.samples, *mean.shape)
        drawn[0] = best
        drawn = drawn.clamp(go2.Q_LOWER, go2.Q_UPPER)
        motions = torch.stack([RollCfg.through(each, args.spacing) for each in drawn])
        score = upright(sim, rows, motions).clamp(max=UPRIGHT).mean(1)
        order = score.argsort(descending=True)[: args.elites]
        if float(score[order[0]]) > top:
            best, top = drawn[order[0]], float(score[order[0]])
        mean = drawn[order].mean(0)
        spread = 0.6 * spread + 0.4 * drawn[order].std(0) + 0.02
        console.print(f"iteration {iteration + 1} of {args.iterations}: upright {top:.3f} of {UPRIGHT}")
    return best


def main(args: Args) -> None:
    """Search, validate and print."""
    console = Console()
    with one_line_errors():
        if not 1 < args.elites < args.samples:
            raise ValueError(f"elites must be between 2 and the {args.samples} samples, got {args.elites}")
    torch.manual_seed(args.seed)
    points = torch.tensor([[round(v, 3) for v in row] for row in search(args, console).tolist()])
    rows = on_their_backs(args.validate, args.threads)
    sim = MujocoSim(go2.load_model(), args.validate, threads=args.threads)
    turned = upright(sim, rows, RollCfg.through(points, args.spacing)[None])[0] > TURNED
    console.print(f"other robots turned: {Score(int(turned.sum()), args.validate)}", highlight=False)
    print(f"[task.roll]\nspacing = {args.spacing}\npoints = [")
    for row in points.tolist():
        print(f"  [{', '.join(f'{v:.3f}' for v in row)}],")
    print("]")


if __name__ == "__main__":
    main(tyro.cli(Args))
