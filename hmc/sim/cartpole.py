"""The cartpole in closed form, batched in torch: the smallest system worth planning for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.sim.check import check
from hmc.sim.ids import Ids, fresh, where

Floats = NDArray[np.float64]
BLOCK = 4096  # worlds that are stepped at a time: what is computed on the way stays in the cache


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

    cheap = True  # to ask a cost takes longer than a step

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
        h, c = dt / substeps, self.params
        scale = h * h / 4
        push, pull = scale * c.gear / (c.pole_mass * c.pole_length), scale * c.gravity / c.pole_length
        # as arrays without a dimension, which numpy takes as they are
        self._factors = (
            tuple(map(np.array, (push, pull, c.cart_mass / c.pole_mass, h / 2, c.pole_length * 2 / 3))),
            np.array([[1 / 3], [2 / (3 * h)], [c.pole_length * 2 / (3 * h)]]),
        )
        self._scratch = np.empty((17, min(num_worlds, BLOCK)))

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
        columns, force = self._columns.numpy(), u[:, 0].to(self.dtype).numpy()
        some = columns.take(ids.numpy(), 1) if isinstance(ids, Tensor) else columns[:, where(ids)]
        for first in range(0, len(force), BLOCK):
            part = slice(first, first + BLOCK)
            self._move(some[:4, part], force[part])
        some[4] = force
        some[5] += self._dt
        if isinstance(ids, Tensor):
            columns[:, ids.numpy()] = some

    def _move(self, x: Floats, u: Floats) -> None:
        """Move states (4, n) one control step on under inputs (n,): `advance`, in place and up to rounding.

        With w = h / 2 theta', a = h^2 / 4 theta'' and q = h^2 / (4 l) p'' the stages take the fewest
        operations; numpy is the quicker one to call, torch has the faster sine.
        """
        (push, pull, mass, half, far), weights, add, multiply = *self._factors, np.add, np.multiply
        theta, p, theta_dot, p_dot = x
        scratch = self._scratch[:, : len(u)]
        force, angle, sin, cos, some = scratch[:5]
        first, second, third, fourth = scratch[5:8], scratch[8:11], scratch[11:14], scratch[14:17]
        of_theta, of_angle, of_sin, of_cos = map(torch.from_numpy, (theta, angle, sin, cos))
        multiply(u, push, force)

        def rate(angle: Tensor, w: Floats, a: Floats, q: Floats) -> None:
            """a and q = (F + sin (w^2 - g cos)) / (M + sin^2), all of them scaled."""
            torch.sin(angle, out=of_sin)
            torch.cos(angle, out=of_cos)
            multiply(w, w, q)
            multiply(cos, pull, some)
            np.subtract(q, some, q)
            multiply(q, sin, q)
            add(q, force, q)
            multiply(sin, sin, some)
            add(some, mass, some)
            np.divide(q, some, q)
            multiply(q, cos, some)
            multiply(sin, pull, a)
            np.subtract(a, some, a)

        for _ in range(self._substeps):
            multiply(theta_dot, half, first[0])
            rate(of_theta, *first)
            add(first[0], theta, angle)
            add(first[0], first[1], second[0])
            rate(of_angle, *second)
            add(second[0], theta, angle)
            add(first[0], second[1], third[0])
            rate(of_angle, *third)
            add(third[0], third[0], angle)
            add(angle, theta, angle)
            add(third[1], third[1], fourth[0])
            add(fourth[0], first[0], fourth[0])
            rate(of_angle, *fourth)
            add(second, third, second)
            # p is in no rate: its sum is 6 p' + h (b1 + b2 + b3)
            add(first[2], second[2], some)
            multiply(some, far, some)
            add(p, some, p)
            multiply(p_dot, half, some)
            add(p, some, p)
            add(p, some, p)
            add(first, fourth, first)
            add(second, second, second)
            add(first, second, first)
            multiply(first, weights, first)
            add(theta, first[0], theta)
            add(theta_dot, first[1], theta_dot)
            add(p_dot, first[2], p_dot)

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
