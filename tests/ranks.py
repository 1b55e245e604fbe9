"""One of the processes that torchrun starts, on gloo and the CPU in place of NCCL and GPUs.

`torchrun --nproc-per-node=2 tests/ranks.py FOLDER ITERATIONS`: train on from where FOLDER is; each process
leaves its network and its robots' states there.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from rsl_rl.runners import OnPolicyRunner

from tests.tiny import make_runner
from train import ppo

RANK = int(os.environ["RANK"])
join, configure = torch.distributed.init_process_group, OnPolicyRunner._configure_multi_gpu


def on_the_cpu(runner: Any) -> None:
    """rsl-rl's own set-up, which insists on a GPU for each process."""
    device, runner.device = runner.device, f"cuda:{RANK}"
    configure(runner)
    runner.device = device


def main(folder: Path, iterations: int) -> None:
    """Train to so many iterations in all."""
    setattr(torch.distributed, "init_process_group", lambda backend, **given: join("gloo", **given))  # noqa: B010
    setattr(torch.cuda, "set_device", lambda index: None)  # noqa: B010
    OnPolicyRunner._configure_multi_gpu = on_the_cpu
    torch.set_num_threads(1)
    torch.manual_seed(7 + 1000 * RANK)
    runner = make_runner(folder)
    if (folder / "latest.pt").exists():
        runner.resume(str(folder / "latest.pt"))
    runner.last_iteration = iterations
    ppo.train(runner, folder)
    made = {"network": runner.alg.actor.mlp.state_dict(), "x": runner.env.sim.x()}
    torch.save(made, folder / f"rank_{RANK}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
