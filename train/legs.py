"""Learning what is done on four legs: to stand, to get up, to walk as commanded."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.observe import anchor_of
from hmc.go2.stances import STAND
from hmc.sim.base import Sim
from hmc.sim.device import constant
from train.chosen import Chosen, choose, put
from train.env import EnvCfg, Gap, Go2Env
from train.fallen import LegsStarts, LegsStartsCfg
from train.rewards import LegsRewardCfg, legs_rewards

MIRROR = (1.0, -1.0, -1.0)  # of the command: forward, sideways, turn
STILL = 0.3  # m/s, of the base: less is standing
ASTRAY = 0.3  # m/s off the commanded velocity, on average since it was given: more is not walking as told


@dataclass(frozen=True)
class CommandCfg:
    """Velocities that are commanded, in the frame of the robot's heading.

    Attributes:
        forward: lowest and highest [m/s].
        sideways: half width [m/s].
        turn: half width [rad/s].
        every: mean time between two commands [s].
        halt: share of commands that are to stand still.
    """

    forward: tuple[float, float] = (-0.6, 1.0)
    sideways: float = 0.4
    turn: float = 1.0
    every: float = 4.0
    halt: float = 0.15


@dataclass(frozen=True)
class LegsCfg(EnvCfg):
    """An environment on four legs; see `EnvCfg` too.

    Attributes:
        mode: to learn: only walk is commanded, the others stand still.
        grace: seconds from which on a robot that lies or is tilted ends its episode.
        min_upright: cosine of the tilt under which it does.
        rewards: weights.
        starts: how episodes begin.
        command: of walk.
    """

    mode: Literal["stand", "getup", "walk"]
    grace: float = 0.0
    min_upright: float = 0.6
    rewards: LegsRewardCfg = field(default_factory=LegsRewardCfg)
    starts: LegsStartsCfg = field(default_factory=LegsStartsCfg)
    command: CommandCfg = field(default_factory=CommandCfg)


class LegsEnv(Go2Env):
    """Learn to stand on four legs, from wherever, or to walk.

    An episode ends in a fall when after the grace time the trunk is on the ground or the body tilted. One
    that times out is a success if the robot stands still on four feet then; under the mode walk, if its
    velocity was near the commanded one on average since the command.

    Args:
        cfg: what to learn and from where.
        sim: `cfg.worlds` worlds.
        zeros: error of each joint's zero in each world (worlds, 12) [rad]; None for none.
    """

    cfg: LegsCfg

    def __init__(self, cfg: LegsCfg, sim: Sim, zeros: Tensor | None = None):
        starts = LegsStarts(cfg.starts, sim.device)
        self._air = torch.zeros(sim.num_worlds, 4, device=sim.device)  # s since each foot left the ground
        self._since = torch.zeros(sim.num_worlds, device=sim.device)  # steps since the command
        self._astray = torch.zeros(sim.num_worlds, device=sim.device)  # sum of velocity errors since then
        self._beyond = torch.zeros(sim.num_worlds, 12, device=sim.device)  # rad, of the targets asked for
        self._walks = cfg.mode == "walk"
        super().__init__(
            cfg, sim, STAND, starts, cfg.rewards.termination, zeros, MIRROR if self._walks else ()
        )

    def rewards(self, x: Tensor, before: Tensor, u: Tensor, u_prev: Tensor, gap: Gap) -> dict[str, Tensor]:
        velocity = heading_velocity(x)
        command = self.command if self._walks else torch.zeros_like(velocity)
        down = gap["foot"] < 0.005
        landed = torch.where(down, self._air, 0.0)
        self._air = torch.where(down, 0.0, self._air + self.sim.dt)
        self._since += 1
        self._astray += (velocity - command)[:, :2].norm(dim=1)
        terms = legs_rewards(
            self.cfg.rewards,
            x,
            before,
            u,
            u_prev,
            velocity,
            command,
            landed,
            self._beyond,
            self.sim.dt,
            gap,
        )
        if self._walks:
            new = torch.rand(self.num_envs, device=self.device) < self.sim.dt / self.cfg.command.every
            self._command(choose(new))
        return terms

    def targets(self, actions: Tensor) -> Tensor:
        u = super().targets(actions)
        self._beyond = self._pose + self.cfg.action_scale * actions - u
        return u

    def fallen(self, x: Tensor, gap: Gap) -> Tensor:
        late = self.episode_length_buf * self.sim.dt > self.cfg.grace
        lies = (gap["trunk"] < 0) | (go2.vertical(x[:, 3:7])[:, 2] < self.cfg.min_upright)
        return lies & late

    def good(self, x: Tensor, gap: Gap) -> Tensor:
        if self._walks:
            return self._astray < ASTRAY * self._since.clamp(min=1)
        return STAND.held(x, gap) & (x[:, 19:22].norm(dim=1) < STILL)

    def _reset(self, chosen: Chosen) -> None:
        super()._reset(chosen)
        put(self._air, chosen, 0.0)
        if self._walks:
            self._command(chosen)
        put(self._since, chosen, 0.0)
        put(self._astray, chosen, 0.0)

    def _command(self, chosen: Chosen) -> None:
        """Command the chosen worlds anew."""
        if len(chosen) == 0:
            return
        self.command = self.command.clone()
        put(self.command, chosen, drawn(self.cfg.command, len(chosen), self.device))
        put(self._since, chosen, 0.0)
        put(self._astray, chosen, 0.0)


def drawn(cfg: CommandCfg, n: int, device: torch.device) -> Tensor:
    """n commands: forward, sideways [m/s], turn [rad/s], (n, 3)."""
    share = torch.rand(n, 3, device=device)
    low, high = (constant(each, share) for each in _limits(cfg))
    moves = torch.rand(n, 1, device=device) >= cfg.halt
    return (low + (high - low) * share) * moves


@cache
def _limits(cfg: CommandCfg) -> tuple[Tensor, Tensor]:
    """Lowest and highest command, (3,) each."""
    low = torch.tensor([cfg.forward[0], -cfg.sideways, -cfg.turn])
    return low, torch.tensor([cfg.forward[1], cfg.sideways, cfg.turn])


def heading_velocity(x: Tensor) -> Tensor:
    """Velocity of states x (n, 37) in the frame of their heading: forward, sideways, turn, (n, 3)."""
    c, s = anchor_of(x)[:, 2:].unbind(1)
    vx, vy = x[:, 19], x[:, 20]
    return torch.stack([c * vx + s * vy, c * vy - s * vx, x[:, 24]], 1)
