"""The stance environment: one robot mode as an rsl-rl `VecEnv` on any `Sim`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.observe import anchor_of, observe
from hmc.go2.stances import STANCES
from hmc.sim.base import Sim
from train.rewards import RewardCfg, stage_rewards
from train.starts import KINDS, STANCE, Starts, StartsCfg


@dataclass(frozen=True)
class NoiseCfg:
    """Half widths of the uniform noise on the actor's observation.

    Attributes:
        gravity: unit vector.
        position: [m].
        velocity: [m/s].
        gyro: [rad/s].
        joint: [rad].
        joint_speed: [rad/s].
    """

    gravity: float = 0.02
    position: float = 0.02
    velocity: float = 0.05
    gyro: float = 0.1
    joint: float = 0.01
    joint_speed: float = 0.3


@dataclass(frozen=True)
class EnvCfg:
    """One stance environment.

    Attributes:
        mode: the stance to learn.
        worlds: worlds that step together.
        episode_steps: control steps of an episode that does not end early.
        action_scale: joint target = stance pose + action_scale x network output [rad].
        grace: seconds before height and tilt end an episode that did not begin in the stance.
        min_height: base height under which an episode ends [m].
        min_upright: cosine of the tilt under which an episode ends.
        rewards: weights.
        noise: observation noise.
        starts: how episodes begin.
    """

    mode: Literal["handstand", "footstand"]
    worlds: int = 256
    episode_steps: int = 250
    action_scale: float = 0.5
    grace: float = 1.5
    min_height: float = 0.44
    min_upright: float = 0.6
    rewards: RewardCfg = field(default_factory=RewardCfg)
    noise: NoiseCfg = field(default_factory=NoiseCfg)
    starts: StartsCfg = field(default_factory=StartsCfg)


class StanceEnv(VecEnv):
    """Learn to reach and to hold a stance.

    Observation groups: "policy" (48, noisy) and "critic" (61: the same without noise, joint torques 12,
    base height 1). Actions are clamped so that the joint targets stay inside the joint limits. An
    episode ends in a fall when trunk, thigh or shin touch the ground, and after the grace time also
    when the base is low or the body tilted; one that lasts `episode_steps` times out and counts as a
    success if the stance is held then.

    Args:
        cfg: what to learn and from where.
        sim: `cfg.worlds` worlds.
    """

    def __init__(self, cfg: EnvCfg, sim: Sim):
        self.cfg, self.sim = cfg, sim
        self.stance = STANCES[cfg.mode]
        self.device = sim.device
        self.num_envs, self.num_actions = sim.num_worlds, 12
        self.max_episode_length = cfg.episode_steps
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.starts = Starts(self.stance, cfg.starts, sim.device)
        self._drawn = (self.starts.shares > 0).nonzero().squeeze(1).tolist()
        noise = cfg.noise
        widths = [noise.gravity] * 3 + [noise.position] * 3 + [noise.velocity] * 3 + [noise.gyro] * 3
        widths += [noise.joint] * 12 + [noise.joint_speed] * 12 + [0.0] * 12
        self._noise = torch.tensor(widths, device=self.device)
        self._pose = self.stance.pose.to(self.device)
        self._lower, self._upper = go2.Q_LOWER.to(self.device), go2.Q_UPPER.to(self.device)
        self._anchor = torch.zeros(self.num_envs, 4, device=self.device)
        self._kind = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._cell = torch.zeros_like(self._kind)
        self._x = torch.zeros(self.num_envs, sim.nx, device=self.device)
        self._u = torch.zeros(self.num_envs, 12, device=self.device)
        self._reset(torch.arange(self.num_envs, device=self.device))

    def get_observations(self) -> TensorDict:
        clean = observe(self._x, self._u, self._anchor)
        noisy = clean + (2 * torch.rand_like(clean) - 1) * self._noise
        torque = go2.motor_torque(self._x[:, 7:19], self._x[:, 25:37], self._u)
        critic = torch.cat([clean, 0.1 * torque, self._x[:, 2:3]], -1)
        return TensorDict({"policy": noisy, "critic": critic}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        u = self.targets(actions)
        before, u_prev = self._x, self._u
        self.sim.step(u)
        x = self.sim.x().float()
        broken = ~(torch.isfinite(x).all(1) & torch.isfinite(u).all(1))
        x = torch.where(broken[:, None], before, x)
        u = torch.where(broken[:, None], u_prev, u)
        self._x, self._u = x, u
        self.episode_length_buf += 1
        gap, dt = go2.clearances(x), self.sim.dt
        terms = stage_rewards(self.cfg.rewards, self.stance, x, before, u, u_prev, self._anchor, dt, gap)
        fallen = self._fallen(x, gap) | broken
        timeout = (self.episode_length_buf >= self.max_episode_length) & ~fallen
        table = torch.stack(list(terms.values()))
        reward = table.sum(0).clamp(min=0) * dt
        reward = torch.where(broken, 0.0, reward - self.cfg.rewards.termination * fallen)
        done = fallen | timeout
        log: dict[str, Any] = {
            f"/reward/{name}": term for name, term in zip(terms, table.mean(1), strict=True)
        }
        ids = done.nonzero().squeeze(1)
        if len(ids):
            self.starts.report(self._kind[ids], self._cell[ids], (timeout & self.stance.held(x, gap))[ids])
            log["/episode/length"] = self.episode_length_buf[ids].float().mean()
            self._reset(ids)
        for kind in self._drawn:
            log[f"/success/{KINDS[kind]}"] = self.starts.rates[kind]
        log["/success/frontier"] = self.starts.frontier()
        log["/diverged"] = broken.float().sum()
        return self.get_observations(), reward, done, {"time_outs": timeout, "log": log}

    def targets(self, actions: Tensor) -> Tensor:
        """Joint targets [rad] of network outputs, both (n, 12)."""
        return (self._pose + self.cfg.action_scale * actions).clamp(self._lower, self._upper)

    def _fallen(self, x: Tensor, gap: dict[str, Tensor]) -> Tensor:
        touch = (gap["trunk"] < 0) | (gap["thigh"] < 0).any(1) | (gap["calf"] < 0).any(1)
        low = (x[:, 2] < self.cfg.min_height) | (self.stance.uprightness(x) < self.cfg.min_upright)
        late = self.episode_length_buf * self.sim.dt > self.cfg.grace
        return touch | (low & (late | (self._kind == STANCE)))

    def _reset(self, ids: Tensor) -> None:
        start = self.starts.draw(len(ids))
        self.sim.reset(start.x, start.u, ids)
        self._x, self._u, self._anchor = self._x.clone(), self._u.clone(), self._anchor.clone()
        self._x[ids], self._u[ids] = start.x, start.u
        self._anchor[ids] = anchor_of(start.x)
        self._anchor[ids, :2] += 0.6 * torch.rand(len(ids), 2, device=self.device) - 0.3
        self._kind[ids], self._cell[ids] = start.kind, start.cell
        self.episode_length_buf[ids] = 0
