"""Policy files in torch, for states that live on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor


def _gemm(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    return x @ weight.T if bias is None else torch.addmm(bias, x, weight.T)


OPERATIONS: dict[str, Callable[..., Tensor]] = {
    "Add": torch.add,
    "Div": torch.div,
    "Gemm": _gemm,
    "Mul": torch.mul,
    "Sigmoid": torch.sigmoid,
    "Sub": torch.sub,
}
GEMM = {"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": 1}  # the one that `_gemm` is


class TorchNetwork:
    """What onnxruntime makes of a policy file, by torch operations on a device.

    Sums in a matrix product may be ordered otherwise there: outputs agree to rounding, not to the bit.

    Args:
        path: ONNX file, as train/export.py writes it.
        device: where it runs.

    Raises:
        ValueError: onnx is not installed, or the file has an operation that is not among OPERATIONS.
    """

    def __init__(self, path: Path, device: torch.device):
        try:
            import onnx
            from onnx import numpy_helper
        except ModuleNotFoundError as error:
            raise ValueError("policies on a GPU need onnx: pip install 'hmc[warp]'") from error
        graph = onnx.load(str(path)).graph
        for node in graph.node:
            given = {each.name: onnx.helper.get_attribute_value(each) for each in node.attribute}
            if node.op_type not in OPERATIONS or (node.op_type == "Gemm" and given != GEMM):
                raise ValueError(
                    f"policy {path}: operation {node.op_type} {given or ''} is none that runs on a GPU here "
                    f"({', '.join(OPERATIONS)}): run it on the CPU"
                )
        self._steps = [(OPERATIONS[node.op_type], tuple(node.input), node.output[0]) for node in graph.node]
        self._constants = {
            each.name: torch.from_numpy(numpy_helper.to_array(each).copy()).to(device)
            for each in graph.initializer
        }
        self._input, self._output = graph.input[0].name, graph.output[0].name

    def __call__(self, obs: Tensor) -> Tensor:
        """The network's output, (n, 12) float32, for observations with their commands (n, 48 + c) float32."""
        values = {**self._constants, self._input: obs}
        for operation, inputs, output in self._steps:
            values[output] = operation(*(values[name] for name in inputs))
        return values[self._output]
