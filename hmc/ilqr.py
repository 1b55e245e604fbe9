"""Iterative LQR with input bounds: the local optimum that sampled plans are measured against."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.func import hessian, jacfwd, vmap

from hmc.cost import Cost

Array = NDArray[np.float64]
StepFn = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Optimum:
    """What iLQR came to.

    Attributes:
        controls: inputs, (T, nu).
        states: states that they lead through, (T + 1, nx).
        cost: J of them.
        converged: whether no further step lowered the cost by more than the tolerance.
        iterations: forward passes that did.
    """

    controls: Tensor
    states: Tensor
    cost: float
    converged: bool
    iterations: int


def ilqr(
    step: StepFn,
    cost: Cost,
    dt: float,
    x: Tensor,
    controls: Tensor,
    lower: Tensor,
    upper: Tensor,
    *,
    k: int = 0,
    iterations: int = 500,
    tolerance: float = 1e-9,
) -> Optimum:
    r"""A local minimum of J = sum_k l(x_k, u_k, k) dt + c_f(x_T, T) over lower <= u_k <= upper.

    Dynamics are expanded to first order and costs to second around the last trajectory (Li and Todorov
    2004); each step's input change solves a quadratic programme with the bounds inside, and inputs at a
    bound get no feedback (Tassa et al. 2014). A regularisation rises where that programme is not convex or
    no step length lowers the cost.

    Args:
        step: x' = step(x, u) for states (n, nx) and inputs (n, nu), twice differentiable by torch.
        cost: its terms likewise, and not dependent on u_prev.
        dt: duration of a control step [s].
        x: state to start from, (nx,).
        controls: inputs to start from, (T, nu).
        lower, upper: bounds, (nu,).
        k: control step since the start of the task.
        iterations: at most this many.
        tolerance: relative decrease of the cost below which it has converged.

    Raises:
        ValueError: where the first inputs lead to a cost that is not finite, or derivatives are not.
    """
    problem = _Problem(step, cost, dt, k, lower.double(), upper.double())
    low, high = lower.double().numpy(), upper.double().numpy()
    best = problem.roll(x.double(), controls.double())
    if not math.isfinite(best.cost):
        raise ValueError(f"ilqr: the first inputs cost {best.cost}: begin from inputs with a finite cost")
    damping, done, converged = 1e-6, 0, False
    while done < iterations and not converged:
        models = problem.expand(best)
        while (gains := _backward(models, best.controls.numpy(), low, high, damping)) is None:
            damping = max(1e-6, 10 * damping)
        tried = problem.search(best, *gains)
        if tried.cost < best.cost:
            converged = best.cost - tried.cost <= tolerance * abs(best.cost)
            best, done, damping = tried, done + 1, damping / 5
        else:
            converged = damping > 1e8 or float(np.abs(gains[0]).max()) <= 1e-12
            damping = max(1e-6, 10 * damping)
    return Optimum(best.controls, best.states, best.cost, converged, done)


class _Trajectory(NamedTuple):
    """Inputs (T, nu), the states that they lead through (T + 1, nx), and J."""

    controls: Tensor
    states: Tensor
    cost: float


@dataclass(frozen=True)
class _Models:
    """Expansions along a trajectory: dynamics A, B, stage cost (gradients, Hessians), terminal cost."""

    a: Array
    b: Array
    lx: Array
    lu: Array
    lxx: Array
    lux: Array
    luu: Array
    vx: Array
    vxx: Array


class _Problem:
    """Dynamics and cost: rollouts of many trials at once, derivatives of all steps at once."""

    LENGTHS = 0.6 ** torch.arange(14, dtype=torch.float64)

    def __init__(self, step: StepFn, cost: Cost, dt: float, k: int, lower: Tensor, upper: Tensor):
        # what works on arrays cannot be differentiated
        self.step, self.cost, self.dt, self.k = step, replace(cost, on_cpu=None), dt, k
        self.lower, self.upper = lower, upper

    def roll(self, x: Tensor, controls: Tensor) -> _Trajectory:
        """From x (nx,) under inputs (T, nu)."""
        return self._best(x, len(controls), lambda i, _: controls[i : i + 1])

    def search(self, last: _Trajectory, change: Array, feedback: Array) -> _Trajectory:
        """The best of all step lengths along a change of the last trajectory's inputs."""
        moves = self.LENGTHS[:, None] * torch.from_numpy(change)[:, None]
        gains = torch.from_numpy(feedback)

        def act(i: int, x: Tensor) -> Tensor:
            return last.controls[i] + moves[i] + (x - last.states[i]) @ gains[i].T

        return self._best(last.states[0], len(last.controls), act)

    def _best(self, x: Tensor, horizon: int, act: Callable[[int, Tensor], Tensor]) -> _Trajectory:
        xs, us, total = x[None], [], torch.zeros(1, dtype=torch.float64)
        states = [xs]
        for i in range(horizon):
            u = act(i, xs).clamp(self.lower, self.upper)
            xs = xs.expand(len(u), -1)
            k = torch.full((len(u),), self.k + i)
            total = total + self.cost.stage_terms(xs, u, u, k).sum(1) * self.dt
            xs = self.step(xs, u)
            us.append(u)
            states.append(xs)
        total = total + self.cost.terminal_terms(xs, torch.full((len(xs),), self.k + horizon)).sum(1)
        total = torch.where(total.isfinite(), total, math.inf)
        at = int(total.argmin())
        path = torch.stack([x, *(row[at] for row in states[1:])])
        return _Trajectory(torch.stack([u[at] for u in us]), path, float(total[at]))

    def expand(self, around: _Trajectory) -> _Models:
        """Derivatives of dynamics and cost at each step."""
        u, x, _ = around

        def stage(x: Tensor, u: Tensor, k: Tensor) -> Tensor:
            return self.cost.stage_terms(x[None], u[None], u[None], k[None]).sum() * self.dt

        def final(x: Tensor) -> Tensor:
            return self.cost.terminal_terms(x[None], torch.tensor([self.k + len(u)])).sum()

        def dynamics(x: Tensor, u: Tensor) -> Tensor:
            return self.step(x[None], u[None])[0]

        at = x[:-1], u, self.k + torch.arange(len(u))
        a, b = vmap(jacfwd(dynamics, (0, 1)))(x[:-1], u)
        lx, lu = vmap(jacfwd(stage, (0, 1)))(*at)
        (lxx, _), (lux, luu) = vmap(hessian(stage, (0, 1)))(*at)
        parts = (a, b, lx, lu, lxx, lux, luu, jacfwd(final)(x[-1]), hessian(final)(x[-1]))
        if not all(bool(part.isfinite().all()) for part in parts):  # which would pass for a minimum
            raise ValueError(
                "ilqr: dynamics or cost have derivatives that are not finite on the way: smooth them there"
            )
        return _Models(*(part.detach().numpy() for part in parts))


def _backward(m: _Models, u: Array, lower: Array, upper: Array, damping: float) -> tuple[Array, Array] | None:
    """Input changes (T, nu) and feedback gains (T, nu, nx); None where a step's programme is not convex."""
    vx, vxx = m.vx, m.vxx
    change, feedback = np.zeros_like(u), np.zeros((*u.shape, len(vx)))
    for i in reversed(range(len(u))):
        a, b = m.a[i], m.b[i]
        qx, qu = m.lx[i] + a.T @ vx, m.lu[i] + b.T @ vx
        qxx, qux = m.lxx[i] + a.T @ vxx @ a, m.lux[i] + b.T @ vxx @ a
        quu = m.luu[i] + b.T @ vxx @ b
        damped = quu + damping * np.eye(len(qu))
        if np.linalg.eigvalsh(damped)[0] <= 0:
            return None
        change[i], free = box_qp(damped, qu, lower - u[i], upper - u[i])
        feedback[i][free] = -np.linalg.solve(damped[np.ix_(free, free)], qux[free])
        d, g = change[i], feedback[i]
        vx = qx + g.T @ (quu @ d + qu) + qux.T @ d
        vxx = qxx + g.T @ quu @ g + g.T @ qux + qux.T @ g
        vxx = (vxx + vxx.T) / 2
    return change, feedback


def box_qp(h: Array, g: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The d in lower <= d <= upper that minimises d h d / 2 + g d, h positive definite, and which of its
    entries are not held by a bound. Projected Newton (Bertsekas 1982), exact in finitely many steps."""
    d = np.clip(np.zeros_like(g), lower, upper)
    free = np.ones(len(g), dtype=bool)
    for _ in range(100):
        slope = g + h @ d
        free = ~(((d <= lower) & (slope > 0)) | ((d >= upper) & (slope < 0)))
        if not free.any() or np.abs(slope[free]).max() < 1e-12 * (1 + np.abs(g).max()):
            break
        newton = np.zeros_like(d)
        newton[free] = -np.linalg.solve(h[np.ix_(free, free)], slope[free])
        value, length = d @ h @ d / 2 + g @ d, 1.0
        while length > 1e-12:
            tried = np.clip(d + length * newton, lower, upper)
            if tried @ h @ tried / 2 + g @ tried <= value + 0.1 * slope @ (tried - d):
                break
            length *= 0.5
        if length <= 1e-12 or np.array_equal(tried, d):
            break
        d = tried
    return d, free
