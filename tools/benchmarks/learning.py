"""Training until it is a success: when that is, and the curves up to there, beside those of another run."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from tools import curves
from tools.benchmarks.figures import Figures
from tools.curves import Curves
from train.config import TrainCfg, metadata, rsl_config
from train.env import Go2Env
from train.runner import Runner

TAG = "/success/stance"


class _Enough(Exception):
    """The success is there."""


def train_until(level: float, cfg: TrainCfg, env: Go2Env, folder: Path, argv: Sequence[str]) -> Curves:
    """Train from the beginning, at most to the last iteration, and read the log in `folder`, made anew.

    Args:
        level: share of episodes from the stance that are to hold.
        cfg: what to train.
        env: where.
        folder: of the run.
        argv: train/ppo.py's arguments for the same, which the checkpoint will name.
    """
    shutil.rmtree(folder, ignore_errors=True)
    torch.manual_seed(1)
    runner = Runner(env, rsl_config(cfg.ppo), str(folder), str(env.device), metadata(cfg, argv, 1))
    runner.last_iteration, runner.anneal = cfg.ppo.iterations, cfg.ppo.anneal
    success, log = [0.0], runner.logger.log

    def update(log: dict[str, Any], means: dict[str, float]) -> None:
        del log
        success[0] = means[TAG]

    def logged(**given: Any) -> None:
        log(**given)
        if success[0] >= level:
            raise _Enough

    runner.table.update = update  # type: ignore[method-assign]
    runner.logger.log = logged
    try:
        runner.learn(runner.last_iteration, init_at_random_ep_len=True)
    except _Enough:
        runner.save_interrupted()
        runner.logger.stop_logging_writer()
    return curves.read(folder)


def tell(figures: Figures, name: str, run: Curves, level: float) -> None:
    """When the success was there."""
    found = curves.reached(run, TAG, level)
    if found is None:
        figures.notes[f"{name}_minutes"] = f"{name}: {level:.0%} held from the stance was not reached"
        return
    of = f"until {level:.0%} of the episodes from the stance hold"
    figures.add(f"{name}_minutes", found[1], f"training {of} [min]")
    figures.add(f"{name}_msteps", found[0], f"environment steps {of} [million]")
