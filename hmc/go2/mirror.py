"""Left and right exchanged: the Go2 is its own mirror image in the plane of its x and z axes."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

# of each joint its mirror image's index, and the sign that its angle takes: the hip turns the other way
_JOINT = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
_SIGN = (-1.0, 1.0, 1.0) * 4


def mirror_joints(values: Tensor) -> Tensor:
    """Joint positions, speeds, torques or actions (..., 12) of the mirror image."""
    index, sign = _tables(1, values.dtype, values.device)
    return values[..., index] * sign


def mirror_observation(obs: Tensor) -> Tensor:
    """Observations (..., 48) of `hmc.go2.observe` as the mirror image has them."""
    index, sign = _tables(4, obs.dtype, obs.device)
    return obs[..., index] * sign


@cache
def _tables(parts: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Index and sign of each value: of joints alone (1), or of a whole observation (4 parts)."""
    index, sign = list(_JOINT), list(_SIGN)
    if parts > 1:
        # gravity, position and velocity are vectors: y changes sign; a rate of turn changes x and z
        sign = [1.0, -1.0, 1.0] * 3 + [-1.0, 1.0, -1.0] + sign * 3
        index = list(range(12)) + [12 * (part + 1) + joint for part in range(3) for joint in index]
    with torch.inference_mode(False):
        return torch.tensor(index, device=device), torch.tensor(sign, dtype=dtype, device=device)
