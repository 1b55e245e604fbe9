"""The baseline without modes: one policy that holds both stances and flips when it is told to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor

from hmc.go2.facts import OBS_SIZE
from hmc.go2.stances import BETWEEN, FOOTSTAND, HANDSTAND
from hmc.sim.base import Sim
from hmc.sim.device import constant
from train.chosen import Chosen, pick, put
from train.env import EnvCfg, Gap, Go2Env, Start
from train.rewards import RewardCfg, stage_rewards
from train.stance import low, touches
from train.starts import KINDS, STANCE, Starts, StartsCfg

GOALS = (FOOTSTAND, HANDSTAND)  # command -1 and +1
FLIP = len(GOALS) * len(KINDS)  # kind of start: the foot stand, which is told to flip
MIRROR = (1.0,)  # of the command
HELD = 0.5  # share of episodes in the foot stand from which on others are drawn
# joint targets are about the pose of the stance that is asked for: half way between both and command x this
TOWARDS = (HANDSTAND.pose - FOOTSTAND.pose) / 2


@dataclass(frozen=True)
class UnifiedCfg(EnvCfg):
    """The environment of the whole timeline; see `EnvCfg` too.

    Attributes:
        mode: unified.
        shares: of worlds in which the foot stand is asked for, the handstand, and first one, then the
            other. Of worlds, not of episodes: what falls soon would be in few of the steps to learn from.
        told: seconds, uniform, after which the latter are told to flip.
        grace: seconds before height and tilt end an episode that did not begin in the stance asked for, or
            since it was told to flip.
        min_height: base height under which an episode ends [m].
        min_upright: cosine of the tilt under which an episode ends.
        rewards: weights, those of the stance that is asked for.
        footstand: how episodes of the foot stand begin.
        handstand: of the handstand.
    """

    mode: Literal["unified"]
    shares: tuple[float, float, float] = (0.4, 0.3, 0.3)
    told: tuple[float, float] = (0.2, 2.0)
    grace: float = 1.5
    min_height: float = 0.44
    min_upright: float = 0.6
    rewards: RewardCfg = field(default_factory=RewardCfg)
    footstand: StartsCfg = field(default_factory=StartsCfg)
    handstand: StartsCfg = field(default_factory=StartsCfg)


class UnifiedStarts:
    """Draws start states of both stances; each has its own curriculum.

    Attributes:
        goals: what is asked for in the worlds that are drawn for next, (n,): index of GOALS, or 2 to flip.
    """

    kinds = (*(f"{goal.name}_{kind}" for goal in GOALS for kind in KINDS), "flip")

    def __init__(self, cfg: UnifiedCfg, device: torch.device):
        self.device = device
        self.goals = torch.zeros(0, dtype=torch.long, device=device)
        self._shares = torch.tensor(cfg.shares, device=device)
        self.stances = [Starts(FOOTSTAND, cfg.footstand, device), Starts(HANDSTAND, cfg.handstand, device)]
        upright = StartsCfg(stance=1.0, home=0.0)
        self._flip = Starts(FOOTSTAND, upright, device)
        self._sources = (*self.stances, self._flip)

    @property
    def rates(self) -> Tensor:
        """Success of each kind lately, (kinds,)."""
        return torch.cat([*(starts.rates for starts in self.stances), self._flip.rates[:1]])

    @property
    def shares(self) -> Tensor:
        """Of each kind, (kinds,)."""
        each = [goal * starts.shares for goal, starts in zip(self._shares, self.stances, strict=False)]
        return torch.cat([*each, self._shares[2:]])

    def draw(self, n: int) -> Start:
        """The next n starts, one for each of `goals`, or for what can be learned by now.

        That is the foot stand first: beside a handstand that is half learned, it is not learned at all. And
        nobody flips who cannot rise into the handstand.
        """
        foot, hand = self.stances
        held, risen = foot.rates[STANCE] > HELD, hand.frontier() <= Starts.HORIZONTAL
        goal = torch.minimum(self.goals, held * (1 + risen.long()))
        drawn = [source.draw(n) for source in self._sources]
        x, u, kind, cell = (
            torch.stack(parts)[goal, torch.arange(n, device=self.device)]
            for parts in zip(*drawn, strict=True)
        )
        return Start(x, u, kind + goal * len(KINDS), cell)

    def report(self, kind: Tensor, cell: Tensor, success: Tensor, ended: Tensor) -> None:
        """Learn from episodes that `ended`: kind, cell and whether they ended as asked, all (n,)."""
        for goal, source in enumerate(self._sources):
            own = torch.div(kind, len(KINDS), rounding_mode="floor") == goal
            source.report(kind % len(KINDS), cell, success, ended & own)

    def log(self) -> dict[str, Tensor]:
        """How far each way is open."""
        return {f"{starts.stance.name}_frontier": starts.frontier() for starts in self.stances}

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint must keep."""
        states = enumerate(source.state_dict() for source in self._sources)
        return {f"{goal}_{key}": value for goal, state in states for key, value in state.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint."""
        for goal, source in enumerate(self._sources):
            source.load_state_dict({key: state[f"{goal}_{key}"] for key in source.state_dict()})


class GoalPpo(PPO):
    """PPO whose advantages are normalised for each goal by itself.

    Where the episodes of a goal all end alike, its advantages are small beside those of one that is half
    learned, and next to nothing would be learned for it.
    """

    def compute_returns(self, obs: TensorDict) -> None:
        super().compute_returns(obs)
        advantages = self.storage.advantages
        command = self.storage.observations["policy"][..., OBS_SIZE:]
        for goal in command.unique():
            mine = command == goal
            own = advantages[mine]
            advantages[mine] = (own - own.mean()) / (own.std(unbiased=False) + 1e-8)


class UnifiedEnv(Go2Env):
    """Learn to hold the stance that is asked for, and to get there from the other one.

    The command is one number, -1 for the foot stand and +1 for the handstand. Falls and rewards are those
    of the stance that is asked for; an episode that times out is a success if that is held then.

    Args:
        cfg: what to learn and from where.
        sim: `cfg.worlds` worlds.
        zeros: error of each joint's zero in each world (worlds, 12) [rad]; None for none.
    """

    cfg: UnifiedCfg
    starts: UnifiedStarts

    def __init__(self, cfg: UnifiedCfg, sim: Sim, zeros: Tensor | None = None):
        self._told = torch.zeros(sim.num_worlds, dtype=torch.long, device=sim.device)  # step of the command
        edges = torch.tensor(cfg.shares, device=sim.device).cumsum(0)[:2] * sim.num_worlds
        self._goals = torch.bucketize(torch.arange(sim.num_worlds, device=sim.device) + 0.5, edges)
        super().__init__(
            cfg, sim, BETWEEN, UnifiedStarts(cfg, sim.device), cfg.rewards.termination, zeros, MIRROR
        )

    @property
    def _hand(self) -> Tensor:
        """Worlds in which the handstand is asked for, (n,) bool."""
        return self.command[:, 0] > 0

    def targets(self, actions: Tensor) -> Tensor:
        shift = constant(TOWARDS, actions) * self.command / self.cfg.action_scale
        return super().targets(actions + shift)

    def rewards(self, x: Tensor, before: Tensor, u: Tensor, u_prev: Tensor, gap: Gap) -> dict[str, Tensor]:
        foot, hand = (
            stage_rewards(self.cfg.rewards, goal, x, before, u, u_prev, self._anchor, self.sim.dt, gap)
            for goal in GOALS
        )
        terms = {name: torch.where(self._hand, hand[name], foot[name]) for name in hand}
        now = (self._kind == FLIP) & (self.episode_length_buf == self._told)
        self.command = torch.where(now[:, None], 1.0, self.command)
        return terms

    def fallen(self, x: Tensor, gap: Gap) -> Tensor:
        foot, hand = (low(x, goal, self.cfg.min_height, self.cfg.min_upright) for goal in GOALS)
        lies = torch.where(self._hand, hand, foot)
        flips = (self._kind == FLIP) & self._hand
        since = self.episode_length_buf - torch.where(flips, self._told, 0)
        late = since * self.sim.dt > self.cfg.grace
        began = (self._kind % len(KINDS) == STANCE) & ~flips
        return touches(gap) | (lies & (late | began))

    def good(self, x: Tensor, gap: Gap) -> Tensor:
        return torch.where(self._hand, HANDSTAND.held(x, gap), FOOTSTAND.held(x, gap))

    def _reset(self, chosen: Chosen) -> None:
        self.starts.goals = pick(self._goals, chosen)
        super()._reset(chosen)
        first, last = (seconds / self.sim.dt for seconds in self.cfg.told)
        share = torch.rand(len(chosen), device=self.device)
        put(self._told, chosen, (first + (last - first) * share).long())
        kind = pick(self._kind, chosen)
        hand = (kind >= len(KINDS)) & (kind != FLIP)
        self.command = self.command.clone()
        put(self.command, chosen, torch.where(hand, 1.0, -1.0)[:, None])
