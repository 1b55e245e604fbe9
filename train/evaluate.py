"""Measure a policy: `python train/evaluate.py POLICY.onnx --starts stance`."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
import tyro  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc.cli import one_line_errors  # noqa: E402
from hmc.go2.model import load_model  # noqa: E402
from hmc.go2.policy import Policy  # noqa: E402
from hmc.go2.stances import STANCES, Stance  # noqa: E402
from hmc.sim.base import Sim  # noqa: E402
from hmc.sim.mujoco import MujocoSim  # noqa: E402
from train.starts import Starts, StartsCfg  # noqa: E402

# name -> (time to reach the stance, time to hold it from then on) [s]
PROTOCOLS = {"stance": (0.5, 9.5), "home": (3.0, 5.0), "recorded": (3.0, 5.0)}


@dataclass(frozen=True)
class Score:
    """Successes of a number of episodes, with the 95 % Wilson interval of the rate."""

    success: int
    episodes: int

    @property
    def rate(self) -> float:
        """Share of episodes that succeeded."""
        return self.success / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval (Wilson 1927)."""
        n, p, z = self.episodes, self.rate, 1.959964
        middle = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return middle - half, middle + half

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.success} of {self.episodes} ({self.rate:.1%}; 95 % interval {low:.1%} to {high:.1%})"


def held_over_time(sim: Sim, policy: Policy, stance: Stance, x: Tensor, u: Tensor, steps: int) -> Tensor:
    """Whether the stance is held after each step under the policy, (steps, n) bool."""
    sim.reset(x, u)
    k = torch.zeros(len(x), dtype=torch.long)
    memory = policy.reset(sim.x(), sim.u(), k)
    held = []
    for step in range(steps):
        action, memory = policy.act(sim.x(), sim.u(), memory, k + step)
        sim.step(action)
        held.append(stance.held(sim.x()))
    return torch.stack(held)


def reached_and_kept(held: Tensor, reach: int, keep: int) -> Tensor:
    """Episodes (steps, n) in which `keep` steps in a row are held, beginning within `reach` steps, (n,)."""
    run = torch.zeros(held.shape[1], dtype=torch.long)
    good = torch.zeros(held.shape[1], dtype=torch.bool)
    for step, now in enumerate(held):
        run = torch.where(now, run + 1, torch.zeros_like(run))
        good |= (run >= keep) & (step + 1 - keep <= reach)
    return good


@torch.no_grad()
def succeeded(policy: Policy, starts: Starts, protocol: str, episodes: int, threads: int) -> Tensor:
    """Which of `episodes` are successes under one of PROTOCOLS, (episodes,) bool."""
    start = starts.sample(episodes)
    sim = MujocoSim(load_model(), episodes, threads=threads)
    reach, keep = (round(seconds / sim.dt) for seconds in PROTOCOLS[protocol])
    held = held_over_time(sim, policy, starts.stance, start.x, start.u, reach + keep)
    return reached_and_kept(held, reach, keep)


def by_moment(good: Tensor, after: Tensor) -> dict[int, Score]:
    """Scores of recorded starts apart by the control steps of the jump after which they were recorded.

    Args:
        good: successes, (n,) bool, of the first n records.
        after: those control steps, one a record.
    """
    moments = after[: len(good)]
    return {
        moment: Score(int(good[moments == moment].sum()), int((moments == moment).sum()))
        for moment in moments.unique().tolist()
    }


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        policy: ONNX file.
        starts: stance: the disturbed stance, to be held for 10 s; home: the four-legged stand, stance
            reached within 3 s and held 5 s; recorded: states of --records, likewise.
        episodes: number of episodes.
        seed: of the starts.
        records: file of recorded states, as tools/record_flips.py writes it, one an episode.
        threads: of the engine; 0 for all cores.
        json: also write the result here.
    """

    policy: tyro.conf.Positional[Path]
    starts: Literal["stance", "home", "recorded"] = "stance"
    episodes: int = 500
    seed: int = 1000
    records: Path | None = None
    threads: int = 0
    json: Path | None = None


def set_up(args: Args) -> tuple[Policy, Starts]:
    """The policy and the states it begins from."""
    policy = Policy(args.policy)
    shares = {"stance": 0.0, "way": 0.0, "home": 0.0, "recorded": 0.0, args.starts: 1.0}
    cfg = StartsCfg(**shares, records=str(args.records.resolve()) if args.records else "")
    starts = Starts(STANCES[policy.metadata["mode"]], cfg, torch.device("cpu"), unlocked=True)
    if args.starts == "recorded" and starts.records is not None and len(starts.records["x"]) < args.episodes:
        raise ValueError(
            f"{args.records} has {len(starts.records['x'])} states, too few for {args.episodes} episodes of "
            "one each: record more, or ask for fewer --episodes"
        )
    return policy, starts


def main(args: Args) -> None:
    """Measure and print."""
    torch.manual_seed(args.seed)
    with one_line_errors():
        policy, starts = set_up(args)
    good = succeeded(policy, starts, args.starts, args.episodes, args.threads)
    result = Score(int(good.sum()), args.episodes)
    reach, keep = PROTOCOLS[args.starts]
    print(f"{policy.metadata['mode']} from {args.starts}: within {reach} s and held {keep} s: {result}")
    if args.starts == "recorded" and starts.records is not None and "after" in starts.records:
        for moment, part in by_moment(good, starts.records["after"]).items():
            print(f"  after {moment} steps of the jump: {part}")
    if args.json is not None:
        low, high = result.interval
        data = {"success": result.success, "episodes": result.episodes, "low": low, "high": high}
        args.json.write_text(json.dumps(data) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Args))
