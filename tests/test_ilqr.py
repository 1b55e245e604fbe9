"""iLQR against the Riccati recursion, against a solver of another kind, and on the cartpole."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Cost
from hmc.ilqr import box_qp, ilqr
from hmc.sim.cartpole import CartpoleSim
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state

DT = 0.1
A = torch.tensor([[1.0, 0.1, 0.0], [0.2, 0.9, 0.1], [0.0, -0.3, 1.05]], dtype=torch.float64)
B = torch.tensor([[0.0, 0.1], [0.3, 0.0], [0.1, 0.5]], dtype=torch.float64)
Q, R, F = (
    torch.tensor(w, dtype=torch.float64).diag() for w in ([1.0, 2.0, 0.5], [0.3, 0.1], [5.0, 1.0, 3.0])
)
QUADRATIC = Cost(
    stage={
        "x": lambda x, u, u_prev, k: ((x @ Q) * x).sum(1),
        "u": lambda x, u, u_prev, k: ((u @ R) * u).sum(1),
    },
    terminal={"end": lambda x, k: ((x @ F) * x).sum(1)},
)
X = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
BOUND = torch.full((2,), 1e6, dtype=torch.float64)


def linear(x, u):
    return x @ A.T + u @ B.T


def lqr(horizon):
    """Optimal inputs and cost of the linear problem, by the Riccati recursion."""
    a, b, q, r, p = (m.numpy() for m in (A, B, DT * Q, DT * R, F))
    gains = []
    for _ in range(horizon):
        gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ gain)
        gains.append(gain)
    x, inputs = X.numpy(), []
    for gain in reversed(gains):
        inputs.append(-gain @ x)
        x = a @ x + b @ inputs[-1]
    return np.stack(inputs), float(X.numpy() @ p @ X.numpy())


def test_a_linear_quadratic_problem_is_solved_in_one_step():
    inputs, cost = lqr(25)
    found = ilqr(linear, QUADRATIC, DT, X, torch.randn(25, 2, dtype=torch.float64), -BOUND, BOUND)
    assert found.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(found.controls.numpy(), inputs, atol=1e-6)
    assert found.converged
    assert found.iterations <= 3
    once = ilqr(linear, QUADRATIC, DT, X, torch.zeros(25, 2).double(), -BOUND, BOUND, iterations=1)
    assert once.cost == pytest.approx(cost, rel=1e-6)


def test_bounds_against_projected_gradient_descent():
    """A convex problem has one minimum: plain projected gradient descent has to come to the same."""
    bound = torch.tensor([0.6, 0.4], dtype=torch.float64)
    found = ilqr(linear, QUADRATIC, DT, X, torch.zeros(15, 2).double(), -bound, bound)

    def cost(flat):
        x, total = X[None], torch.zeros(1, dtype=torch.float64)
        for control in flat.reshape(15, 1, 2):
            total = total + QUADRATIC.stage_terms(x, control, control, torch.zeros(1)).sum(1) * DT
            x = linear(x, control)
        return (total + QUADRATIC.terminal_terms(x, torch.zeros(1)).sum(1))[0]

    at = torch.zeros(30, dtype=torch.float64)
    h, g = torch.func.hessian(cost)(at).numpy(), torch.func.grad(cost)(at).numpy()
    u, limit, rate = at.numpy(), bound.repeat(15).numpy(), 1 / np.linalg.eigvalsh(h)[-1]
    for _ in range(20_000):
        u = np.clip(u - rate * (g + h @ u), -limit, limit)
    assert found.cost == pytest.approx(float(cost(torch.from_numpy(u))), rel=1e-9)
    np.testing.assert_allclose(found.controls.numpy().ravel(), u, atol=1e-5)
    assert (found.controls.abs() <= bound).all()
    assert (found.controls.abs() == bound).any()


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4))
@settings(max_examples=60)
def test_box_qp_meets_the_conditions_of_a_minimum(seed, n):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    h, g = root @ root.T + 0.1 * np.eye(n), 3 * rng.normal(size=n)
    lower, upper = -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
    d, free = box_qp(h, g, lower, upper)
    slope = g + h @ d
    assert ((lower <= d) & (d <= upper)).all()
    assert np.abs(slope[free]).max(initial=0) < 1e-6
    assert ((slope[~free] >= 0) | (d[~free] == upper[~free])).all()
    assert ((slope[~free] <= 0) | (d[~free] == lower[~free])).all()


def test_the_cartpole_swings_up_and_no_neighbour_is_better():
    cfg = CartpoleCfg(horizon=80)
    task, sim, x = cartpole(cfg), CartpoleSim(1, cfg.params, dt=cfg.dt), initial_state(cfg)
    one = torch.ones(1, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    begin = torch.empty(80, 1, dtype=torch.float64).uniform_(-1, 1, generator=generator)
    found = ilqr(sim.advance, task.cost, sim.dt, x, begin, -one, one)
    assert found.converged
    assert math.cos(float(found.states[-1, 0])) > 0.9
    worlds = CartpoleSim(200, cfg.params, dt=cfg.dt)

    def costs(controls):
        worlds.reset(x.expand(200, -1), torch.zeros(200, 1))
        total = torch.zeros(200, dtype=torch.float64)
        for i in range(80):
            u, k = controls[:, i], torch.full((200,), i)
            total += task.cost.stage_terms(worlds.x(), u, u, k).sum(1) * sim.dt
            worlds.step(u)
        return total + task.cost.terminal_terms(worlds.x(), torch.full((200,), 80)).sum(1)

    here = found.controls.expand(200, -1, -1)
    torch.testing.assert_close(costs(here)[0], torch.tensor(found.cost).double())
    near = here + 1e-2 * torch.randn(here.shape, dtype=torch.float64, generator=generator)
    assert (costs(near.clamp(-1, 1)) > found.cost - 1e-9).all()


def test_inputs_that_cost_infinity_are_refused():
    with pytest.raises(ValueError, match="the first inputs cost inf: begin from inputs with a finite cost"):
        ilqr(linear, QUADRATIC, DT, X * math.nan, torch.zeros(3, 2).double(), -BOUND, BOUND)


def test_derivatives_that_are_no_numbers_are_no_minimum():
    """A distance has none where it is 0, although its square does."""
    cost = Cost(
        {"far": lambda x, u, u_prev, k: x.square().sum(1).sqrt()}, {"end": lambda x, k: (x[:, 0] - 9) ** 2}
    )
    with pytest.raises(ValueError, match="derivatives that are not finite"):
        ilqr(linear, cost, DT, X * 0, torch.zeros(3, 2).double(), -BOUND, BOUND)
