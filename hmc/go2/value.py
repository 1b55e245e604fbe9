"""What it is worth to be in a state under a learned mode: its critic, for costs at the end of a horizon.

By onnxruntime or, on a GPU, by torch.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hmc.go2 import network
from hmc.go2.model import motor_torque, motor_torque_in_numpy
from hmc.go2.network import opened
from hmc.go2.observe import anchor_of, observe
from hmc.go2.stances import HOLDS
from hmc.go2.torch_network import TorchNetwork

VALUE_EXTRA = 13  # what a critic sees after the observation: joint torques and the base's height


def seen(obs: Tensor, torque: Tensor, height: Tensor) -> Tensor:
    """What a critic sees, (n, c + 13).

    Args:
        obs: observation without noise, and the command, (n, c).
        torque: of the joints (n, 12) [N m].
        height: of the base (n,) [m].
    """
    return torch.cat([obs, 0.1 * torque, height[:, None]], -1)


class Value:
    """The value of states under a stance's policy, as a share of that of the stance at rest.

    A state alone does not say what the joints were told last, nor where the mode would be entered: they are
    taken to be held where they are, and the mode to begin there.

    Attributes:
        metadata: its contract and how it was made, as of `hmc.go2.network.Network`.
        mode: whose value it is.
        rest: value of the stance at rest, in rewards.

    Args:
        path: ONNX file of train/export.py --value.
        threads: of onnxruntime; 0 for all cores. Values do not depend on it.

    Raises:
        ValueError: the file cannot be read, is that of a policy, or a field of its contract does not match.
    """

    def __init__(self, path: str | Path, threads: int = 1):
        self._path = Path(path)
        self._session, self.metadata = opened(self._path, threads)
        if not self.metadata.get("value"):
            raise ValueError(f"value {path}: it is a policy: export its value with train/export.py --value")
        self.mode = str(self.metadata["mode"])
        self._devices: dict[torch.device, TorchNetwork] = {}
        self.rest = 1.0
        self.rest = float(self(HOLDS[self.mode].state()[None])[0])

    def __call__(self, x: Tensor) -> Tensor:
        """Values of states x (n, 37), (n,)."""
        if x.device.type != "cpu":
            q = x[:, 7:19]
            torque = motor_torque(q, x[:, 25:37], q)
            output = self.on_device(seen(observe(x, q, anchor_of(x)), torque, x[:, 2]).float())
        else:  # in numpy: for few states a torch operation takes several times as long
            state = x.numpy()
            held = state[:, 7:19]
            obs = network.observe(state, held, network.anchor_of(state))
            pull = 0.1 * motor_torque_in_numpy(held, state[:, 25:37], held)
            given = np.concatenate([obs, pull, state[:, 2:3]], 1).astype(np.float32)  # as `seen`
            output = torch.from_numpy(self._session.run(None, {"obs": given})[0])
        return output[:, 0].to(x) / self.rest

    def on_device(self, obs: Tensor) -> Tensor:
        """The critic's output (n, 1) for what it sees (n, c + 13) float32, without leaving its device."""
        if obs.device not in self._devices:
            with torch.inference_mode(False):
                self._devices[obs.device] = TorchNetwork(self._path, obs.device)
        return self._devices[obs.device](obs)
