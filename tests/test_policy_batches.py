"""A policy's actions depend on the state alone: not on the batch, and not on the number of threads."""

from __future__ import annotations

from pathlib import Path

import torch

from hmc.go2.policy import Policy
from hmc.go2.stances import HANDSTAND
from tools.random_policy import write_random_policy


def test_same_action_in_any_batch_at_any_thread_count(tmp_path: Path) -> None:
    path = write_random_policy(tmp_path / "random.onnx")
    x = HANDSTAND.state() + 0.1 * torch.randn(300, 37, dtype=torch.float64)
    x[:, 3:7] /= x[:, 3:7].norm(dim=1, keepdim=True)
    u, k = x[:, 7:19].clone(), torch.zeros(300, dtype=torch.long)
    one = Policy(path, threads=1)
    memory = one.reset(x, u, k)
    expected, _ = one.act(x, u, memory, k)
    for threads in (1, 2, 3):
        policy = Policy(path, threads=threads)
        for n in (*range(1, 40), 63, 64, 65, 128, 200, 256, 257, 300):
            rows = slice(300 - n, 300)
            action, _ = policy.act(x[rows], u[rows], memory[rows], k[rows])
            assert torch.equal(action, expected[rows]), (threads, n)
