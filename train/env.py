"""A mode of the Go2 to be learned, as an rsl-rl `VecEnv` on any `Sim`; what the modes have in common."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.conditions import Conditions, pushed
from hmc.go2.facts import OBS_SIZE
from hmc.go2.mirror import mirror_joints, mirror_observation
from hmc.go2.observe import anchor_of, observe
from hmc.go2.stances import Stance, Stand
from hmc.go2.value import seen
from hmc.sim.base import Sim
from train.chosen import Chosen, choose, pick, put, reset

Gap = dict[str, Tensor]

AHEAD = 8  # control steps that one draw of starts for all worlds serves: it takes as long as several of them


@dataclass(frozen=True)
class EnvCfg:
    """What all environments have.

    Attributes:
        mode: to learn.
        worlds: worlds that step together.
        episode_steps: control steps of an episode that does not end early.
        action_scale: joint target = pose + action_scale x network output [rad].
        conditions: what the policy meets and is not told: other robots, noise, pushes. A world stays the same
            robot for the whole training.
    """

    mode: str
    worlds: int = 256
    episode_steps: int = 250
    action_scale: float = 0.5
    conditions: Conditions = field(default_factory=Conditions)


class Start(NamedTuple):
    """A batch of starts: states (n, 37), inputs (n, 12), kind (n,), and cell of a curriculum's grid (n,)."""

    x: Tensor
    u: Tensor
    kind: Tensor
    cell: Tensor


class StartStates(Protocol):
    """Where episodes begin; it may learn from how they ended.

    Attributes:
        kinds: names of the kinds of starts.
        rates: success of each kind lately, (kinds,).
        shares: of each kind, (kinds,).
    """

    @property
    def rates(self) -> Tensor: ...

    @property
    def shares(self) -> Tensor: ...

    @property
    def kinds(self) -> Sequence[str]: ...

    def draw(self, n: int) -> Start:
        """The next n starts."""
        ...

    def report(self, kind: Tensor, cell: Tensor, success: Tensor, ended: Tensor) -> None:
        """Learn from episodes that `ended`: kind, cell and whether they were a success, all (n,)."""
        ...

    def log(self) -> dict[str, Tensor]:
        """What else is to be shown of it, by name."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint must keep."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint."""
        ...


class Go2Env(VecEnv):
    """Worlds of the Go2 in which a mode is learned.

    Observation groups: "policy" (48, noisy, then the command if the mode has one) and "critic" (the same
    without noise, joint torques 12, base height 1). Actions are clamped so that the joint targets stay
    inside the joint limits. An episode ends in a fall, or times out after `episode_steps`; what a fall and
    a success are, where episodes begin and what they earn is the mode's own.

    Args:
        cfg: what to learn.
        sim: `cfg.worlds` worlds.
        holds: the posture that the actions are about.
        starts: where episodes begin.
        fall: what a fall costs.
        zeros: error of each joint's zero in each world (worlds, 12) [rad]; None for none.
        mirror: sign that each number of the mode's command takes in the mirror image; empty: no command.

    Attributes:
        command: of each world, (worlds, len(mirror)).
    """

    def __init__(
        self,
        cfg: EnvCfg,
        sim: Sim,
        holds: Stance | Stand,
        starts: StartStates,
        fall: float,
        zeros: Tensor | None = None,
        mirror: tuple[float, ...] = (),
    ):
        self.cfg, self.sim, self.starts, self._fall = cfg, sim, starts, fall
        self.device = sim.device
        self.num_envs, self.num_actions = sim.num_worlds, 12
        self.max_episode_length = cfg.episode_steps
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.mirror = torch.tensor(mirror, device=self.device)
        self.command = torch.zeros(self.num_envs, len(mirror), device=self.device)
        self._drawn = (starts.shares > 0).nonzero().squeeze(1).tolist()
        self._zeros = torch.zeros(self.num_envs, 12, device=self.device)
        if zeros is not None:
            self._zeros += zeros.to(self._zeros)
        self._widths = cfg.conditions.noise.widths().to(self.device)
        self._lasting = torch.zeros(self.num_envs, len(self._widths), device=self.device)
        self._pose = holds.pose.to(self.device)
        self._lower, self._upper = go2.Q_LOWER.to(self.device), go2.Q_UPPER.to(self.device)
        self._anchor = torch.zeros(self.num_envs, 4, device=self.device)
        self._kind = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._cell = torch.zeros_like(self._kind)
        self._x = torch.zeros(self.num_envs, sim.nx, device=self.device)
        self._u = torch.zeros(self.num_envs, 12, device=self.device)
        self._ahead: Start | None = None
        self._resets = 0
        self._reset(choose(torch.ones(self.num_envs, dtype=torch.bool, device=self.device)))

    @abstractmethod
    def rewards(self, x: Tensor, before: Tensor, u: Tensor, u_prev: Tensor, gap: Gap) -> dict[str, Tensor]:
        """Weighted terms of a control step by name, (n,) a second.

        Args:
            x: states after the step (n, 37).
            before: states before it.
            u: joint targets of the step as the motors take them (n, 12) [rad].
            u_prev: those of the step before.
            gap: `clearances` of x.
        """

    @abstractmethod
    def fallen(self, x: Tensor, gap: Gap) -> Tensor:
        """Episodes that end in a fall at states x (n, 37), (n,) bool."""

    @abstractmethod
    def good(self, x: Tensor, gap: Gap) -> Tensor:
        """Whether the mode does what it is for at states x (n, 37), (n,) bool: such robots are pushed, and an
        episode that times out there is a success."""

    def get_observations(self) -> TensorDict:
        clean = observe(self._x, self._u, self._anchor)
        share = 1.0 - self.cfg.conditions.noise.lasting
        noisy = clean + (2 * torch.rand_like(clean) - 1) * (share * self._widths) + self._lasting
        noisy[:, 12:24] += self._zeros
        if len(self.mirror):  # what obeys commands goes far from where it was entered
            clean[:, 3:5] = noisy[:, 3:5] = 0.0
        torque = go2.motor_torque(self._x[:, 7:19], self._x[:, 25:37], self._u - self._zeros)
        critic = seen(torch.cat([clean, self.command], -1), torque, self._x[:, 2])
        policy = torch.cat([noisy, self.command], -1)
        return TensorDict({"policy": policy, "critic": critic}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        u = self.targets(actions)
        before, u_prev = self._x, self._u
        self.sim.step(u - self._zeros)
        x = self.sim.x().float()
        broken = ~(torch.isfinite(x).all(1) & torch.isfinite(u).all(1))
        x = torch.where(broken[:, None], before, x)
        u = torch.where(broken[:, None], u_prev, u)
        self._x, self._u = x, u
        self.episode_length_buf += 1
        gap = go2.clearances(x)
        terms = self.rewards(x, before, u - self._zeros, u_prev - self._zeros, gap)
        fallen = self.fallen(x, gap) | broken
        timeout = (self.episode_length_buf >= self.max_episode_length) & ~fallen
        table = torch.stack(list(terms.values()))
        reward = table.sum(0).clamp(min=0) * self.sim.dt
        reward = torch.where(broken, 0.0, reward - self._fall * fallen)
        done = fallen | timeout
        log: dict[str, Any] = {
            f"/reward/{name}": term for name, term in zip(terms, table.mean(1), strict=True)
        }
        if self.cfg.conditions.push > 0:
            self._push(self.good(x, gap) & ~done)
        ended = choose(done)
        if len(ended):
            self.starts.report(self._kind, self._cell, timeout & self.good(x, gap), done)
            log["/episode/length"] = (self.episode_length_buf * done).sum() / done.sum()  # NaN: none ended
            self._reset(ended)
        for kind in self._drawn:
            log[f"/success/{self.starts.kinds[kind]}"] = self.starts.rates[kind]
        log |= {f"/success/{name}": value for name, value in self.starts.log().items()}
        log["/diverged"] = broken.float().sum()
        return self.get_observations(), reward, done, {"time_outs": timeout, "log": log}

    def targets(self, actions: Tensor) -> Tensor:
        """Joint targets [rad] of network outputs, both (n, 12)."""
        return (self._pose + self.cfg.action_scale * actions).clamp(self._lower, self._upper)

    def _push(self, standing: Tensor) -> None:
        """Push some of the worlds that are `standing`, (n,) bool."""
        conditions = self.cfg.conditions
        hit = torch.rand(self.num_envs, device=self.device) < self.sim.dt / conditions.push_every
        chosen = choose(standing & hit)
        if len(chosen):
            speed, direction = torch.rand(2, len(chosen), device=self.device)
            x = pushed(pick(self._x, chosen), conditions.push * speed, 2 * math.pi * direction)
            reset(self.sim, chosen, x, pick(self._u - self._zeros, chosen))
            self._x = self._x.clone()
            put(self._x, chosen, x)

    def _reset(self, chosen: Chosen) -> None:
        start = self._starts_of(chosen)
        reset(self.sim, chosen, start.x, start.u)
        self._x, self._u, self._anchor = self._x.clone(), self._u.clone(), self._anchor.clone()
        put(self._x, chosen, start.x)
        put(self._u, chosen, start.u + pick(self._zeros, chosen))
        anchor = anchor_of(start.x)
        anchor[:, :2] += 0.6 * torch.rand(len(chosen), 2, device=self.device) - 0.3
        put(self._anchor, chosen, anchor)
        put(self._kind, chosen, start.kind)
        put(self._cell, chosen, start.cell)
        width = self.cfg.conditions.noise.lasting * self._widths
        put(self._lasting, chosen, (2 * torch.rand(len(chosen), len(width), device=self.device) - 1) * width)
        put(self.episode_length_buf, chosen, 0)

    def _starts_of(self, chosen: Chosen) -> Start:
        """A start for each of the chosen worlds. Under flags each world has one for some steps, and begins
        there again if it ends twice in them."""
        if chosen.dtype != torch.bool:
            return self.starts.draw(len(chosen))
        if self._ahead is None or self._resets % AHEAD == 0:
            self._ahead = self.starts.draw(self.num_envs)
        self._resets += 1
        return self._ahead


def both_sides(
    env: Go2Env, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Observations and actions followed by their mirror images, as rsl-rl's symmetry wants them."""
    if obs is not None:
        end = OBS_SIZE + len(env.mirror)
        critic = obs["critic"]
        seen = [
            torch.cat([mirror_observation(each[:, :OBS_SIZE]), env.mirror * each[:, OBS_SIZE:end]], -1)
            for each in (obs["policy"], critic)
        ]
        torque, height = critic[:, end : end + 12], critic[:, end + 12 :]
        image = {"policy": seen[0], "critic": torch.cat([seen[1], mirror_joints(torque), height], -1)}
        both = {name: torch.cat([obs[name], image[name]]) for name in image}
        obs = TensorDict(both, batch_size=[2 * len(critic)])
    return obs, None if actions is None else torch.cat([actions, mirror_joints(actions)])
