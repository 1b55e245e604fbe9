"""Measure a policy: `python train/evaluate.py POLICY.onnx --starts stance`."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
import tyro  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2 import model as go2  # noqa: E402
from hmc.go2.conditions import Conditions, NoiseCfg, Robots  # noqa: E402
from hmc.go2.network import Network  # noqa: E402
from hmc.go2.policy import Policy  # noqa: E402
from hmc.go2.stances import HOLDS, STANCES, Stance  # noqa: E402
from train.fallen import LegsStarts, LegsStartsCfg  # noqa: E402
from train.legs import CommandCfg, drawn, heading_velocity  # noqa: E402
from train.score import Score  # noqa: E402
from train.starts import Starts, StartsCfg  # noqa: E402

# name -> (time to reach the stance, time to hold it from then on) [s]
PROTOCOLS = {
    "stance": (0.5, 9.5),
    "push": (2.0, 3.0),
    "home": (3.0, 5.0),
    "recorded": (3.0, 5.0),
    "stances": (3.0, 5.0),
    "fallen": (4.0, 3.0),
    "walk": (1.0, 9.0),
}
SETTLE = 1.0  # s before a push, and before a walk is measured
ASTRAY = 0.2  # m/s and rad/s: a mean velocity further than this from the commanded one is not walking as told


@dataclass(frozen=True)
class Held:
    """A batch of episodes.

    Attributes:
        held: whether the stance is held after each step, (steps, n) bool; while walking, whether the robot is
            on its legs.
        velocity: mean after `SETTLE` in the frame of the robot's heading, (n, 3) [m/s, m/s, rad/s].
        power: sum of |torque x speed| over the joints, mean of all steps in which it is held [W].
        rate: change of the joint targets from step to step, root mean square of them likewise [rad].
        speed: of the base over the ground, mean likewise [m/s].
    """

    held: Tensor
    velocity: Tensor
    power: float
    rate: float
    speed: float


def held_over_time(
    robots: Robots, policy: Policy, held: Callable[[Tensor], Tensor], steps: int, push: Tensor
) -> Held:
    """Run the policy on what the robots believe.

    Args:
        robots: n of them.
        policy: to be run.
        held: whether what it is for is the case at states (n, 37), (n,) bool.
        steps: control steps.
        push: what all get after `SETTLE`: speed [m/s] and direction [rad], (2, n).
    """
    k = torch.zeros(len(push[0]), dtype=torch.long)
    u = robots.u
    memory = policy.reset(robots.estimate(), u, k)
    good, velocity, power, rate, speed = [], [], [], [], []
    for step in range(steps):
        if step == round(SETTLE / robots.sim.dt) and bool((push[0] > 0).any()):
            robots.push(*push)
        action, memory = policy.act(robots.estimate(), u, memory, k + step)
        robots.step(action)
        x = robots.x
        good.append(held(x))
        velocity.append(heading_velocity(x))
        power.append((robots.sim.actuator_force() * x[:, 25:37]).abs().sum(1)[good[-1]])
        rate.append((action - u).square().mean(1)[good[-1]])
        speed.append(x[:, 19:21].norm(dim=1)[good[-1]])
        u = action
    return Held(
        torch.stack(good),
        torch.stack(velocity[round(SETTLE / robots.sim.dt) :]).mean(0),
        float(torch.cat(power).mean()),
        float(torch.cat(rate).mean().sqrt()),
        float(torch.cat(speed).mean()),
    )


def on_its_legs(x: Tensor) -> Tensor:
    """Whether the trunk is off the ground and within 53 degrees of level at states x (n, 37), (n,) bool."""
    return (go2.clearances(x)["trunk"] > 0) & (go2.vertical(x[:, 3:7])[:, 2] > 0.6)


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
    policy: Policy,
    starts: Starts | LegsStarts,
    protocol: str,
    episodes: int,
    conditions: Conditions,
    threads: int,
) -> tuple[Tensor, Held]:
    """Which of `episodes` are successes under one of PROTOCOLS, (episodes,) bool, and what was measured."""
    start = starts.sample(episodes)
    robots = Robots(conditions, start.x, start.u, seed=int(torch.randint(2**31, ())), threads=threads)
    reach, keep = (round(seconds / robots.sim.dt) for seconds in PROTOCOLS[protocol])
    push, before = torch.zeros(2, episodes), 0
    if protocol == "push":
        before = round(SETTLE / robots.sim.dt)
        push = torch.stack([torch.full((episodes,), conditions.push), 2 * math.pi * torch.rand(episodes)])
    held = HOLDS[policy.network.mode].held if policy.command is None else on_its_legs
    found = held_over_time(robots, policy, held, before + reach + keep, push)
    good = reached_and_kept(found.held[before:], reach, keep)
    if policy.command is not None:
        off = found.velocity - policy.command(robots.x, torch.zeros(episodes, dtype=torch.long))
        good &= (off[:, :2].norm(dim=1) < ASTRAY) & (off[:, 2].abs() < ASTRAY)
    return good, found


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
        starts: stance: what the mode holds, disturbed, to be held for 10 s; push: likewise, pushed after 1 s,
            held again within 2 s and for 3 s. Of a stance on two legs, home: the four-legged stand, stance
            reached within 3 s and held 5 s; recorded: states of --records, likewise. Of a mode on four legs,
            stances: the stances on two legs, stand reached within 3 s and held 5 s; fallen: as the robot lies
            that was dropped, within 4 s and held 3 s; walk: 10 s on its legs, a command an episode, the mean
            velocity within 0.2 m/s and rad/s of it.
        conditions: a file with a table of this name, such as cfg/robustness.toml: other robots, noise, the
            speed of pushes; by default the model itself, and pushes of 0.5 m/s.
        episodes: number of episodes.
        seed: of the starts.
        records: file of recorded states, as tools/record_flips.py writes it, one an episode.
        threads: of the engine; 0 for all cores.
        json: also write the result here.
    """

    policy: tyro.conf.Positional[Path]
    starts: Literal["stance", "push", "home", "recorded", "stances", "fallen", "walk"] = "stance"
    conditions: Path | None = None
    episodes: int = 500
    seed: int = 1000
    records: Path | None = None
    threads: int = 0
    json: Path | None = None


def set_up(args: Args) -> tuple[Policy, Starts | LegsStarts]:
    """The policy and the states it begins from."""
    network = Network(args.policy)
    if network.mode == "unified":
        raise ValueError(f"{args.policy} is of unified, which has no modes: tools/table2.py measures it")
    if (args.starts == "walk") != bool(network.command):
        raise ValueError(f"{args.policy} is of {network.mode}: --starts walk is for walk, and for it alone")
    if network.mode in STANCES:
        return Policy(args.policy), _stance_starts(args, STANCES[network.mode])
    if args.starts in ("home", "recorded"):
        raise ValueError(f"--starts {args.starts} is of two legs, {args.policy} is of {network.mode}")
    fallen, stances = float(args.starts == "fallen"), float(args.starts == "stances")
    cfg = LegsStartsCfg(standing=1.0 - fallen - stances, fallen=fallen, stances=stances)
    starts = LegsStarts(cfg, torch.device("cpu"))
    commands = drawn(CommandCfg(halt=0.0), args.episodes, torch.device("cpu")).double()
    return Policy(args.policy, command=(lambda x, k: commands) if network.command else None), starts


def _stance_starts(args: Args, stance: Stance) -> Starts:
    """Where episodes of a stance begin."""
    if args.starts in ("stances", "fallen"):
        raise ValueError(f"--starts {args.starts} is of four legs, {args.policy} is of {stance.name}")
    shares = {"stance": 0.0, "way": 0.0, "home": 0.0, "recorded": 0.0}
    shares["stance" if args.starts == "push" else args.starts] = 1.0
    cfg = StartsCfg(**shares, records=str(args.records.resolve()) if args.records else "")
    starts = Starts(stance, cfg, torch.device("cpu"), unlocked=True)
    if args.starts == "recorded" and starts.records is not None and len(starts.records["x"]) < args.episodes:
        raise ValueError(
            f"{args.records} has {len(starts.records['x'])} states, too few for {args.episodes} episodes of "
            "one each: record more, or ask for fewer --episodes"
        )
    return starts


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
        f"  while held: joint power {found.power:.1f} W, speed over the ground {found.speed:.2f} m/s, "
        f"targets change by {found.rate:.3f} rad a step (rms)"
    )
    if isinstance(starts, Starts) and starts.records is not None and "after" in starts.records:
        for moment, part in by_moment(good, starts.records["after"]).items():
            print(f"  after {moment} steps of the jump: {part}")
    if args.json is not None:
        low, high = result.interval
        data = {"success": result.success, "episodes": result.episodes, "low": low, "high": high}
        data |= {"power": found.power, "rate": found.rate, "speed": found.speed}
        args.json.write_text(json.dumps(data) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(command_line(Args))
