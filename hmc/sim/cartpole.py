"""The cartpole in closed form, batched in torch: the smallest system worth planning for."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.sim.check import check


@dataclass(frozen=True)
class CartpoleParams:
    """A cart on a rail and a point mass on a massless pole; the paper gives none of these values.

    Attributes:
        cart_mass: [kg].
        pole_mass: [kg].
        pole_length: from pivot to mass [m].
        gravity: [m/s^2].
        gear: force on the cart per unit of input [N].
    """

    cart_mass: float = 1.0
    pole_mass: float = 0.1
    pole_length: float = 0.5
    gravity: float = 9.81
    gear: float = 10.0

    def __post_init__(self) -> None:
        for name in ("cart_mass", "pole_mass", "pole_length", "gear"):
            if not getattr(self, name) > 0:
                raise ValueError(f"cartpole {name} must be more than 0, got {getattr(self, name)}")


class CartpoleSim:
    r"""W cartpoles; see `hmc.sim.base.Sim`.

    x = (theta, p, theta_dot, p_dot): pole angle from upright [rad], cart position [m] and their rates, as
    in the paper's section V. u = force / gear, (n, 1). One control step is `substeps` steps of the
    classical Runge-Kutta method (RK4) on

        p'' = (F - m g sin(theta) cos(theta) + m l theta'^2 sin(theta)) / (M + m sin(theta)^2)
        theta'' = (g sin(theta) - p'' cos(theta)) / l.

    float64 on the CPU. A snapshot row is (x, u, time): nothing else decides how a world goes on.
    """

    def __init__(
        self,
        num_worlds: int,
        params: CartpoleParams | None = None,
        *,
        dt: float = 0.02,
        substeps: int = 1,
    ):
        if num_worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {num_worlds}")
        if substeps < 1 or not dt > 0:
            raise ValueError(f"expected dt > 0 and substeps >= 1, got dt={dt}, substeps={substeps}")
        self.params = params or CartpoleParams()
        self._dt, self._substeps = dt, substeps
        self._rows = torch.zeros(num_worlds, 6, dtype=torch.float64)

    @property
    def num_worlds(self) -> int:
        return len(self._rows)

    @property
    def nx(self) -> int:
        return 4

    @property
    def nu(self) -> int:
        return 1

    @property
    def dt(self) -> float:
        return self._dt

    @property
    def device(self) -> torch.device:
        return self._rows.device

    @property
    def dtype(self) -> torch.dtype:
        return self._rows.dtype

    def x(self, ids: Tensor | None = None) -> Tensor:
        return self.save(ids)[:, :4]

    def u(self, ids: Tensor | None = None) -> Tensor:
        return self.save(ids)[:, 4:5]

    def time(self, ids: Tensor | None = None) -> Tensor:
        """Time since the reset [s], (n,)."""
        return self.save(ids)[:, 5]

    def reset(self, x: Tensor, u: Tensor, ids: Tensor | None = None) -> None:
        check(self.num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        self.load(torch.cat([x, u, torch.zeros_like(x[:, :1])], dim=1).to(self.dtype), ids)

    def step(self, u: Tensor, ids: Tensor | None = None) -> None:
        check(self.num_worlds, ids, u=(u, self.nu))
        row = self.save(ids)
        u = u.to(self.dtype)
        self.load(torch.cat([self.advance(row[:, :4], u), u, row[:, 5:] + self._dt], dim=1), ids)

    def advance(self, x: Tensor, u: Tensor) -> Tensor:
        """States (n, 4) one control step after x under inputs u (n, 1); differentiable."""
        force = self.params.gear * u[:, 0]
        h = self._dt / self._substeps
        for _ in range(self._substeps):
            k1 = self._rate(x, force)
            k2 = self._rate(torch.add(x, k1, alpha=h / 2), force)
            k3 = self._rate(torch.add(x, k2, alpha=h / 2), force)
            k4 = self._rate(torch.add(x, k3, alpha=h), force)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return x

    def save(self, ids: Tensor | None = None) -> Tensor:
        return self._rows.clone() if ids is None else self._rows[ids]

    def load(self, rows: Tensor, ids: Tensor | None = None) -> None:
        check(self.num_worlds, ids, rows=(rows, self._rows.shape[1]))
        self._rows[slice(None) if ids is None else ids] = rows

    def energy(self, ids: Tensor | None = None) -> Tensor:
        """Mechanical energy, zero at rest with the pole level [J], (n,)."""
        theta, _, theta_dot, p_dot = self.x(ids).unbind(1)
        c = self.params
        kinetic = (c.cart_mass + c.pole_mass) * p_dot**2 / 2 + c.pole_mass * (
            c.pole_length * p_dot * theta_dot * theta.cos() + (c.pole_length * theta_dot) ** 2 / 2
        )
        return kinetic + c.pole_mass * c.gravity * c.pole_length * theta.cos()

    def _rate(self, x: Tensor, force: Tensor) -> Tensor:
        theta, _, theta_dot, p_dot = x.unbind(1)
        c, sin, cos = self.params, theta.sin(), theta.cos()
        pull = c.pole_mass * sin  # the pole's mass along the rail, times what swings it
        swing = c.pole_length * theta_dot.square() - c.gravity * cos
        p_ddot = (force + pull * swing) / (c.cart_mass + pull * sin)
        theta_ddot = (c.gravity * sin - p_ddot * cos) / c.pole_length
        return torch.stack([theta_dot, p_dot, theta_ddot, p_ddot], dim=1)
