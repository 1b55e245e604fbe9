"""Train a learned mode: `python train/ppo.py --mode handstand`."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
import tyro  # noqa: E402

from hmc.cfg import digest, load  # noqa: E402
from hmc.go2.model import load_model  # noqa: E402
from hmc.sim.mujoco import MujocoSim  # noqa: E402
from train.env import EnvCfg, StanceEnv  # noqa: E402
from train.runner import Runner  # noqa: E402


@dataclass(frozen=True)
class PpoCfg:
    """Proximal policy optimisation, as rsl-rl names it (small batches: notes in docs/training.md).

    Attributes:
        iterations: updates.
        steps: environment steps a world and update.
        epochs: passes over a batch.
        minibatches: of each pass.
        learning_rate: fixed.
        gamma: discount a control step.
        lam: of the generalised advantage.
        entropy: weight of the action entropy.
        clip: of the probability ratio.
        init_std: of the action noise, in network units.
        hidden: layer sizes of actor and critic.
    """

    iterations: int = 1000
    steps: int = 24
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 3e-4
    gamma: float = 0.985
    lam: float = 0.95
    entropy: float = 0.005
    clip: float = 0.2
    init_std: float = 0.35
    hidden: tuple[int, ...] = (512, 256, 128)


@dataclass(frozen=True)
class TrainCfg:
    """An experiment file in cfg/."""

    env: EnvCfg
    ppo: PpoCfg = field(default_factory=PpoCfg)


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        mode: which mode; its settings are in cfg/MODE.toml.
        engine: auto takes MuJoCo Warp where a GPU is there, else C MuJoCo.
        device: of networks and of the Warp engine, such as cuda:0.
        threads: of the C engine and of torch; 0 for all cores.
        seed: of everything random.
        out: folder for checkpoints and logs; default out/train/MODE.
        resume: go on from the latest checkpoint in `out`, or from the file given by --checkpoint.
        checkpoint: a file to begin from (weights, optimiser, curriculum).
        iterations: overrides the configuration's.
        set: overrides, such as env.rewards.power=0.001.
        play: a checkpoint to show instead of training.
    """

    mode: Literal["handstand", "footstand"]
    engine: Literal["auto", "mujoco", "warp"] = "auto"
    device: str = "auto"
    threads: int = 0
    seed: int = 1
    out: Path | None = None
    resume: bool = False
    checkpoint: Path | None = None
    iterations: int | None = None
    set: tuple[str, ...] = ()
    play: Path | None = None


def rsl_config(cfg: PpoCfg) -> dict[str, Any]:
    """rsl-rl's own configuration."""
    network = dict(
        class_name="MLPModel", hidden_dims=list(cfg.hidden), activation="swish", obs_normalization=True
    )
    noise = dict(class_name="GaussianDistribution", init_std=cfg.init_std, std_type="log")
    return dict(
        num_steps_per_env=cfg.steps,
        save_interval=50,
        check_for_nan=False,  # the environment isolates broken worlds itself
        obs_groups={"actor": ["policy"], "critic": ["critic"]},
        actor={**network, "distribution_cfg": noise},
        critic=dict(network),
        algorithm=dict(
            class_name="PPO",
            num_learning_epochs=cfg.epochs,
            num_mini_batches=cfg.minibatches,
            learning_rate=cfg.learning_rate,
            schedule="fixed",
            gamma=cfg.gamma,
            lam=cfg.lam,
            entropy_coef=cfg.entropy,
            clip_param=cfg.clip,
            max_grad_norm=1.0,
        ),
    )


def main(args: Args) -> None:
    """Train, or play."""
    cfg = load(ROOT / "cfg" / f"{args.mode}.toml", TrainCfg, args.set)
    torch.manual_seed(args.seed)
    if args.threads:
        torch.set_num_threads(args.threads)
    sim = MujocoSim(load_model(), cfg.env.worlds, threads=args.threads)
    env = StanceEnv(cfg.env, sim)
    out = args.out or ROOT / "out" / "train" / args.mode
    out.mkdir(parents=True, exist_ok=True)
    meta = {"command": shlex.join(["python", "train/ppo.py", *sys.argv[1:]]), "seed": str(args.seed),
            "config": json.dumps(asdict(cfg)), "config_sha256": digest(cfg)}
    runner = Runner(env, rsl_config(cfg.ppo), str(out), str(sim.device), meta)
    checkpoint = args.checkpoint or (out / "latest.pt" if args.resume else None)
    if checkpoint is not None:
        runner.resume(str(checkpoint))
    iterations = (args.iterations or cfg.ppo.iterations) - runner.current_learning_iteration
    with runner.table.live or contextlib.nullcontext():
        try:
            runner.learn(iterations, init_at_random_ep_len=checkpoint is None)
        except KeyboardInterrupt:
            runner.save(str(out / f"model_{runner.current_learning_iteration}.pt"))
            print(f"stopped; go on with --resume (checkpoint in {out})")


if __name__ == "__main__":
    main(tyro.cli(Args))
