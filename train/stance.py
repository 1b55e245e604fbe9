"""Learning a stance: reach it, and hold it on two feet."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from hmc.go2.stances import STANCES, Stance
from hmc.sim.base import Sim
from train.env import EnvCfg, Gap, Go2Env
from train.rewards import RewardCfg, stage_rewards
from train.starts import STANCE, Starts, StartsCfg


@dataclass(frozen=True)
class StanceCfg(EnvCfg):
    """One stance environment; see `EnvCfg` too.

    Attributes:
        mode: the stance to learn.
        grace: seconds before height and tilt end an episode that did not begin in the stance.
        min_height: base height under which an episode ends [m].
        min_upright: cosine of the tilt under which an episode ends.
        rewards: weights.
        starts: how episodes begin.
    """

    mode: Literal["handstand", "footstand"]
    grace: float = 1.5
    min_height: float = 0.44
    min_upright: float = 0.6
    rewards: RewardCfg = field(default_factory=RewardCfg)
    starts: StartsCfg = field(default_factory=StartsCfg)


class StanceEnv(Go2Env):
    """Learn to reach and to hold a stance.

    An episode ends in a fall when trunk, thigh or shin touch the ground, and after the grace time also
    when the base is low or the body tilted. One that times out is a success if the stance is held then.

    Args:
        cfg: what to learn and from where.
        sim: `cfg.worlds` worlds.
        zeros: error of each joint's zero in each world (worlds, 12) [rad]; None for none.
    """

    cfg: StanceCfg

    def __init__(self, cfg: StanceCfg, sim: Sim, zeros: Tensor | None = None):
        self.stance = STANCES[cfg.mode]
        starts = Starts(self.stance, cfg.starts, sim.device)
        super().__init__(cfg, sim, self.stance, starts, cfg.rewards.termination, zeros)

    def rewards(self, x: Tensor, before: Tensor, u: Tensor, u_prev: Tensor, gap: Gap) -> dict[str, Tensor]:
        return stage_rewards(
            self.cfg.rewards, self.stance, x, before, u, u_prev, self._anchor, self.sim.dt, gap
        )

    def fallen(self, x: Tensor, gap: Gap) -> Tensor:
        late = self.episode_length_buf * self.sim.dt > self.cfg.grace
        lies = low(x, self.stance, self.cfg.min_height, self.cfg.min_upright)
        return touches(gap) | (lies & (late | (self._kind == STANCE)))

    def good(self, x: Tensor, gap: Gap) -> Tensor:
        return self.stance.held(x, gap)


def touches(gap: Gap) -> Tensor:
    """Whether trunk, thigh or shin touch the ground, (n,) bool."""
    return (gap["trunk"] < 0) | (gap["thigh"] < 0).any(1) | (gap["calf"] < 0).any(1)


def low(x: Tensor, stance: Stance, height: float, upright: float) -> Tensor:
    """Whether the base is below a height [m], or the cosine of its tilt below a limit, (n,) bool."""
    return (x[:, 2] < height) | (stance.uprightness(x) < upright)
