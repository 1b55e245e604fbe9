"""The stance environment: one robot mode as an rsl-rl `VecEnv` on any `Sim`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.conditions import Conditions, pushed
from hmc.go2.mirror import mirror_joints, mirror_observation
from hmc.go2.observe import anchor_of, observe
from hmc.go2.stances import STANCES
from hmc.go2.variants import draw
from hmc.sim.base import Sim
from hmc.sim.make import make_sim
from train.rewards import RewardCfg, stage_rewards
from train.starts import KINDS, STANCE, Starts, StartsCfg


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
        conditions: what the policy meets and is not told: other robots, noise, pushes. A world stays the same
            robot for the whole training.
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
    conditions: Conditions = field(default_factory=Conditions)
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
        zeros: error of each joint's zero in each world (worlds, 12) [rad]; None for none.
    """

    def __init__(self, cfg: EnvCfg, sim: Sim, zeros: Tensor | None = None):
        self.cfg, self.sim = cfg, sim
        self.stance = STANCES[cfg.mode]
        self.device = sim.device
        self.num_envs, self.num_actions = sim.num_worlds, 12
        self.max_episode_length = cfg.episode_steps
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.starts = Starts(self.stance, cfg.starts, sim.device)
        self._drawn = (self.starts.shares > 0).nonzero().squeeze(1).tolist()
        self._zeros = torch.zeros(self.num_envs, 12, device=self.device)
        if zeros is not None:
            self._zeros += zeros.to(self._zeros)
        self._widths = cfg.conditions.noise.widths().to(self.device)
        self._lasting = torch.zeros(self.num_envs, len(self._widths), device=self.device)
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
        share = 1.0 - self.cfg.conditions.noise.lasting
        noisy = clean + (2 * torch.rand_like(clean) - 1) * (share * self._widths) + self._lasting
        noisy[:, 12:24] += self._zeros
        torque = go2.motor_torque(self._x[:, 7:19], self._x[:, 25:37], self._u - self._zeros)
        critic = torch.cat([clean, 0.1 * torque, self._x[:, 2:3]], -1)
        return TensorDict({"policy": noisy, "critic": critic}, batch_size=[self.num_envs])

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
        gap, dt = go2.clearances(x), self.sim.dt
        terms = stage_rewards(
            self.cfg.rewards,
            self.stance,
            x,
            before,
            u - self._zeros,
            u_prev - self._zeros,
            self._anchor,
            dt,
            gap,
        )
        fallen = self._fallen(x, gap) | broken
        timeout = (self.episode_length_buf >= self.max_episode_length) & ~fallen
        table = torch.stack(list(terms.values()))
        reward = table.sum(0).clamp(min=0) * dt
        reward = torch.where(broken, 0.0, reward - self.cfg.rewards.termination * fallen)
        done = fallen | timeout
        log: dict[str, Any] = {
            f"/reward/{name}": term for name, term in zip(terms, table.mean(1), strict=True)
        }
        if self.cfg.conditions.push > 0:
            self._push(self.stance.held(x, gap) & ~done)
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

    def _push(self, standing: Tensor) -> None:
        """Push some of the worlds that are `standing`, (n,) bool."""
        conditions = self.cfg.conditions
        chosen = torch.rand(self.num_envs, device=self.device) < self.sim.dt / conditions.push_every
        ids = (standing & chosen).nonzero().squeeze(1)
        if len(ids):
            speed, direction = torch.rand(2, len(ids), device=self.device)
            x = pushed(self._x[ids], conditions.push * speed, 2 * math.pi * direction)
            self.sim.reset(x, (self._u - self._zeros)[ids], ids)
            self._x = self._x.index_copy(0, ids, x)

    def _reset(self, ids: Tensor) -> None:
        start = self.starts.draw(len(ids))
        self.sim.reset(start.x, start.u, ids)
        self._x, self._u, self._anchor = self._x.clone(), self._u.clone(), self._anchor.clone()
        self._x[ids], self._u[ids] = start.x, start.u + self._zeros[ids]
        self._anchor[ids] = anchor_of(start.x)
        self._anchor[ids, :2] += 0.6 * torch.rand(len(ids), 2, device=self.device) - 0.3
        self._kind[ids], self._cell[ids] = start.kind, start.cell
        width = self.cfg.conditions.noise.lasting * self._widths
        self._lasting[ids] = (2 * torch.rand(len(ids), len(width), device=self.device) - 1) * width
        self.episode_length_buf[ids] = 0


def both_sides(
    env: VecEnv, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Observations and actions followed by their mirror images, as rsl-rl's symmetry wants them."""
    if obs is not None:
        critic = obs["critic"]
        parts = [mirror_observation(critic[:, :48]), mirror_joints(critic[:, 48:60]), critic[:, 60:]]
        image = {"policy": mirror_observation(obs["policy"]), "critic": torch.cat(parts, -1)}
        both = {name: torch.cat([obs[name], image[name]]) for name in image}
        obs = TensorDict(both, batch_size=[2 * len(critic)])
    return obs, None if actions is None else torch.cat([actions, mirror_joints(actions)])


def make_env(
    cfg: EnvCfg, engine: str = "auto", *, device: str | None = None, threads: int = 0, seed: int = 0
) -> StanceEnv:
    """The environment on an engine, see `make_sim`, in whose worlds are the robots of `cfg.conditions`."""
    variants = cfg.conditions.variants
    if variants.nominal:
        sim = make_sim(go2.load_model(), cfg.worlds, engine, device=device, threads=threads)
        return StanceEnv(cfg, sim)
    robots = draw(variants, cfg.worlds, torch.Generator().manual_seed(seed))
    sim = make_sim(
        go2.load_model(),
        cfg.worlds,
        engine,
        device=device,
        threads=threads,
        latency=[robot.late() for robot in robots],
        models=[robot.model() for robot in robots],
    )
    return StanceEnv(cfg, sim, torch.tensor([robot.zeros for robot in robots]))
