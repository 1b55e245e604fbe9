"""Learned modes: an ONNX file that carries its contract, run by onnxruntime."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from hmc.go2.network import Network
from hmc.go2.observe import anchor_of
from hmc.modes import Mode


class Policy(Mode):
    """A learned mode from a file, see `hmc.go2.network.Network`.

    Memory: the anchor, where the mode was entered (see `hmc.go2.observe`).

    Attributes:
        network: the file's.

    Args:
        path: ONNX file with its contract in the metadata.
        name: of the mode; default: the file's.
        threads: of onnxruntime; 0 for all cores. Actions do not depend on it.

    Raises:
        ValueError: the file cannot be read, or a field of its contract does not match; names it.
    """

    memory_size = 4

    def __init__(self, path: str | Path, *, name: str = "", threads: int = 1):
        self.network = Network(path, threads)
        self.name = name or self.network.mode

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        return anchor_of(x)

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        # in numpy: for few worlds a torch operation takes several times as long
        target = self.network.act(*(each.cpu().numpy() for each in (x, u, memory)))
        return torch.from_numpy(target).to(x), memory
