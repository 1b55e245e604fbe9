"""Training in several processes: each has a device and a seed of its own, and one of them writes."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from tests.tiny import make_runner
from train import ppo
from train.runner import read_checkpoint


def test_torchrun_gives_each_process_its_own_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    args = ppo.Args("handstand")
    assert ppo.under_torchrun(args, 5) == (args, 5)
    for key, value in {"WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2", "RANK": "3", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(key, value)
    mine, seed = ppo.under_torchrun(args, 5)
    assert (mine.device, seed) == ("cuda:1", 3005)
    with pytest.raises(ValueError, match="a GPU of its own: leave --device cuda:0 out"):
        ppo.under_torchrun(ppo.Args("handstand", device="cuda:0"), 5)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    with pytest.raises(ValueError, match="4 processes here for 2: take --nproc-per-node=2"):
        ppo.under_torchrun(args, 5)


def test_two_processes_train_together(tmp_path):
    """tests/ranks.py goes on from a checkpoint: alike networks from unlike experience, one writes."""
    alone = make_runner(tmp_path)
    alone.last_iteration = 1
    ppo.train(alone, tmp_path)
    command = (*("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"), "tests/ranks.py")
    done = subprocess.run(
        [sys.executable, *command, str(tmp_path), "2"],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ppo.ROOT,
    )
    assert done.returncode == 0, done.stderr
    first, second = (torch.load(tmp_path / f"rank_{rank}") for rank in (0, 1))
    assert not torch.equal(first["x"], second["x"])
    assert all(torch.equal(value, second["network"][key]) for key, value in first["network"].items())
    before = alone.alg.actor.mlp.state_dict()
    assert any(not torch.equal(value, before[key]) for key, value in first["network"].items())
    names = [path.name for path in tmp_path.iterdir()]
    assert sorted(name for name in names if name.endswith(".pt")) == ["latest.pt", "model_0.pt", "model_1.pt"]
    assert sum(name.startswith("events") for name in names) == 2, "one of each run"
    checkpoint = read_checkpoint(tmp_path / "latest.pt")
    assert (checkpoint["iter"], checkpoint["infos"]["steps"]) == (1, (1 + 2) * 6 * 8)


def test_only_the_first_process_writes(tmp_path):
    runner = make_runner(tmp_path)
    runner.logger.disable_logs = True
    runner.save(str(tmp_path / "model_0.pt"))
    assert not list(tmp_path.iterdir())
