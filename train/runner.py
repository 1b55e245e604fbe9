"""rsl-rl's runner with a live table, atomic checkpoints, and everything a resumed run needs."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import random
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rsl_rl.runners import OnPolicyRunner
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from hmc.sim.check import tell_overflow
from train.env import Go2Env

CHECKPOINT_KEYS = ("actor_state_dict", "critic_state_dict", "optimizer_state_dict", "iter", "infos")


class Runner(OnPolicyRunner):
    """`OnPolicyRunner` for one `Go2Env`.

    What rsl-rl's logger reads of a GPU at every step, and waits for, is read once an iteration here.

    A checkpoint also holds the random state, the start-state curriculum and the number of environment
    steps, and is written to a temporary file that replaces the old one only when it is complete.

    Args:
        env: the environment.
        cfg: rsl-rl's configuration.
        log_dir: folder for checkpoints and tensorboard events.
        device: of networks and storage.
        meta: what the exported policy will say about its training.
    """

    env: Go2Env

    def __init__(self, env: Go2Env, cfg: dict[str, Any], log_dir: str, device: str, meta: dict[str, str]):
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks
            super().__init__(env, cfg, log_dir, device)
        self.meta = meta
        self._fuse()
        self.last_iteration = self.updates = 0
        self.anneal = self.final_std = self.settle = 0.0
        self.logger.git_status_repos.clear()  # it looks for its own repository and says that there is none
        self.table = LiveTable(self)
        self._log = self.logger.log
        self.logger.log = self._log_quietly
        self.logger.process_env_step = self._take_down
        self._ended: list[Tensor] = []  # of each step: which episodes ended, returns, lengths, (3, worlds)

    def learn(self, *args: Any, **kwargs: Any) -> None:
        """Train as rsl-rl does. Whatever ends it, the log is whole then, and no thread of it writes on."""
        try:
            super().learn(*args, **kwargs)
        finally:
            if isinstance(self.logger.writer, SummaryWriter):  # rsl-rl stops those of its own kinds alone
                self.logger.writer.close()

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        if self.logger.disable_logs:  # another process of torchrun writes
            return
        rng = {"torch": torch.get_rng_state(), "numpy": np.random.get_state(), "python": random.getstate()}
        if torch.cuda.is_available():
            rng["cuda"] = torch.cuda.get_rng_state(self.device)
        infos = {
            **(infos or {}),
            "meta": self.meta,
            "steps": self.logger.tot_timesteps,
            "seconds": self.logger.tot_time,
            "starts": self.env.starts.state_dict(),
            "rng": rng,
        }
        partial = f"{path}.partial"
        super().save(partial, infos)
        os.replace(partial, path)
        latest = Path(path).with_name("latest.pt")
        if latest != Path(path):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(partial)
            try:
                os.link(path, partial)
            except OSError:  # a file system without links
                shutil.copyfile(path, partial)
            os.replace(partial, latest)

    def save_interrupted(self) -> bool:
        """Save what was learned when `learn` was interrupted; False if that is nothing."""
        if not self.updates:
            return False
        self.save(str(Path(self.logger.log_dir) / f"model_{self.current_learning_iteration}.pt"))
        return True

    def resume(self, path: str) -> None:
        """Go on from a checkpoint; an error names the file and what is wrong with it."""
        rng = self._restore(path, everything=True)["rng"]
        self.current_learning_iteration += 1
        if self.gpu_global_rank:  # the other processes of torchrun keep a noise of their own
            return
        torch.set_rng_state(rng["torch"].cpu())
        np.random.set_state(rng["numpy"])
        random.setstate(rng["python"])
        if "cuda" in rng and self.device.startswith("cuda"):
            torch.cuda.set_rng_state(rng["cuda"].cpu(), self.device)

    def begin_with(self, path: str) -> None:
        """Begin a stage of training with the networks and the curriculum of another one's checkpoint."""
        self._restore(path, everything=False)

    def _restore(self, path: str, *, everything: bool) -> dict[str, Any]:
        """Networks, curriculum and counts of a checkpoint, or everything; its further contents."""
        infos: dict[str, Any] = read_checkpoint(path)["infos"]
        mode = json.loads(infos["meta"]["config"])["env"]["mode"]
        if mode != self.env.cfg.mode:
            raise ValueError(f"checkpoint {path}: it is of mode {mode}; expected {self.env.cfg.mode}")
        what = {"actor": True, "critic": True, "optimizer": everything, "iteration": everything}
        try:
            self.load(path, what, map_location=self.device)
        except RuntimeError as error:
            raise ValueError(
                f"checkpoint {path}: its networks do not fit this configuration, whose hidden layers are "
                f"{self.cfg['actor']['hidden_dims']}: set ppo.hidden as it was trained with"
            ) from error
        self._fuse()
        self.logger.tot_timesteps, self.logger.tot_time = infos["steps"], infos["seconds"]
        try:
            self.env.starts.load_state_dict(infos["starts"])
        except ValueError as error:
            raise ValueError(f"checkpoint {path}: {error}") from None
        return infos

    def set_learning_rate(self, iteration: int) -> None:
        """That of an iteration: as configured, and falling to almost nothing over the last ones."""
        left = (self.last_iteration - iteration) / max(1.0, self.anneal * self.last_iteration)
        rate = self.cfg["algorithm"]["learning_rate"] * min(1.0, max(0.01, left))
        self.alg.learning_rate = rate
        for group in self.alg.optimizer.param_groups:
            group["lr"] = rate

    def set_noise(self, iteration: int) -> None:
        """That of an iteration: as learned, or falling as configured over the last ones."""
        if self.final_std:
            first = self.cfg["actor"]["distribution_cfg"]["init_std"]
            left = (self.last_iteration - iteration) / max(1.0, self.settle * self.last_iteration)
            std = first * (self.final_std / first) ** (1.0 - min(1.0, max(0.0, left)))
            self.alg.actor.distribution.log_std_param.data.fill_(math.log(std))

    def _fuse(self) -> None:
        """Let the optimiser update all of its parameters in one pass: a third of the time on a CPU."""
        for group in self.alg.optimizer.param_groups:
            group["fused"] = True

    def _take_down(self, rewards: Tensor, dones: Tensor, extras: dict[str, Any], *_: Any) -> None:
        """What the logger keeps of a step."""
        log = self.logger
        if log.writer is None:
            return
        log.ep_extras.append(extras["log"])
        log.cur_reward_sum += rewards
        log.cur_episode_length += 1
        self._ended.append(torch.stack([dones.float(), log.cur_reward_sum, log.cur_episode_length]))
        for running in (log.cur_reward_sum, log.cur_episode_length):
            running.masked_fill_(dones > 0, 0.0)

    def _read_off(self) -> None:
        """Give the logger the iteration's episodes, and of its entries the means."""
        log = self.logger
        ended, returns, lengths = torch.stack(self._ended, 1).cpu()
        log.rewbuffer.extend(returns[ended > 0].tolist())
        log.lenbuffer.extend(lengths[ended > 0].tolist())
        log.ep_extras = [means(log.ep_extras)]
        self._ended.clear()

    def _log_quietly(self, **kwargs: Any) -> None:
        self.updates += 1
        self.set_learning_rate(kwargs["it"] + 1)
        self.set_noise(kwargs["it"] + 1)
        tell_overflow(self.env.sim)
        if self.logger.disable_logs:
            return
        self._read_off()
        self.table.update(kwargs, self.logger.ep_extras[0])
        with contextlib.redirect_stdout(io.StringIO()):
            self._log(**kwargs)
        if self.logger.writer is not None:  # a run that goes on may have other worlds and processes
            self.logger.writer.add_scalar("Perf/environment_steps", self.logger.tot_timesteps, kwargs["it"])


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The contents of a checkpoint file.

    Raises:
        ValueError: the file is missing, cut short or not one of ours.
    """
    if not Path(path).is_file():
        raise ValueError(f"checkpoint {path}: no such file")
    try:
        data = torch.load(path, map_location="cpu", weights_only=False)
    except Exception as error:
        size = Path(path).stat().st_size
        raise ValueError(
            f"checkpoint {path}: cannot be read ({type(error).__name__}); its {size} bytes look cut short: "
            "resume from an older model_*.pt in the same folder"
        ) from error
    missing = [key for key in CHECKPOINT_KEYS if not isinstance(data, dict) or key not in data]
    if missing:
        raise ValueError(
            f"checkpoint {path}: lacks {', '.join(missing)}; expected a file written by train/ppo.py"
        )
    return data


def means(entries: list[dict[str, Tensor]]) -> dict[str, float]:
    """The mean of each number () over the steps in which it is one, of those that ever are."""
    names = dict.fromkeys(name for entry in entries for name in entry)
    columns = [torch.stack([entry[name] for entry in entries if name in entry]) for name in names]
    found = torch.stack([column.float().nanmean() for column in columns]).tolist()
    return {name: mean for name, mean in zip(names, found, strict=True) if math.isfinite(mean)}


class LiveTable:
    """Progress on a terminal as one table that updates itself, elsewhere as a line now and then."""

    def __init__(self, runner: Runner):
        self.runner = runner
        self.console = Console()
        shown = self.console.is_terminal and not runner.logger.disable_logs
        self.live = Live(console=self.console, refresh_per_second=2) if shown else None
        self.printed = 0.0

    def update(self, log: dict[str, Any], means: dict[str, float]) -> None:
        """Show one iteration: what the runner logs and the means of the environment's own log entries."""
        size = (
            self.runner.cfg["num_steps_per_env"]
            * self.runner.env.num_envs
            * self.runner.logger.gpu_world_size
        )
        rate = size / (log["collect_time"] + log["learn_time"])
        left = (log["total_it"] - log["it"] - 1) * size / rate
        head = {
            "iteration": f"{log['it'] + 1} / {log['total_it']}",
            "environment steps": f"{(self.runner.logger.tot_timesteps + size) / 1e6:.2f} M",
            "steps/s": f"{rate:,.0f}",
            "time left": time.strftime("%H:%M:%S", time.gmtime(left)),
            "action std": f"{float(log['action_std'].detach().mean()):.3f}",
        }
        if self.live is not None:
            self.live.update(_table(self.runner.env.cfg.mode, head, means))
        elif time.monotonic() - self.printed > 20 or log["it"] + 1 == log["total_it"]:
            self.printed = time.monotonic()
            success = ", ".join(f"{k[9:]} {v:.2f}" for k, v in means.items() if k.startswith("/success/"))
            self.console.print(
                f"{head['iteration']}  {head['environment steps']}  {head['steps/s']} steps/s  "
                f"left {head['time left']}  episode {means.get('/episode/length', 0):.0f}  {success}",
                soft_wrap=True,
                highlight=False,
            )


def _table(title: str, head: dict[str, str], means: dict[str, float]) -> Table:
    table = Table(title=f"training {title}", show_header=False)
    for key, value in head.items():
        table.add_row(key, value)
    group = ""
    for key, mean in means.items():
        _, kind, *rest = key.split("/")
        if kind != group:
            table.add_section()
            group = kind
        table.add_row(" ".join([kind, *rest]), f"{mean:.3f}")
    return table
