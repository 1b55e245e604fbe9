"""A training run small enough for a test: eight worlds, two small layers, a few steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from train import make
from train.config import PpoCfg, StanceTraining, TrainCfg, metadata, rsl_config
from train.fallen import LegsStartsCfg
from train.legs import LegsCfg, LegsEnv
from train.runner import Runner
from train.stance import StanceCfg, StanceEnv
from train.starts import StartsCfg

STARTS = StartsCfg(stance=0.5, way=0.3, home=0.2, furthest=-1.0)
CFG = StanceTraining(
    env=StanceCfg(mode="handstand", worlds=8, episode_steps=20, starts=STARTS),
    ppo=PpoCfg(iterations=2, steps=6, epochs=1, minibatches=2, hidden=(16, 8)),
)


def make_env(cfg: StanceCfg = CFG.env) -> StanceEnv:
    """The environment on the C engine, one thread."""
    env = make.make_env(cfg, "mujoco", threads=1)
    assert isinstance(env, StanceEnv)
    return env


def make_runner(folder: Path, cfg: TrainCfg = CFG, argv: tuple[str, ...] = (), seed: int = 7) -> Runner:
    """A runner that has not learned yet and writes into `folder`."""
    env = make.make_env(cfg.env, "mujoco", threads=1)
    return Runner(env, rsl_config(cfg.ppo), str(folder), "cpu", metadata(cfg, argv, seed))


def make_legs(mode: Literal["stand", "getup", "walk"], **settings: Any) -> LegsEnv:
    """A mode on four legs, likewise."""
    starts = LegsStartsCfg(fallen=float(mode == "getup"), drops=16)
    env = make.make_env(LegsCfg(mode, worlds=8, starts=starts, **settings), "mujoco", threads=1)
    assert isinstance(env, LegsEnv)
    return env
