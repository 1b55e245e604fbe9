"""The cartpole in closed form, batched in torch: the smallest system worth planning for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.sim.check import check
from hmc.sim.ids import Ids

Floats = NDArray[np.float64]
T = TypeVar("T", float, Tensor)
BLOCK = 8192  # worlds that are stepped at a time, at most: what is computed on the way stays in the cache
LINE = 8  # numbers in a line of it: arrays that begin with one take a quarter less time


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

    float64 on the CPU. A snapshot row is (x, u): nothing else decides how a world goes on.
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
        self._all = _aligned(5, num_worlds)  # all of one quantity side by side
        self._columns = self._all[:, :num_worlds]
        h, c = dt / substeps, self.params
        scale = h * h / 4
        push, pull = scale * c.gear / (c.pole_mass * c.pole_length), scale * c.gravity / c.pole_length
        self._scale = push, pull, c.cart_mass / c.pole_mass, h / 2, c.pole_length * 2 / 3
        self._weights = 1 / 3, 2 / (3 * h), c.pole_length * 2 / (3 * h)
        # as arrays, which numpy takes as they are
        self._factors = tuple(map(np.array, self._scale)), np.array(self._weights)[:, None]
        self._one = np.empty(3)  # an angle, its sine and its cosine
        self._of_one = torch.from_numpy(self._one).split(1)
        self._scratch = _aligned(14, min(num_worlds, BLOCK))

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
        return torch.device("cpu")

    @property
    def dtype(self) -> torch.dtype:
        return torch.float64

    def x(self, ids: Ids = None) -> Tensor:
        return self._copy(slice(0, 4), ids)

    def u(self, ids: Ids = None) -> Tensor:
        return self._copy(slice(4, 5), ids)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        self.load(torch.cat([x, u], dim=1).to(self.dtype), ids)

    def step(self, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, u=(u, self.nu))
        columns, force, at = self._columns, u.to(self.dtype).numpy()[:, 0], self._where(ids)
        if len(force) == 1:  # a plan steps hundreds of worlds singly, for which arrays are slow
            one = at.indices(self.num_worlds)[0] if isinstance(at, slice) else int(at[0])
            columns[:, one] = *self._after(columns[:4, one].tolist(), force.item(), self._sin_cos), force[0]
            return
        some = columns[:, at] if isinstance(at, slice) else self._all.take(at, 1)
        parts = -(-len(force) // BLOCK)  # of one size: short ones take as many calls
        size = -(-len(force) // parts // LINE) * LINE if parts else 1
        with np.errstate(over="ignore", invalid="ignore"):  # who rolls out counts what diverges
            for first in range(0, len(force), size):
                part = slice(first, first + size)
                self._move(some[:4, part], force[part])
        some[4] = force
        if not isinstance(at, slice):
            columns[:, at] = some

    def _move(self, x: Floats, u: Floats) -> None:
        """Move states (4, n) one control step on under inputs (n,): `_after` in place, to the bit.

        Numpy is the quicker one to call, torch has the faster sine.
        """
        (push, pull, mass, half, far), weights, add, multiply = *self._factors, np.add, np.multiply
        theta, p, theta_dot, p_dot = x
        scratch = self._scratch[:, : len(u)]
        force, angle, sin, cos, some = scratch[:5]
        first, second, third = scratch[5:8], scratch[8:11], scratch[11:14]
        (w1, a1, q1), (w2, a2, q2), (w3, a3, q3) = first, second, third
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
            multiply(q, cos, cos)
            multiply(sin, pull, sin)
            np.subtract(sin, cos, a)

        for _ in range(self._substeps):
            multiply(theta_dot, half, w1)
            rate(of_theta, w1, a1, q1)
            add(w1, theta, angle)
            add(w1, a1, w2)
            rate(of_angle, w2, a2, q2)
            add(w2, theta, angle)
            add(w1, a2, w3)
            rate(of_angle, w3, a3, q3)
            add(w3, w3, angle)
            add(angle, theta, angle)
            add(second, third, second)
            # the fourth stage takes the place of the third
            add(a3, a3, w3)
            add(w3, w1, w3)
            rate(of_angle, w3, a3, q3)
            # p is in no rate: its sum is 6 p' + h (b1 + b2 + b3)
            add(q1, q2, some)
            multiply(some, far, some)
            add(p, some, p)
            multiply(p_dot, half, some)
            add(p, some, p)
            add(p, some, p)
            add(first, third, first)
            add(second, second, second)
            add(first, second, first)
            multiply(first, weights, first)
            add(theta, w1, theta)
            add(theta_dot, a1, theta_dot)
            add(p_dot, q1, p_dot)

    def advance(self, x: Tensor, u: Tensor) -> Tensor:
        """States (n, 4) one control step after x under inputs u (n, 1): what `step` makes; differentiable."""
        after = self._after(x.unbind(1), u[:, 0], lambda angle: (angle.sin(), angle.cos()))
        return torch.stack(after).T

    def _after(self, x: Sequence[T], u: T, sin_cos: Callable[[T], Sequence[T]]) -> list[T]:
        """The state one control step after x = (theta, p, theta', p') under u: numbers, or one a world.

        With w = h / 2 theta', a = h^2 / 4 theta'' and q = h^2 / (4 l) p'' the stages take the fewest
        operations.
        """
        (push, pull, mass, half, far), weights = self._scale, self._weights
        theta, p, theta_dot, p_dot = x
        force = u * push

        def rate(angle: T, w: T) -> tuple[T, T]:
            """a and q = (F + sin (w^2 - g cos)) / (M + sin^2), all of them scaled."""
            sin, cos = sin_cos(angle)
            q = ((w * w - cos * pull) * sin + force) / (sin * sin + mass)
            return sin * pull - q * cos, q

        for _ in range(self._substeps):
            w1 = theta_dot * half
            a1, q1 = rate(theta, w1)
            w2 = w1 + a1
            a2, q2 = rate(w1 + theta, w2)
            w3 = w1 + a2
            a3, q3 = rate(w2 + theta, w3)
            w4 = a3 + a3 + w1
            a4, q4 = rate(w3 + w3 + theta, w4)
            w, a, q = w2 + w3, a2 + a3, q2 + q3
            # p is in no rate: its sum is 6 p' + h (b1 + b2 + b3)
            p = (q1 + q) * far + p + p_dot * half + p_dot * half
            theta = theta + ((w1 + w4) + (w + w)) * weights[0]
            theta_dot = theta_dot + ((a1 + a4) + (a + a)) * weights[1]
            p_dot = p_dot + ((q1 + q4) + (q + q)) * weights[2]
        return [theta, p, theta_dot, p_dot]

    def _sin_cos(self, angle: float) -> list[float]:
        """Sine and cosine of one angle, to the bit as of many."""
        one, sin, cos = self._of_one
        self._one[0] = angle
        torch.sin(one, out=sin)
        torch.cos(one, out=cos)
        return self._one.tolist()[1:]

    def save(self, ids: Ids = None) -> Tensor:
        return self._copy(slice(0, 5), ids)

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, rows=(rows, len(self._columns)))
        self._columns[:, self._where(ids)] = rows.numpy().T

    def _copy(self, what: slice, ids: Ids) -> Tensor:
        """Some quantities of worlds `ids`, (n, number of quantities)."""
        at = self._where(ids)
        if isinstance(at, slice):
            return torch.from_numpy(self._columns[what, at].copy()).T
        return torch.from_numpy(self._all[what].take(at, 1)).T  # takes little time where rows are whole

    def _where(self, ids: Ids) -> slice | NDArray[np.int64]:
        """Which columns are of worlds `ids`."""
        if isinstance(ids, Tensor):
            return ids.numpy()
        return slice(None) if ids is None else ids

    def energy(self, ids: Ids = None) -> Tensor:
        """Mechanical energy, zero at rest with the pole level [J], (n,)."""
        theta, _, theta_dot, p_dot = self.x(ids).unbind(1)
        c = self.params
        kinetic = (c.cart_mass + c.pole_mass) * p_dot**2 / 2 + c.pole_mass * (
            c.pole_length * p_dot * theta_dot * theta.cos() + (c.pole_length * theta_dot) ** 2 / 2
        )
        return kinetic + c.pole_mass * c.gravity * c.pole_length * theta.cos()


def _aligned(rows: int, width: int) -> Floats:
    """Zeros, (rows, width or a little more): each row begins with a line of the cache."""
    return torch.zeros(rows, -(-width // LINE) * LINE, dtype=torch.float64).numpy()
