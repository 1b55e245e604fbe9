"""From a mode's name to its settings and its environment."""

from __future__ import annotations

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.variants import draw
from hmc.sim.base import Sim
from hmc.sim.make import make_sim
from train.env import Go2Env
from train.legs import LegsCfg, LegsEnv
from train.stance import StanceCfg, StanceEnv
from train.unified import UnifiedCfg, UnifiedEnv

AnyCfg = StanceCfg | LegsCfg | UnifiedCfg


def make_env(
    cfg: AnyCfg,
    engine: str = "auto",
    *,
    device: str | None = None,
    threads: int = 0,
    seed: int = 0,
) -> Go2Env:
    """The environment on an engine, see `make_sim`, in whose worlds are the robots of `cfg.conditions`."""
    variants, zeros = cfg.conditions.variants, None
    if variants.nominal:
        sim = make_sim(go2.load_model(), cfg.worlds, engine, device=device, threads=threads)
    else:
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
        zeros = torch.tensor([robot.zeros for robot in robots])
    return env_on(cfg, sim, zeros)


def env_on(cfg: AnyCfg, sim: Sim, zeros: Tensor | None = None) -> Go2Env:
    """The environment in the worlds of an engine; `zeros` as of `Go2Env`."""
    if isinstance(cfg, StanceCfg):
        return StanceEnv(cfg, sim, zeros)
    return LegsEnv(cfg, sim, zeros) if isinstance(cfg, LegsCfg) else UnifiedEnv(cfg, sim, zeros)
