"""Learned modes: an ONNX file that carries its contract, run by onnxruntime."""

from __future__ import annotations

from collections.abc import Callable
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
        command: of a policy that obeys one: what it is told at states x (n, 37) and control steps k (n,),
            (n, c); a deterministic function of each row alone.

    Raises:
        ValueError: the file cannot be read, a field of its contract does not match, or it obeys a command and
            none is given, or the other way round; names it.
    """

    memory_size = 4

    def __init__(
        self,
        path: str | Path,
        *,
        name: str = "",
        threads: int = 1,
        command: Callable[[Tensor, Tensor], Tensor] | None = None,
    ):
        self.network = Network(path, threads)
        self.name = name or self.network.mode
        if bool(self.network.command) != (command is not None):
            wants = ", ".join(self.network.command) or "no command"
            got = "none is given" if command is None else "one is given"
            raise ValueError(f"policy {path}: it obeys {wants}, and {got}: see the argument command")
        self.command = command

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        return anchor_of(x)

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        # in numpy: for few worlds a torch operation takes several times as long
        told = () if self.command is None else (self.command(x, k),)
        target = self.network.act(*(each.cpu().numpy() for each in (x, u, memory, *told)))
        return torch.from_numpy(target).to(x), memory
