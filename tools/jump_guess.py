"""Search the jump's first guess with the cross-entropy method: `python tools/jump_guess.py`.

Judged by what it is for: from foot stands as the foot mode holds them, the guess runs open loop, the
hand mode takes over after each of several durations, and what counts is how the robot stands in the end.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2 import model as go2  # noqa: E402
from hmc.go2.conditions import Conditions  # noqa: E402
from hmc.go2.stances import FOOTSTAND, HANDSTAND  # noqa: E402
from hmc.go2.task import dense_guess, flip_task  # noqa: E402
from hmc.go2.variants import Variant, VariantsCfg, draw  # noqa: E402
from hmc.sim.base import Sim  # noqa: E402
from hmc.sim.mujoco import MujocoSim  # noqa: E402
from hmc.task import Task  # noqa: E402
from tools.closed_loop import RunCfg, disturbed_start  # noqa: E402
from tools.study import at_least_one, at_one_go, can_write, whole  # noqa: E402


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        iterations: of the cross-entropy method.
        candidates: an iteration.
        elite: best candidates that the next iteration is drawn around, two or more.
        starts: foot stands that every candidate jumps from, new ones each iteration.
        durations: of the jump, control steps.
        points: of the guess.
        spread: initial standard deviation of a point [rad].
        settle: control steps under the hand mode, at whose end the robot is judged.
        seed: of everything random.
        threads: of the engine; 0 for all cores.
        out: file to write the points to, as TOML, after each iteration.
        warm: begin with the guess in cfg/flip.toml.
        conditions: a file with a table of this name, such as cfg/robustness.toml: every start is that of
            another robot of its `variants`; by default all are the nominal one.
        set: overrides of cfg/flip.toml.
    """

    iterations: int = 40
    candidates: int = 40
    elite: int = 8
    starts: int = 4
    durations: tuple[int, ...] = (20, 24, 28)
    points: int = 6
    spread: float = 0.4
    settle: int = 60
    seed: int = 0
    threads: int = 0
    out: Path = ROOT / "out" / "jump_guess.toml"
    warm: bool = False
    conditions: Path | None = None
    set: tuple[str, ...] = ()


def robots_sim(robots: list[Variant], each: int, threads: int) -> MujocoSim:
    """Worlds of these robots in turn, `each` times over."""
    return MujocoSim(
        go2.load_model(),
        each * len(robots),
        threads=threads,
        latency=[robot.late() for robot in robots] * each,
        models=[robot.model() for robot in robots] * each,
    )


def settled_stands(task: Task, cfg: RunCfg, sim: Sim, seed: int) -> tuple[Tensor, Tensor]:
    """Foot stands after 10 to 60 steps of the foot mode, one a world: states (n, 37), inputs (n, 12).

    A world whose own is no foot stand gets another one's.
    """
    foot, n = task.modes["foot"], sim.num_worlds
    pairs = [disturbed_start(cfg.start, seed + i) for i in range(n)]
    sim.reset(torch.stack([x for x, _ in pairs]), torch.stack([u for _, u in pairs]))
    k = torch.zeros(n, dtype=torch.long)
    memory = foot.reset(sim.x(), sim.u(), k)
    stop = torch.randint(10, 60, (n,))
    x, u = sim.x(), sim.u()
    for step in range(60):
        x = torch.where((stop == step)[:, None], sim.x(), x)
        u = torch.where((stop == step)[:, None], sim.u(), u)
        action, memory = foot.act(sim.x(), sim.u(), memory, k + step)
        sim.step(action)
    good = FOOTSTAND.held(x).nonzero().squeeze(1)
    if len(good) == 0:
        raise ValueError(
            "the foot mode holds none of the starting stands: give a trained policy, task.foot=FILE"
        )
    pick = torch.arange(n)
    bad = ~torch.isin(pick, good)
    pick[bad] = good[torch.randint(len(good), (int(bad.sum()),))]
    return x[pick], u[pick]


def jump_and_catch(
    sim: Sim, task: Task, x: Tensor, u: Tensor, inputs: Tensor, durations: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Open-loop jumps with the hand mode taking over.

    Args:
        sim: n worlds.
        task: its hand mode is used.
        x, u: where each begins (n, 37), (n, 12).
        inputs: targets of the jump (n, G, 12).
        durations: steps before the hand mode takes over (n,).
        steps: to simulate.

    Returns:
        Final state (n, 37) and whether trunk, thigh or shin touched the floor (n,) bool.
    """
    hand = task.modes["hand"]
    sim.reset(x, u)
    memory = torch.zeros(len(x), hand.memory_size, dtype=x.dtype)
    touched = torch.zeros(len(x), dtype=torch.bool)
    k = torch.zeros(len(x), dtype=torch.long)
    for step in range(steps):
        action = inputs[:, min(step, inputs.shape[1] - 1)].clone()
        now = (durations == step).nonzero().squeeze(1)
        memory[now] = hand.reset(sim.x(now), sim.u(now), k[now])
        over = (durations <= step).nonzero().squeeze(1)
        if len(over):
            action[over], memory[over] = hand.act(sim.x(over), sim.u(over), memory[over], k[over])
        sim.step(action)
        gap = go2.clearances(sim.x())
        touched |= (gap["trunk"] < 0) | (gap["thigh"] < 0).any(1) | (gap["calf"] < 0).any(1)
    return sim.x(), touched


def badness(x: Tensor, touched: Tensor) -> Tensor:
    """0 for a clean, still handstand; grows with tilt, low base, speed and a touch on the way, (n,)."""
    tilt = 1 - HANDSTAND.uprightness(x)
    low = (go2.STANCE_HEIGHT - x[:, 2]).clamp(min=0)
    return 2 * tilt + 4 * low + 0.1 * x[:, 19:25].norm(dim=1).clamp(max=5) + 1.0 * touched


def check(args: Args) -> None:
    """Raise a ValueError unless there is something to search for, and a file to write it to."""
    at_least_one(args, "iterations", "candidates", "starts", "points", "settle")
    if not args.durations or min(args.durations) < 1:
        raise ValueError(f"durations: expected one or more of at least 1 control step, got {args.durations}")
    if not 2 <= args.elite <= args.candidates:  # they have a standard deviation
        raise ValueError(f"elite must be 2 to {args.candidates}, the number of candidates, got {args.elite}")
    can_write(args.out)


@at_one_go
@torch.no_grad()
def main(args: Args) -> int:
    """Search, show progress, write the best mean."""
    with one_line_errors():
        torch.manual_seed(args.seed)
        check(args)
        cfg = load(ROOT / "cfg" / "flip.toml", RunCfg, args.set)
        task = flip_task(cfg.task, threads=args.threads)
        variants = VariantsCfg()
        if args.conditions is not None:
            variants = load(args.conditions, Conditions, table="conditions").variants
    generator = torch.Generator().manual_seed(args.seed)
    first = torch.tensor([[0.82, -1.6, 2.12, -1.16]], dtype=torch.float64)
    last = torch.tensor([[-0.966, -1.16, 1.7, -1.853]], dtype=torch.float64)
    w = torch.linspace(0, 1, args.points, dtype=torch.float64)[:, None]
    mean = torch.tensor(cfg.task.jump.guess, dtype=torch.float64) if args.warm else (1 - w) * first + w * last
    spread = torch.full_like(mean, args.spread)
    # worlds: candidates, durations, starts, the last ones next to each other
    durations = torch.tensor(args.durations).repeat_interleave(args.starts).repeat(args.candidates)
    each = args.starts * len(args.durations)
    console = Console()
    for iteration in range(args.iterations):
        with one_line_errors():
            seed = 1000 * args.seed + iteration * args.starts
            robots = draw(variants, args.starts, generator)
            x, u = settled_stands(task, cfg, robots_sim(robots, 1, args.threads), seed)
        points = mean + spread * torch.randn(args.candidates, *mean.shape, dtype=torch.float64)
        points[0] = mean
        inputs = torch.stack([dense_guess(p, cfg.task.jump.spacing) for p in points])
        inputs = inputs.clamp(go2.Q_LOWER.double(), go2.Q_UPPER.double()).repeat_interleave(each, 0)
        repeats = args.candidates * len(args.durations)
        sim, xs, us = robots_sim(robots, repeats, args.threads), x.repeat(repeats, 1), u.repeat(repeats, 1)
        end, touched = jump_and_catch(sim, task, xs, us, inputs, durations, max(args.durations) + args.settle)
        bad = torch.nan_to_num(badness(end, touched), nan=20.0)
        clean = (HANDSTAND.held(end) & ~touched).double().reshape(args.candidates, -1).mean(1)
        score = bad.reshape(args.candidates, -1).mean(1) - clean
        best = score.argsort()[: args.elite]
        mean = 0.3 * mean + 0.7 * points[best].mean(0)
        spread = (0.4 * spread + 0.6 * points[best].std(0)).clamp(min=0.03)
        console.print(
            f"{iteration + 1}/{args.iterations}: mean guess {float(clean[0]):.0%} caught, "
            f"best {float(clean.max()):.0%}, spread {float(spread.mean()):.2f}"
        )
        rows = ",\n".join("  [" + ", ".join(f"{v:.3f}" for v in row) + "]" for row in mean.tolist())
        with whole(args.out) as partial:
            partial.write_text(f"guess = [\n{rows},\n]\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
