"""What engine warp needs of a device: drivers, graphs, memory. What lacks is said in one line."""

from __future__ import annotations

import dataclasses
import gc
import warnings
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from hmc.sim.device import free_memory


def graphs(device: torch.device) -> tuple[bool, bool]:
    """Whether steps can be captured as graphs on a device, and whether these can hold loops.

    A warning says what is slower where they cannot. Warp's CPU device has graphs, too.

    Raises:
        ValueError: torch has this GPU and Warp has not.
    """
    if device.type == "cpu":
        return True, True
    if not wp.is_cuda_available():
        raise ValueError(
            f"engine warp: torch finds {device} but Warp {wp.config.version} does not, its CUDA "
            "needs a newer NVIDIA driver: update that, or take engine mujoco"
        )
    captured = wp.is_mempool_supported(wp.device_from_torch(device))
    loops = captured and wp.is_conditional_graph_supported()
    if not loops:
        version = ".".join(map(str, wp.get_cuda_driver_version() or ()))
        instead = (
            "the contact solver always runs to its last iteration" if captured else "each kernel starts alone"
        )
        lack = "loops in CUDA graphs, for which it needs 12.4" if captured else "memory pools in CUDA graphs"
        warnings.warn(
            f"engine warp is slower here: the driver of {device} (CUDA {version}) lacks {lack}; {instead}",
            stacklevel=3,
        )
    return captured, loops


class Recorded:
    """Work on a device of Warp's that is launched as one graph; kernel by kernel where it has no graphs.

    It runs once before it is recorded, because its kernels are compiled and loaded then. What it makes
    lives as long as the graph; arrays that it is to find again must not move.

    Args:
        work: what launches the kernels.
        device: Warp's.
        captured: whether graphs can be recorded there.
    """

    def __init__(self, work: Callable[[], None], device: Any, captured: bool):
        self._work, self._device = work, device
        self._where = wp.device_to_torch(device)
        if device.is_cuda:  # Warp makes arrays and records on a stream of its own, torch's is another
            torch.cuda.synchronize(self._where)
        self.graph = self._capture() if captured else None
        wp.synchronize_device(device)

    def __call__(self) -> None:
        """Do it on the stream that torch works on: nobody waits in between."""
        cuda = self._device.is_cuda
        stream = wp.stream_from_torch(torch.cuda.current_stream(self._where)) if cuda else None
        if self.graph is not None:
            wp.capture_launch(self.graph, stream=stream)
            return
        with wp.ScopedStream(stream):
            self._work()

    def _capture(self) -> Any:
        self._work()
        wp.synchronize_device(self._device)
        collecting = gc.isenabled()
        gc.disable()  # what it collects may free memory of the device, which is not allowed during a capture
        try:
            with wp.ScopedCapture(self._device) as captured:
                self._work()
        finally:
            if collecting:
                gc.enable()
        return captured.graph


def check_memory(one: Any, worlds: int, device: torch.device) -> None:
    """Make sure that so many worlds fit on a device before they are made there.

    Args:
        one: the engine's data of one world.
        worlds: to be made.
        device: where.

    Raises:
        ValueError: less memory is free than they take at least.
    """
    free, each = free_memory(device), num_bytes(one)
    if worlds * each > free:
        raise ValueError(
            f"{worlds:,} worlds take at least {worlds * each / 2**30:.2f} GiB on {device}, where "
            f"{free / 2**30:.2f} GiB are free: take at most {int(free // each):,} worlds"
        )


def num_bytes(data: Any) -> int:
    """Bytes of all arrays of a mujoco_warp structure."""
    values = [getattr(data, field.name) for field in dataclasses.fields(data)]
    parts = [value for value in values if dataclasses.is_dataclass(value)]
    arrays = [value for value in values if isinstance(value, wp.array)]
    return sum(array.capacity for array in arrays) + sum(map(num_bytes, parts))
