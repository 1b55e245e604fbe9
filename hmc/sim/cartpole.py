"""The cartpole in closed form, batched in torch: the smallest system worth planning for."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.sim.check import check
from hmc.sim.ids import Ids, fresh, where


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
        self._cart_mass = torch.tensor(self.params.cart_mass, dtype=torch.float64)
        self._columns = torch.zeros(6, num_worlds, dtype=torch.float64)  # all of one quantity side by side

    @property
    def num_worlds(self) -> int:
        return self._columns.shape[1]

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
        return self._columns.device

    @property
    def dtype(self) -> torch.dtype:
        return self._columns.dtype

    def x(self, ids: Ids = None) -> Tensor:
        return fresh(self._columns[:4], ids, 1).T

    def u(self, ids: Ids = None) -> Tensor:
        return fresh(self._columns[4:5], ids, 1).T

    def time(self, ids: Ids = None) -> Tensor:
        """Time since the reset [s], (n,)."""
        return fresh(self._columns[5], ids)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        self.load(torch.cat([x, u, torch.zeros_like(x[:, :1])], dim=1).to(self.dtype), ids)

    def step(self, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, u=(u, self.nu))
        u = u.to(self.dtype)
        ids = where(ids)
        self._columns[:4, ids] = self.advance(self._columns[:4, ids].T, u).T
        self._columns[4, ids] = u[:, 0]
        self._columns[5, ids] += self._dt

    def advance(self, x: Tensor, u: Tensor) -> Tensor:
        """States (n, 4) one control step after x under inputs u (n, 1); differentiable."""
        theta, p, theta_dot, p_dot = x.unbind(1)
        force = self.params.gear * u[:, 0]
        h = self._dt / self._substeps
        for _ in range(self._substeps):
            # the four stages' velocities (v, w) and accelerations (a, b) of pole and cart
            v1, (a1, b1) = theta_dot, self._rate(theta, theta_dot, force)
            v2 = torch.add(v1, a1, alpha=h / 2)
            a2, b2 = self._rate(torch.add(theta, v1, alpha=h / 2), v2, force)
            v3 = torch.add(v1, a2, alpha=h / 2)
            a3, b3 = self._rate(torch.add(theta, v2, alpha=h / 2), v3, force)
            v4 = torch.add(v1, a3, alpha=h)
            a4, b4 = self._rate(torch.add(theta, v3, alpha=h), v4, force)
            b = b2 + b3
            # p is in no rate: its sum (w1 + 2 w2 + 2 w3 + w4) / 6 with w2 = p' + h b1 / 2 and so on
            p = p + h * torch.add(p_dot, b1 + b, alpha=h / 6)
            theta = torch.add(theta, torch.add(v1 + v4, v2 + v3, alpha=2), alpha=h / 6)
            theta_dot = torch.add(theta_dot, torch.add(a1 + a4, a2 + a3, alpha=2), alpha=h / 6)
            p_dot = torch.add(p_dot, torch.add(b1 + b4, b, alpha=2), alpha=h / 6)
        return torch.stack([theta, p, theta_dot, p_dot]).T

    def save(self, ids: Ids = None) -> Tensor:
        return fresh(self._columns, ids, 1).T

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, rows=(rows, len(self._columns)))
        self._columns[:, where(ids)] = rows.T

    def energy(self, ids: Ids = None) -> Tensor:
        """Mechanical energy, zero at rest with the pole level [J], (n,)."""
        theta, _, theta_dot, p_dot = self.x(ids).unbind(1)
        c = self.params
        kinetic = (c.cart_mass + c.pole_mass) * p_dot**2 / 2 + c.pole_mass * (
            c.pole_length * p_dot * theta_dot * theta.cos() + (c.pole_length * theta_dot) ** 2 / 2
        )
        return kinetic + c.pole_mass * c.gravity * c.pole_length * theta.cos()

    def _rate(self, theta: Tensor, theta_dot: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
        """Accelerations of pole and cart, (n,) each, in as few operations as torch has for them."""
        c, sin, cos = self.params, theta.sin(), theta.cos()
        swing = torch.addcmul(cos * -c.gravity, theta_dot, theta_dot, value=c.pole_length)
        mass = torch.addcmul(self._cart_mass, sin, sin, value=c.pole_mass)
        p_ddot = torch.addcmul(force, sin, swing, value=c.pole_mass) / mass
        return torch.addcmul(sin * (c.gravity / c.pole_length), p_ddot, cos, value=-1 / c.pole_length), p_ddot
