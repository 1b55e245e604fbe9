"""An untrained policy as a file, with the network that train/ppo.py trains: for measurements and tests."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from hmc.go2.facts import COMMANDS, OBS_SIZE, contract
from hmc.go2.stances import HOLDS

HIDDEN = (512, 256, 128)


def write_random_policy(
    path: Path, hidden: tuple[int, ...] = HIDDEN, seed: int = 0, mode: str = "handstand"
) -> Path:
    """Write a policy with random weights and its contract to `path`, which is given back."""
    command = COMMANDS.get(mode, ())
    rng = np.random.default_rng(seed)
    nodes, weights, last = [], [], "obs"
    sizes = [OBS_SIZE + len(command), *hidden, 12]
    for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
        w = rng.uniform(-1, 1, (n_out, n_in)).astype(np.float32) / np.sqrt(n_in).astype(np.float32)
        weights += [
            numpy_helper.from_array(w, f"w{layer}"),
            numpy_helper.from_array(np.zeros(n_out, np.float32), f"b{layer}"),
        ]
        out = "actions" if layer == len(hidden) else f"linear{layer}"
        nodes.append(helper.make_node("Gemm", [last, f"w{layer}", f"b{layer}"], [out], transB=1))
        if layer < len(hidden):  # swish
            nodes.append(helper.make_node("Sigmoid", [out], [f"gate{layer}"]))
            nodes.append(helper.make_node("Mul", [out, f"gate{layer}"], [f"hidden{layer}"]))
        last = f"hidden{layer}"
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["batch", sizes[0]])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["batch", 12])],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    about = {"mode": mode, "default_pose": HOLDS[mode].pose.tolist(), "command": list(command)}
    fields = {**contract(), **about, "action_scale": 0.5}
    for key, value in fields.items():
        model.metadata_props.add(key=key, value=json.dumps(value))
    onnx.save(model, str(path))
    return path
