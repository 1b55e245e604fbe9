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

from hmc.cfg import load  # noqa: E402
from hmc.cli import one_line_errors  # noqa: E402
from hmc.go2.conditions import Conditions, NoiseCfg, Robots  # noqa: E402
from hmc.go2.policy import Policy  # noqa: E402
from hmc.go2.stances import STANCES, Stance  # noqa: E402
from train.score import Score  # noqa: E402
from train.starts import Starts, StartsCfg  # noqa: E402

# name -> (time to reach the stance, time to hold it from then on) [s]
PROTOCOLS = {"stance": (0.5, 9.5), "push": (2.0, 3.0), "home": (3.0, 5.0), "recorded": (3.0, 5.0)}
SETTLE = 1.0  # s in the stance before a push


@dataclass(frozen=True)
class Held:
    """A batch of episodes.

    Attributes:
        held: whether the stance is held after each step, (steps, n) bool.
        power: sum of |torque x speed| over the joints, mean of all steps in which it is held [W].
        rate: change of the joint targets from step to step, root mean square of them likewise [rad].
    """

    held: Tensor
    power: float
    rate: float


def held_over_time(robots: Robots, policy: Policy, stance: Stance, steps: int, push: Tensor) -> Held:
    """Run the policy on what the robots believe.

    Args:
        robots: n of them.
        policy: to be run.
        stance: to be held.
        steps: control steps.
        push: what all get after `SETTLE`: speed [m/s] and direction [rad], (2, n).
    """
    k = torch.zeros(len(push[0]), dtype=torch.long)
    u = robots.u
    memory = policy.reset(robots.estimate(), u, k)
    held, power, rate = [], [], []
    for step in range(steps):
        if step == round(SETTLE / robots.sim.dt) and bool((push[0] > 0).any()):
            robots.push(*push)
        action, memory = policy.act(robots.estimate(), u, memory, k + step)
        robots.step(action)
        x = robots.x
        held.append(stance.held(x))
        power.append((robots.sim.actuator_force() * x[:, 25:37]).abs().sum(1)[held[-1]])
        rate.append((action - u).square().mean(1)[held[-1]])
        u = action
    return Held(torch.stack(held), float(torch.cat(power).mean()), float(torch.cat(rate).mean().sqrt()))


def reached_and_kept(held: Tensor, reach: int, keep: int) -> Tensor:
    """Episodes (steps, n) in which `keep` steps in a row are held, beginning within `reach` steps, (n,)."""
    run = torch.zeros(held.shape[1], dtype=torch.long)
    good = torch.zeros(held.shape[1], dtype=torch.bool)
    for step, now in enumerate(held):
        run = torch.where(now, run + 1, torch.zeros_like(run))
        good |= (run >= keep) & (step + 1 - keep <= reach)
    return good


@torch.no_grad()
def measured(
    policy: Policy, starts: Starts, protocol: str, episodes: int, conditions: Conditions, threads: int
) -> tuple[Tensor, Held]:
    """Which of `episodes` are successes under one of PROTOCOLS, (episodes,) bool, and what was measured."""
    start = starts.sample(episodes)
    robots = Robots(conditions, start.x, start.u, seed=int(torch.randint(2**31, ())), threads=threads)
    reach, keep = (round(seconds / robots.sim.dt) for seconds in PROTOCOLS[protocol])
    push, before = torch.zeros(2, episodes), 0
    if protocol == "push":
        before = round(SETTLE / robots.sim.dt)
        push = torch.stack([torch.full((episodes,), conditions.push), 2 * math.pi * torch.rand(episodes)])
    found = held_over_time(robots, policy, starts.stance, before + reach + keep, push)
    return reached_and_kept(found.held[before:], reach, keep), found


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
        starts: stance: the disturbed stance, to be held for 10 s; push: likewise, pushed after 1 s, held
            again within 2 s and for 3 s; home: the four-legged stand, stance reached within 3 s and held
            5 s; recorded: states of --records, likewise.
        conditions: a file with a table of this name, such as cfg/robustness.toml: other robots, noise, the
            speed of pushes; by default the model itself, and pushes of 0.5 m/s.
        episodes: number of episodes.
        seed: of the starts.
        records: file of recorded states, as tools/record_flips.py writes it, one an episode.
        threads: of the engine; 0 for all cores.
        json: also write the result here.
    """

    policy: tyro.conf.Positional[Path]
    starts: Literal["stance", "push", "home", "recorded"] = "stance"
    conditions: Path | None = None
    episodes: int = 500
    seed: int = 1000
    records: Path | None = None
    threads: int = 0
    json: Path | None = None


def set_up(args: Args) -> tuple[Policy, Starts]:
    """The policy and the states it begins from."""
    policy = Policy(args.policy)
    shares = {"stance": 0.0, "way": 0.0, "home": 0.0, "recorded": 0.0}
    shares["stance" if args.starts == "push" else args.starts] = 1.0
    cfg = StartsCfg(**shares, records=str(args.records.resolve()) if args.records else "")
    starts = Starts(STANCES[policy.network.mode], cfg, torch.device("cpu"), unlocked=True)
    if args.starts == "recorded" and starts.records is not None and len(starts.records["x"]) < args.episodes:
        raise ValueError(
            f"{args.records} has {len(starts.records['x'])} states, too few for {args.episodes} episodes of "
            "one each: record more, or ask for fewer --episodes"
        )
    return policy, starts


def conditions_of(path: Path | None) -> Conditions:
    """Those of a file, whose other tables are somebody else's; by default the model itself."""
    if path is None:
        return Conditions(noise=NoiseCfg.none(), push=0.5)
    return load(path, Conditions, table="conditions")


def main(args: Args) -> None:
    """Measure and print."""
    torch.manual_seed(args.seed)
    with one_line_errors():
        policy, starts = set_up(args)
        conditions = conditions_of(args.conditions)
    good, found = measured(policy, starts, args.starts, args.episodes, conditions, args.threads)
    result = Score(int(good.sum()), args.episodes)
    reach, keep = PROTOCOLS[args.starts]
    print(f"{policy.network.mode} from {args.starts}: within {reach} s and held {keep} s: {result}")
    print(
        f"  while held: joint power {found.power:.1f} W, targets change by {found.rate:.3f} rad a step (rms)"
    )
    if args.starts == "recorded" and starts.records is not None and "after" in starts.records:
        for moment, part in by_moment(good, starts.records["after"]).items():
            print(f"  after {moment} steps of the jump: {part}")
    if args.json is not None:
        low, high = result.interval
        data = {"success": result.success, "episodes": result.episodes, "low": low, "high": high}
        data |= {"power": found.power, "rate": found.rate}
        args.json.write_text(json.dumps(data) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Args))
