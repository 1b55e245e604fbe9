"""Devices by name, with an error in one line for one that is not there."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


def find_device(device: str | torch.device) -> torch.device:
    """The torch device of a name, with its index; an error if this machine has no such device."""
    try:
        found = torch.device(device)
    except RuntimeError:
        raise ValueError(f"unknown device {str(device)!r}: name one like cpu or cuda:0") from None
    if found.type == "cpu":
        return torch.device("cpu")
    if found.type != "cuda":
        raise ValueError(f"engines run on cpu or cuda devices, not on {device}")
    index = found.index or 0
    if index >= torch.cuda.device_count():
        raise ValueError(f"device {device} does not exist, {devices()}: take one of these")
    return torch.device("cuda", index)


def devices() -> str:
    """What there is, in words."""
    count = torch.cuda.device_count()
    if count:
        return "there are cpu, " + ", ".join(f"cuda:{i}" for i in range(count))
    if torch.version.cuda is None:
        return "there is only cpu (this torch is built without CUDA)"
    return "there is only cpu (no GPU, or an NVIDIA driver that is missing or too old)"


def free_memory(device: torch.device) -> float:
    """Bytes that are free on a device; without end on a CPU, which says for itself when it has no more.

    What torch and Warp keep of what was given up counts as free; on a GPU that is waited for.
    """
    if device.type == "cpu":
        return float("inf")
    torch.cuda.synchronize(device)  # Warp gives back then
    torch.cuda.empty_cache()
    return float(torch.cuda.mem_get_info(device)[0])


def used_up(error: RuntimeError) -> bool:
    """Whether an error says that a device has no memory left; torch and Warp each have words of their own."""
    return any(words in str(error) for words in ("out of memory", "Failed to allocate"))


def upload(values: NDArray[Any], device: torch.device) -> Tensor:
    """An array as a tensor on a device, without waiting for what the device has to do before it."""
    found = torch.from_numpy(values)
    # a GPU fetches from pinned memory by itself; what lies elsewhere the host hands over, and may wait for it
    return (found.pin_memory() if device.type == "cuda" else found).to(device, non_blocking=True)


def constant(values: Tensor, like: Tensor) -> Tensor:
    """A module's or an object's constant in the type and on the device of another tensor, copied there once.

    Each copy to a GPU waits until that has done what it was told before. `values` is to be the same
    object at every call.
    """
    return _copied(values, like.dtype, like.device)


@lru_cache(maxsize=64)  # not of every mode that ever was
def _copied(values: Tensor, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return values.to(device, dtype)
