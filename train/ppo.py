"""Train a learned mode: `python train/ppo.py --mode handstand`, by torchrun on several GPUs."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402

from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.sim.device import devices, used_up  # noqa: E402
from hmc.sim.make import choose  # noqa: E402
from train.config import metadata, read_training, rsl_config  # noqa: E402
from train.env import Go2Env  # noqa: E402
from train.make import make_env  # noqa: E402
from train.runner import Runner, read_checkpoint  # noqa: E402


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        mode: which mode; its settings are in cfg/MODE.toml.
        stage: a further stage, set in cfg/MODE_STAGE.toml; it begins with the networks of --checkpoint, or of
            out/train/MODE/latest.pt.
        engine: auto takes MuJoCo Warp where a GPU is there, else C MuJoCo.
        device: of engine and networks, such as cpu or cuda:0; auto takes a GPU if there is one.
        threads: of the C engine and of torch; 0 for all cores.
        seed: of everything random; 1 if not given. A run that goes on keeps the seed that it began with.
        deterministic: on a GPU, let torch and the engine do what they can for the same seed to give the same
            policy, slower; what the engine lacks for that is in docs/scale.md. On a CPU with one number of
            threads it always does.
        out: folder for checkpoints and logs; default out/train/MODE or out/train/MODE_STAGE.
        resume: go on from the latest checkpoint in `out`, or from the file given by --checkpoint.
        checkpoint: a file to begin from (weights, optimiser, curriculum).
        iterations: overrides ppo.iterations.
        set: overrides, such as env.rewards.power=0.001.
        play: a checkpoint to record an episode of, instead of training.
    """

    mode: Literal["handstand", "footstand", "stand", "getup", "walk", "unified"]
    stage: str = ""
    engine: Literal["auto", "mujoco", "warp"] = "auto"
    device: str = "auto"
    threads: int = 0
    seed: int | None = None
    deterministic: bool = False
    out: Path | None = None
    resume: bool = False
    checkpoint: Path | None = None
    iterations: int | None = None
    set: tuple[str, ...] = ()
    play: Path | None = None

    @property
    def name(self) -> str:
        """Of the configuration file, without its ending."""
        return f"{self.mode}_{self.stage}" if self.stage else self.mode

    @property
    def folder(self) -> Path:
        """Where everything is written."""
        return self.out or ROOT / "out" / "train" / self.name


def seed_of(args: Args, goes_on: Path | None = None) -> int:
    """The seed of a new run, or of the one whose checkpoint goes on: it drew that one's robots.

    Raises:
        ValueError: another one is asked for.
    """
    if goes_on is None:
        return 1 if args.seed is None else args.seed
    own = int(read_checkpoint(goes_on)["infos"]["meta"]["seed"])
    if args.seed not in (None, own):
        raise ValueError(
            f"--seed {args.seed}: the run of {goes_on} has the seed {own}, which drew its robots: leave "
            "--seed out to go on with it, or begin another run"
        )
    return own


def under_torchrun(args: Args, seed: int) -> tuple[Args, int]:
    """Under torchrun each process has a GPU and a seed of its own; else arguments and seed as they are.

    Raises:
        ValueError: there is not a GPU for each process of this machine.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return args, seed
    gpus, processes = torch.cuda.device_count(), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if not torch.cuda.is_available():
        raise ValueError(
            "torchrun starts one process a GPU and there is none here: run python train/ppo.py alone"
        )
    if processes > gpus:
        raise ValueError(
            f"torchrun starts one process a GPU, {processes} processes here for {gpus}: take "
            f"--nproc-per-node={gpus}"
        )
    if args.device != "auto":
        raise ValueError(f"torchrun gives each process a GPU of its own: leave --device {args.device} out")
    rank, local = int(os.environ.get("RANK", "0")), int(os.environ.get("LOCAL_RANK", "0"))
    return replace(args, device=f"cuda:{local}"), seed + 1000 * rank


def set_up(args: Args, argv: Sequence[str] | None = None) -> Runner:
    """Everything that training needs; what the user got wrong is a ValueError.

    Args:
        args: what to train.
        argv: the command line that asks for it, which the policy will name; None for this program's.
    """
    cfg = read_training(args.mode, args.name, args.set)
    if args.iterations is not None:
        cfg = replace(cfg, ppo=replace(cfg.ppo, iterations=args.iterations))
    checkpoint = args.checkpoint or (args.folder / "latest.pt" if args.resume else None)
    new_stage = bool(args.stage) and not args.resume
    args, seed = under_torchrun(args, seed_of(args, None if new_stage else checkpoint))
    torch.manual_seed(seed)
    if args.deterministic:
        # the engine follows torch; cuBLAS wants this set before its first call
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
    if args.threads:
        torch.set_num_threads(args.threads)
    device = None if args.device == "auto" else args.device
    env = make_env(cfg.env, args.engine, device=device, threads=args.threads, seed=seed)
    meta = metadata(cfg, sys.argv[1:] if argv is None else argv, seed)
    runner = Runner(env, rsl_config(cfg.ppo), str(args.folder), str(env.device), meta)
    if new_stage:
        runner.begin_with(str(checkpoint or ROOT / "out" / "train" / args.mode / "latest.pt"))
    elif checkpoint is not None:
        runner.resume(str(checkpoint))
    runner.last_iteration = cfg.ppo.iterations
    runner.anneal = cfg.ppo.anneal
    runner.final_std, runner.settle = cfg.ppo.final_std, cfg.ppo.settle
    runner.set_learning_rate(runner.current_learning_iteration)
    runner.set_noise(runner.current_learning_iteration)
    return runner


def train(runner: Runner, folder: Path) -> None:
    """Train to the last iteration, or until Ctrl-C."""
    first, alone = runner.current_learning_iteration, not runner.is_distributed
    say = print if runner.gpu_global_rank == 0 else str  # one of torchrun's processes talks
    if first >= runner.last_iteration:
        say(f"{first} iterations are done already: ask for more with --iterations")
        return
    folder.mkdir(parents=True, exist_ok=True)
    with runner.table.live or contextlib.nullcontext():
        try:
            runner.learn(runner.last_iteration - first, init_at_random_ep_len=True)
        except KeyboardInterrupt:
            done = runner.save_interrupted()
            note = f"go on with --resume (checkpoint in {folder})" if done else "nothing was learned yet"
            say(f"stopped; {note}")
        except RuntimeError as error:
            if not used_up(error):
                raise
            env = runner.env
            raise SystemExit(
                f"error: {env.device} has no memory left for {env.num_envs:,} worlds and learning from "
                f"them: take --set env.worlds={env.num_envs // 2}, with --resume from the last checkpoint on"
            ) from None
        finally:
            if not alone:
                torch.distributed.destroy_process_group()


def engine_in_words(args: Args, env: Go2Env) -> str:
    """What steps how many worlds where; where it was to be chosen, also why it is not the GPU's."""
    engine, _ = choose(args.engine, env.device)
    open_to_all = args.engine == args.device == "auto"
    why = f": {devices()}" if open_to_all and env.device.type == "cpu" else ""
    return f"engine {engine}, {env.num_envs:,} worlds on {env.device}{why}"


def main(args: Args) -> None:
    """Train, or play."""
    if args.play is not None:
        from train.play import play

        with one_line_errors():
            print(play(args.play, args.mode, args.folder, seed=seed_of(args), threads=args.threads))
        return
    with one_line_errors():
        runner = set_up(args)
    if runner.gpu_global_rank == 0:
        print(engine_in_words(args, runner.env))
    train(runner, args.folder)


if __name__ == "__main__":
    main(command_line(Args))
