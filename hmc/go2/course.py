"""A course for the Go2: get up, stand, walk to a place, foot stand, flip, handstand, as one `Task`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from hmc.cost import Cost
from hmc.go2 import model as go2
from hmc.go2.observe import anchor_of
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import (
    FOOT_TARGET,
    HAND_TARGET,
    STAND_TARGET,
    CostCfg,
    JumpCfg,
    jump_mode,
    make_sim,
    policy_path,
    stance_cost,
)
from hmc.modes import ModeSet
from hmc.rules import Rules
from hmc.task import Task

TARGET = {"stand": STAND_TARGET, "footstand": FOOT_TARGET, "handstand": HAND_TARGET}
CRUISE, SIDEWAYS, TURN = 0.8, 0.3, 1.0  # fastest commands on the way to a place [m/s, m/s, rad/s]
NEAR = 0.3  # m: from here on the robot goes to its place in any direction, without turning towards it


@dataclass(frozen=True)
class GoalCfg:
    """What is asked for over some time.

    Attributes:
        hold: what is to be held.
        seconds: for how long.
        at: where [m]; empty for wherever the robot is.
    """

    hold: Literal["stand", "footstand", "handstand"]
    seconds: float
    at: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.seconds <= 0 or len(self.at) not in (0, 2):
            raise ValueError(
                f"a goal lasts some seconds, at a place [x, y] or none: got {self.seconds} s at {self.at}"
            )


@dataclass(frozen=True)
class CourseCfg:
    """The course.

    Attributes:
        horizon: planner's horizon, control steps.
        goals: in their order; the last one stays.
        cost: weights of Table I.
        level: weight of (1 - cos tilt)^2 on four legs: Table I does not tell a robot on its back from one on
            its feet.
        place: weight of the distance from where the robot is to be [1/m].
    """

    horizon: int = 75
    goals: tuple[GoalCfg, ...] = (GoalCfg("stand", 5.0),)
    cost: CostCfg = field(default_factory=CostCfg)
    level: float = 0.5
    place: float = 1.0

    def __post_init__(self) -> None:
        if not self.goals:
            raise ValueError("a course needs at least one goal, got none")

    def ends(self) -> list[int]:
        """Control step at which each goal ends."""
        steps, end = [], 0
        for goal in self.goals:
            end += round(goal.seconds / go2.DT)
            steps.append(end)
        return steps


def course_cost(cfg: CourseCfg) -> Cost:
    """Table I with the target of each control step's goal, and the terms that four legs need."""
    ends = torch.tensor(cfg.ends()[:-1], dtype=torch.long)
    targets = torch.tensor([TARGET[goal.hold] for goal in cfg.goals])
    places = torch.tensor([goal.at or (0.0, 0.0) for goal in cfg.goals], dtype=torch.float64)
    bound = torch.tensor([bool(goal.at) for goal in cfg.goals])

    def goal(k: Tensor) -> Tensor:
        return torch.bucketize(k, ends, right=True)

    def level(x: Tensor, k: Tensor) -> Tensor:
        up = go2.vertical(x[:, 3:7])[:, 2]
        return cfg.level * torch.where(targets[goal(k)] == STAND_TARGET, (1.0 - up).square(), 0.0)

    def place(x: Tensor, k: Tensor) -> Tensor:
        now = goal(k)
        away = (x[:, :2] - places[now].to(x)).norm(dim=1)
        return cfg.place * torch.where(bound[now], away, 0.0)

    table = stance_cost(cfg.cost, lambda k: targets[goal(k)])
    stage = {
        **table.stage,
        "level": lambda x, u, u_prev, k: level(x, k),
        "place": lambda x, u, u_prev, k: place(x, k),
    }
    terminal = {
        **table.terminal,
        "tail on four legs": lambda x, k: cfg.cost.tail * (level(x, k) + place(x, k)),
    }
    return Cost(stage, terminal, nonnegative=True)


def towards(cfg: CourseCfg) -> Callable[[Tensor, Tensor], Tensor]:
    """What walk is commanded at states (n, 37) and control steps (n,), (n, 3): to the place of the goal."""
    ends = torch.tensor(cfg.ends()[:-1], dtype=torch.long)
    places = torch.tensor([goal.at or (0.0, 0.0) for goal in cfg.goals], dtype=torch.float64)
    bound = torch.tensor([bool(goal.at) for goal in cfg.goals])

    def command(x: Tensor, k: Tensor) -> Tensor:
        goal = torch.bucketize(k, ends, right=True)
        way = places[goal].to(x) - x[:, :2]
        c, s = anchor_of(x)[:, 2:].unbind(1)
        ahead, left = c * way[:, 0] + s * way[:, 1], c * way[:, 1] - s * way[:, 0]
        far = way.norm(dim=1) > NEAR
        turn = torch.where(far, torch.atan2(left, ahead), torch.zeros_like(left))
        # who has to turn far turns first
        forward = torch.where(far & (turn.abs() > 0.8), torch.zeros_like(ahead), ahead)
        told = torch.stack(
            [
                (1.5 * forward).clamp(-0.4, CRUISE),
                (1.5 * left).clamp(-SIDEWAYS, SIDEWAYS),
                (1.5 * turn).clamp(-TURN, TURN),
            ],
            1,
        )
        return torch.where(bound[goal][:, None], told, torch.zeros_like(told))

    return command


def course_task(cfg: CourseCfg, jump: JumpCfg, *, seed: int = 0, threads: int = 0) -> Task:
    """The course with modes getup, stand, walk, foot, jump and hand.

    Nobody says which one runs when. A foot stand may begin on four legs or on two, a jump in the foot stand
    only: all else need not be rolled out.

    Args:
        cfg: settings.
        jump: the jump mode.
        seed: of its noise.
        threads: of the engine and the policies; 0 for all cores.
    """
    sim = partial(make_sim, threads=threads)
    modes = ModeSet(
        [
            Policy(policy_path("getup"), threads=threads),
            Policy(policy_path("stand"), name="stand", threads=threads),
            Policy(policy_path("walk"), threads=threads, command=towards(cfg)),
            Policy(policy_path("footstand"), name="foot", threads=threads),
            jump_mode(jump, sim, seed),
            Policy(policy_path("handstand"), name="hand", threads=threads),
        ]
    )
    rules = Rules(
        dwell={"jump": jump.dwell} if jump.dwell else {},
        guards={
            "walk": lambda x, k: _on_legs(x),
            "foot": lambda x, k: _on_legs(x) | (FOOTSTAND.uprightness(x) > 0.3),
            "jump": lambda x, k: FOOTSTAND.held(x),
        },
    )
    return Task("course", modes, course_cost(cfg), cfg.horizon, sim, rules=rules)


def _on_legs(x: Tensor) -> Tensor:
    """Whether the robot is about upright with its trunk off the ground, (n,) bool, at states x (n, 37)."""
    return (go2.clearances(x)["trunk"] > 0.05) & (go2.vertical(x[:, 3:7])[:, 2] > 0.8)
