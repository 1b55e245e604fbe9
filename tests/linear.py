"""A linear system that sampling MPC can be checked on by hand."""

from __future__ import annotations

import math

import torch

from hmc import Cost

A = torch.tensor([[1.0, 0.1], [-0.2, 0.9]], dtype=torch.float64)


class Linear:
    """x' = A x + 0.3 u, elementwise, hence the same in a batch of any size; `lost` beyond |x_0| = `edge`."""

    nx, nu, dt = 2, 2, 0.5
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, num_worlds: int, edge: float = math.inf, lost: float = math.nan):
        self.num_worlds, self.edge, self.lost = num_worlds, edge, lost
        self.rows = torch.zeros(num_worlds, 4, dtype=torch.float64)

    def x(self, ids=None):
        return self.rows[slice(None) if ids is None else ids, :2].clone()

    def u(self, ids=None):
        return self.rows[slice(None) if ids is None else ids, 2:].clone()

    def reset(self, x, u, ids=None):
        self.rows[slice(None) if ids is None else ids] = torch.cat([x, u], 1)

    def step(self, u, ids=None):
        x = self.x(ids)
        after = x[:, :1] * A[:, 0] + x[:, 1:] * A[:, 1] + 0.3 * u
        after[after[:, 0].abs() > self.edge] = self.lost
        self.reset(after, u, ids)

    def save(self, ids=None):
        return self.rows[slice(None) if ids is None else ids].clone()

    def load(self, rows, ids=None):
        self.rows[slice(None) if ids is None else ids] = rows


COST = Cost(
    stage={
        "x": lambda x, u, u_prev, k: (x[:, 0] - torch.cos(0.3 * k.to(x.dtype))) ** 2 + x[:, 1] ** 2,
        "u": lambda x, u, u_prev, k: 0.1 * u[:, 0] ** 2 + 0.05 * (u - u_prev)[:, 1] ** 2,
    },
    terminal={"end": lambda x, k: 2.0 * x[:, 0] ** 2 + 0.01 * k.to(x.dtype)},
    nonnegative=True,
)
