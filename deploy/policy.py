"""Learned modes on onnxruntime alone: the file that `hmc.go2.policy` reads, for one robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from deploy.observe import observe
from deploy.so3 import Array
from hmc.go2 import facts

LOWER, UPPER = np.array(facts.Q_LOWER), np.array(facts.Q_UPPER)


class Policy:
    """Target = default_pose + action_scale x network(observation), inside the joint limits.

    Args:
        path: ONNX file with its contract in the metadata.

    Raises:
        ValueError: the file cannot be read, or a field of its contract does not match; names it.
    """

    def __init__(self, path: Path):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        if not path.is_file():
            raise ValueError(f"policy {path}: no such file")
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise ValueError(f"policy {path}: not a readable ONNX file ({error})") from error
        fields = self._session.get_modelmeta().custom_metadata_map
        metadata = {key: _decoded(text) for key, text in fields.items()}
        if wrong := facts.disagreement(metadata):
            raise ValueError(f"policy {path}: {wrong}")
        self.mode = str(metadata["mode"])
        self._pose = np.array(metadata["default_pose"], dtype=np.float64)
        self._scale = float(metadata["action_scale"])

    def act(self, x: Array, u: Array, anchor: Array) -> Array:
        """Joint targets [rad], (12,); arguments as of `deploy.observe.observe`."""
        obs = observe(x, u, anchor).astype(np.float32)[None]
        (output,) = self._session.run(None, {"obs": obs})
        target = self._pose + self._scale * output[0].astype(np.float64)
        return np.minimum(np.maximum(target, LOWER), UPPER)


def _decoded(text: str) -> Any:
    """A metadata value: JSON as the exporter writes it, else the text that another program wrote."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
