"""Learned modes: an ONNX file that carries its contract, run by onnxruntime or, on a GPU, by torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from hmc.go2 import network
from hmc.go2.network import LOWER, UPPER, Network
from hmc.go2.observe import anchor_of, follow, observe
from hmc.go2.torch_network import TorchNetwork
from hmc.modes import Mode


class Policy(Mode):
    """A learned mode from a file, see `hmc.go2.network.Network`.

    Memory: the anchor, where the mode was entered, drawn along with a robot that drifts far (see
    `hmc.go2.observe`).

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
        self._devices: dict[torch.device, OnDevice] = {}

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        if x.device.type != "cpu":
            return anchor_of(x)
        return torch.from_numpy(network.anchor_of(x.numpy()))

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        told = None if self.command is None else self.command(x, k)
        if x.device.type != "cpu":
            memory = follow(x, memory)
            return self.on_device(x, u, memory, told), memory
        # in numpy: for few worlds a torch operation takes several times as long
        state, before = x.numpy(), memory.numpy()
        anchor = network.follow(state, before)
        target = self.network.act(state, u.numpy(), anchor, None if told is None else told.numpy())
        action = torch.from_numpy(target).to(x.dtype)
        return action, memory if anchor is before else torch.from_numpy(anchor)

    def on_device(self, x: Tensor, u: Tensor, anchor: Tensor, command: Tensor | None = None) -> Tensor:
        """Joint targets [rad], (n, 12), as of `Network.act`, without leaving the device of x (n, 37)."""
        if x.device not in self._devices:
            self._devices[x.device] = OnDevice(self.network, x.device)
        here = self._devices[x.device]
        obs = observe(x, u, anchor)
        if command is not None:
            obs[:, 3:5] = 0.0
            obs = torch.cat([obs, command.to(obs)], 1)
        output = here.network(obs.float()).double()
        return torch.clamp(here.pose + self.network.scale * output, here.lower, here.upper).to(x)


class OnDevice:
    """A policy's network, and what its targets are made of, on a device."""

    @torch.inference_mode(False)
    def __init__(self, network: Network, device: torch.device):
        self.network = TorchNetwork(network.path, device)
        self.pose, self.lower, self.upper = (
            torch.from_numpy(each).to(device) for each in (network.pose, LOWER, UPPER)
        )
