"""Training steps a second, and where the time goes."""

from __future__ import annotations

import tempfile
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hmc.go2.model import load_model
from hmc.sim.ids import Ids
from hmc.sim.mujoco import MujocoSim
from tools.benchmarks.figures import Common, Figures
from train.config import TrainCfg, read_training, rsl_config
from train.env import Go2Env
from train.make import env_on
from train.runner import Runner


@dataclass(frozen=True)
class Train(Common):
    """Training steps a second, learning included, and where the time goes.

    Attributes:
        mode: whose cfg/MODE.toml.
        warm_up: iterations that do not count.
        iterations: that do.
        set: overrides of the configuration.
    """

    mode: str = "handstand"
    warm_up: int = 3
    iterations: int = 10
    set: tuple[str, ...] = ()


def train(args: Train) -> Figures:
    """PPO as train/ppo.py runs it: the same configuration, environment and runner."""
    figures = Figures()
    cfg = read_training(args.mode, args.mode, args.set)
    sim = MujocoSim(load_model(), cfg.env.worlds, threads=args.threads)
    whole, collect, learn, physics = iterations(args, cfg, env_on(cfg.env, sim))
    size = cfg.env.worlds * cfg.ppo.steps
    rate = size / whole
    low, high = np.percentile(rate, [10, 90])
    figures.add(
        "train_steps_per_s",
        float(np.median(rate)),
        f"environment steps/s, learning included; 10 to 90 %: {low:,.0f} to {high:,.0f}",
    )
    figures.add("collect_share", collect.sum() / whole.sum(), "of the time: collecting, physics included")
    figures.add("physics_share", physics.sum() / whole.sum(), "of the time: stepping the engine")
    figures.add("learn_share", learn.sum() / whole.sum(), "of the time: learning")
    return figures


def iterations(args: Train, cfg: TrainCfg, env: Go2Env) -> np.ndarray:
    """Seconds of each iteration that counts, (4, n): whole, collecting, learning, calls of the engine's step.

    The last is what the calls take; on a GPU these return before the work is done.
    """
    torch.manual_seed(1)
    sim: Any = env.sim
    spent, step, entries = [0.0], sim.step, []

    def timed(u: Tensor, ids: Ids = None) -> None:
        began = time.perf_counter()
        step(u, ids)
        spent[0] += time.perf_counter() - began

    sim.step = timed
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        meta = {"command": "tools/bench.py", "seed": "1", "config": "{}", "config_sha256": ""}
        runner = Runner(env, rsl_config(cfg.ppo), folder, str(env.device), meta)
        began = [0.0]

        def update(log: dict[str, Any], means: dict[str, float]) -> None:
            now = time.perf_counter()
            entries.append((now - began[0], log["collect_time"], log["learn_time"], spent[0]))
            began[0], spent[0] = now, 0.0

        runner.table.update = update  # type: ignore[method-assign]
        began[0] = time.perf_counter()
        runner.learn(args.warm_up + args.iterations, init_at_random_ep_len=True)
    return np.array(entries[args.warm_up :]).T
