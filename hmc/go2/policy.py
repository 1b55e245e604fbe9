"""Learned modes: an ONNX file that carries its contract, run by onnxruntime."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.facts import disagreement
from hmc.go2.observe import anchor_of, observe
from hmc.modes import Mode


class Policy(Mode):
    """A learned mode from a file.

    Target = default_pose + action_scale x network(observation), inside the joint limits. Memory: the
    anchor, where the mode was entered (see `hmc.go2.observe`).

    Args:
        path: ONNX file with its contract in the metadata.
        name: of the mode; default: the file's.
        threads: of onnxruntime; 0 for all cores. Actions do not depend on it.

    Raises:
        ValueError: the file cannot be read, or a field of its contract does not match; names it.
    """

    memory_size = 4

    def __init__(self, path: str | Path, *, name: str = "", threads: int = 1):
        self.path = Path(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # idle threads of the network must not spin on the cores that step worlds
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        if not self.path.is_file():
            raise ValueError(f"policy {self.path}: no such file")
        try:
            self._session = onnxruntime.InferenceSession(
                str(self.path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise ValueError(f"policy {self.path}: not a readable ONNX file ({error})") from error
        fields = self._session.get_modelmeta().custom_metadata_map
        self.metadata = {key: _decoded(text) for key, text in fields.items()}
        self._check()
        self.name = name or str(self.metadata["mode"])
        pose = torch.tensor(self.metadata["default_pose"], dtype=torch.float64)
        self._targets = torch.stack([pose, go2.Q_LOWER.double(), go2.Q_UPPER.double()])
        self._scale = float(self.metadata["action_scale"])

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        return anchor_of(x)

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        obs = observe(x, u, memory[:, :4]).float().cpu().numpy()
        (output,) = self._session.run(None, {"obs": obs})
        action = torch.from_numpy(np.asarray(output)).to(x)
        pose, lower, upper = self._targets.to(x).unbind()
        return (pose + self._scale * action).clamp(lower, upper), memory

    def _check(self) -> None:
        if wrong := disagreement(self.metadata):
            raise ValueError(f"policy {self.path}: {wrong}")


def _decoded(text: str) -> Any:
    """A metadata value: JSON as we write it, else the text that another program wrote."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
