"""What an experiment file of cfg/ sets, and what a checkpoint says about how it was made."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hmc.cfg import load
from hmc.go2.stances import STANCES
from train.env import both_sides
from train.legs import LegsCfg
from train.stance import StanceCfg
from train.unified import UnifiedCfg

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class PpoCfg:
    """Proximal policy optimisation, as rsl-rl names it (small batches: notes in docs/training.md).

    Attributes:
        iterations: updates.
        steps: environment steps a world and update.
        epochs: passes over a batch.
        minibatches: of each pass.
        learning_rate: until it falls at the end.
        anneal: share of the iterations, the last ones, in which it falls linearly to almost nothing. Without
            it, policies of one run 50 iterations apart differ by several per cent of success.
        gamma: discount a control step.
        lam: of the generalised advantage.
        entropy: weight of the action entropy.
        clip: of the probability ratio.
        init_std: of the action noise, in network units.
        final_std: what it falls to, geometrically over the last iterations; 0: it is learned.
        settle: share of the iterations, the last ones, in which it falls.
        mirror: weight of the mean squared difference between the action on the mirror image of what the robot
            sees and the mirror image of its action (Mittal et al. 2024); 0 for none.
        hidden: layer sizes of actor and critic.
        algorithm: rsl-rl's PPO, or another class as module:class.
    """

    iterations: int = 1000
    steps: int = 24
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 3e-4
    anneal: float = 0.15
    gamma: float = 0.985
    lam: float = 0.95
    entropy: float = 0.005
    clip: float = 0.2
    init_std: float = 0.35
    final_std: float = 0.0
    settle: float = 0.5
    mirror: float = 0.0
    hidden: tuple[int, ...] = (512, 256, 128)
    algorithm: str = "PPO"


@dataclass(frozen=True)
class TrainCfg:
    """An experiment file in cfg/; which of those below it is depends on the mode."""

    env: StanceCfg | LegsCfg | UnifiedCfg
    ppo: PpoCfg = field(default_factory=PpoCfg)


@dataclass(frozen=True)
class StanceTraining(TrainCfg):
    """Of a stance."""

    env: StanceCfg


@dataclass(frozen=True)
class LegsTraining(TrainCfg):
    """Of a mode on four legs."""

    env: LegsCfg


@dataclass(frozen=True)
class UnifiedTraining(TrainCfg):
    """Of the policy without modes."""

    env: UnifiedCfg


def read_training(mode: str, name: str, overrides: Sequence[str] = ()) -> TrainCfg:
    """The experiment file cfg/NAME.toml of a mode."""
    legs: type[TrainCfg] = UnifiedTraining if mode == "unified" else LegsTraining
    return load(ROOT / "cfg" / f"{name}.toml", StanceTraining if mode in STANCES else legs, overrides)


def rsl_config(cfg: PpoCfg) -> dict[str, Any]:
    """rsl-rl's own configuration."""
    network = dict(
        class_name="MLPModel", hidden_dims=list(cfg.hidden), activation="swish", obs_normalization=True
    )
    noise = dict(
        class_name="GaussianDistribution",
        init_std=cfg.init_std,
        std_type="log",
        learn_std=cfg.final_std == 0,
    )
    symmetry = dict(data_augmentation_func=both_sides, use_mirror_loss=True, mirror_loss_coeff=cfg.mirror)
    return dict(
        num_steps_per_env=cfg.steps,
        save_interval=50,
        check_for_nan=False,  # the environment isolates broken worlds itself
        obs_groups={"actor": ["policy"], "critic": ["critic"]},
        actor={**network, "distribution_cfg": noise},
        critic=dict(network),
        algorithm=dict(
            class_name=cfg.algorithm,
            num_learning_epochs=cfg.epochs,
            num_mini_batches=cfg.minibatches,
            learning_rate=cfg.learning_rate,
            schedule="fixed",
            gamma=cfg.gamma,
            lam=cfg.lam,
            entropy_coef=cfg.entropy,
            clip_param=cfg.clip,
            max_grad_norm=1.0,
            symmetry_cfg=symmetry if cfg.mirror > 0 else None,
        ),
    )


def metadata(cfg: TrainCfg, argv: Sequence[str], seed: int) -> dict[str, str]:
    """What a checkpoint, and the policy exported from it, say about their making."""
    config = portable(asdict(cfg))
    return {
        "command": shlex.join(["python", "train/ppo.py", *portable(list(argv))]),
        "seed": str(seed),
        "config": json.dumps(config),
        "config_sha256": config_hash(config),
    }


def config_hash(config: dict[str, Any]) -> str:
    """SHA-256 of a configuration as JSON with sorted keys, in hex."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


def portable(value: Any) -> Any:
    """A value whose absolute paths, also behind a "=", are relative to the repository.

    A path outside of it is cut down to its name: how this machine's folders are called helps nobody.
    """
    if isinstance(value, dict):
        return {key: portable(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [portable(inner) for inner in value]
    if not isinstance(value, str):
        return value
    key, equals, path = value.rpartition("=")
    path = path.strip("\"'") if equals else path
    if not os.path.isabs(path):
        return value
    inside = Path(path).is_relative_to(ROOT)
    return key + equals + (Path(path).relative_to(ROOT).as_posix() if inside else Path(path).name)
