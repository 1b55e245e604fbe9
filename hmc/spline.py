"""Linear splines over a horizon: what the knots weigh at each step, and the knots nearest to given inputs."""

from __future__ import annotations

import torch
from torch import Tensor


def interpolate(at: Tensor, knots: int) -> Tensor:
    """Rows of linear interpolation weights at positions `at` in knot units, (len(at), knots)."""
    at = at.clamp(0, knots - 1)
    low = at.floor().long().clamp(max=knots - 2)
    w = (at - low)[:, None]
    eye = torch.eye(knots, dtype=torch.float64)
    return (1 - w) * eye[low] + w * eye[low + 1]


def spline(horizon: int, knots: int) -> Tensor:
    """B of the plan u = B theta, (H, K): knot j sits at step j (H - 1) / (K - 1)."""
    return interpolate(torch.linspace(0, knots - 1, horizon, dtype=torch.float64), knots)


def nearest(weights: Tensor, inputs: Tensor) -> Tensor:
    """theta (K, nu) whose plan B theta, B the weights (H, K), is nearest to inputs (H, nu): least squares."""
    return torch.linalg.lstsq(weights, inputs).solution
