"""Record states met in flips: `python tools/record_flips.py --out out/flips.pt`.

The foot mode holds its stance, the jump mode takes over, and the state is kept that the robot is in after
a random number of steps. Policies are trained (train/starts.py) and measured (train/evaluate.py) on them.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
from rich.progress import track  # noqa: E402

from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.task import flip_task, make_sim  # noqa: E402
from tools.closed_loop import RunCfg  # noqa: E402
from tools.jump_guess import settled_stands  # noqa: E402
from tools.study import at_least_one, at_one_go, can_write, whole  # noqa: E402


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        out: file to write: states "x" (n, 37), inputs "u" (n, 12), steps since the jump began "after" (n,),
            and the command that made it.
        states: number of jumps, one state of each.
        first: fewest steps of a jump before its state is kept.
        last: most.
        seed: of everything random; training and measurement need different ones.
        threads: of the engine; 0 for all cores.
        set: overrides of cfg/flip.toml.
    """

    out: Path
    states: int = 500
    first: int = 18
    last: int = 30
    seed: int = 0
    threads: int = 0
    set: tuple[str, ...] = ()


@at_one_go
@torch.no_grad()
def main(args: Args) -> int:
    """Jump, keep, write."""
    with one_line_errors():
        torch.manual_seed(args.seed)
        at_least_one(args, "states")
        if not 0 <= args.first <= args.last:
            raise ValueError(f"first and last: expected 0 <= first <= last, got {args.first} and {args.last}")
        can_write(args.out)
        cfg = load(ROOT / "cfg" / "flip.toml", RunCfg, args.set)
        task = flip_task(cfg.task, seed=args.seed, threads=args.threads)
        sim = make_sim(args.states, threads=args.threads)
        x, u = settled_stands(task, cfg, sim, 1_000_000 * (args.seed + 1))
    jump = task.modes["jump"]
    sim.reset(x, u)
    after = torch.randint(args.first, args.last + 1, (args.states,))
    # every robot began its jump at a step of its own, so that their noise differs
    k = torch.arange(args.states) * 1000
    memory = jump.reset(x, u, k)
    kept_x, kept_u = x.clone(), u.clone()
    for step in track(range(args.last + 1), "jumping"):
        now = after == step
        kept_x[now], kept_u[now] = sim.x()[now], sim.u()[now]
        action, memory = jump.act(sim.x(), sim.u(), memory, k + step)
        sim.step(action)
    finite = kept_x.isfinite().all(1)
    kept = {"x": kept_x[finite].float(), "u": kept_u[finite].float(), "after": after[finite]}
    command = shlex.join(["python", "tools/record_flips.py", *sys.argv[1:]])
    with whole(args.out) as partial:
        torch.save({**kept, "command": command}, partial)
    print(f"{args.out}: {int(finite.sum())} states")
    return 0


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
