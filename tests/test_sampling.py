"""Sampling MPC: against loops written out by hand, and what batches, memory and NaN may not change."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from hmc import Budget, ModeSet, Task, plan
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import JumpCfg, jump_mode, make_sim
from hmc.sampling import METHODS, SamplingCfg, SamplingMpc
from tests.linear import COST, Linear


def mode(
    make: Callable[[int], Any] = Linear, seed: int = 3, guess: Tensor | None = None, **cfg: Any
) -> SamplingMpc:
    settings = {"horizon": 6, "samples": 8, "knots": 3, "noise": 0.5, "replan_every": 2, "worlds": 16, **cfg}
    bound = torch.full((2,), 1.5, dtype=torch.float64)
    return SamplingMpc("mppi", SamplingCfg(**settings), make, COST, -bound, bound, guess=guess, seed=seed)


def situations(n: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x, u = torch.randn(2, n, 2, generator=generator, dtype=torch.float64).unbind()
    return x, u, torch.randint(0, 50, (n,), generator=generator)


def interpolated(points: Tensor, at: float) -> Tensor:
    """Linear between points (K, nu) at a position in their units."""
    low = min(int(at), len(points) - 2)
    return points[low] + (at - low) * (points[low + 1] - points[low])


def cost_by_hand(cfg: SamplingCfg, x: Tensor, u: Tensor, plans: Tensor, k: int) -> list[float]:
    """J of plans (S, K, nu), sample by sample and step by step."""
    costs = []
    for knots in plans:
        sim, last, total = Linear(1), u[None], 0.0
        sim.reset(x[None], last)
        for i in range(cfg.horizon):
            control = interpolated(knots, i * (cfg.knots - 1) / (cfg.horizon - 1))
            control = control.clamp(-1.5, 1.5)[None]
            at = torch.tensor([k + i])
            total += float(sum(f(sim.x(), control, last, at) for f in COST.stage.values())) * sim.dt
            sim.step(control)
            last = control
        costs.append(total + float(COST.terminal["end"](sim.x(), torch.tensor([k + cfg.horizon]))))
    return costs


def by_hand(mppi: SamplingMpc, x: Tensor, u: Tensor, theta: Tensor, k: int) -> Tensor:
    """One MPPI re-plan from knots theta (K, nu)."""
    cfg = mppi.cfg
    eps = cfg.noise * mppi._noise(torch.tensor([k]), 0)[0]
    costs = cost_by_hand(cfg, x, u, theta + eps, k)
    best = min(costs)
    spread = math.sqrt(sum((cost - best) ** 2 for cost in costs) / len(costs))
    weights = [math.exp(-(cost - best) / (cfg.temperature * spread)) for cost in costs]
    change = sum(w / sum(weights) * e for w, e in zip(weights, eps, strict=True))
    return theta + change


def test_replan_against_the_loop():
    mppi = mode(temperature=0.3)
    x, u, k = situations(5)
    memory = mppi.reset(x, u, k)
    action, after = mppi.act(x, u, memory, k)
    for row in range(5):
        start = u[row].expand(3, 2)
        theta = by_hand(mppi, x[row], u[row], start, int(k[row]))
        torch.testing.assert_close(after[row, :-1].reshape(3, 2), theta)
        torch.testing.assert_close(action[row], theta[0].clamp(-1.5, 1.5))
    assert after[:, -1].tolist() == [1.0] * 5


@pytest.mark.parametrize("iterations", [1, 3])
def test_predictive_sampling_takes_the_best_sample(iterations):
    ps = mode(method="ps", iterations=iterations)
    x, u, k = situations(4)
    after = ps.act(x, u, ps.reset(x, u, k), k)[1]
    for row in range(4):
        theta, costs = u[row].expand(3, 2), []
        for i in range(iterations):
            plans = theta + ps.cfg.noise * ps._noise(k[row : row + 1], i)[0]
            costs = cost_by_hand(ps.cfg, x[row], u[row], plans, int(k[row]))
            theta = plans[costs.index(min(costs))]
        torch.testing.assert_close(after[row, :-1].reshape(3, 2), theta)


def test_cem_fits_mean_and_spread_to_the_elites():
    cem = mode(method="cem", iterations=2, elites=3)
    x, u, k = situations(4)
    after = cem.act(x, u, cem.reset(x, u, k), k)[1]
    for row in range(4):
        theta, std = u[row].expand(3, 2), torch.full((3, 2), cem.cfg.noise, dtype=torch.float64)
        for i in range(2):
            plans = theta + std * cem._noise(k[row : row + 1], i)[0]
            costs = torch.tensor(cost_by_hand(cem.cfg, x[row], u[row], plans, int(k[row])))
            elites = plans[costs.argsort()[:3]]
            theta, std = elites.mean(0), elites.std(0, correction=0).clamp(min=0.05 * cem.cfg.noise)
        torch.testing.assert_close(after[row, :-1].reshape(3, 2), theta)


@pytest.mark.parametrize("method", METHODS)
def test_a_planner_on_its_own_keeps_to_its_budget_and_gets_better_with_it(method):
    x, u, _ = situations(1)
    costs = []
    for budget in (1, 48 * 5, 48 * 60):
        alone = mode(method=method, elites=3)
        solution = alone.solve(x[0], u[0], budget, k=3)
        assert solution.control_steps == alone.control_steps == max(48, budget)
        assert solution.controls.shape == (6, 2)
        sim, last, total = Linear(1), u[:1], 0.0
        sim.reset(x, last)
        for i, control in enumerate(solution.controls[:, None]):
            at = torch.tensor([3 + i])
            total += float(sum(f(sim.x(), control, last, at) for f in COST.stage.values())) * sim.dt
            sim.step(control)
            last = control
        total += float(COST.terminal["end"](sim.x(), torch.tensor([9])))
        assert solution.cost == pytest.approx(total, rel=1e-12)
        costs.append(solution.cost)
    assert costs[0] >= costs[1] >= costs[2]
    assert costs[2] < costs[0]


@pytest.mark.parametrize("method", METHODS)
def test_a_guess_is_where_a_planner_begins(method):
    """A solution given back is the first sample: one update more is no worse, and better than a first one."""
    x, u, _ = situations(1)
    before = mode(method=method, elites=3, noise=0.2).solve(x[0], u[0], 48 * 60)
    again = mode(method=method, elites=3, noise=0.2, seed=8)
    warm, cold = (again.solve(x[0], u[0], 1, guess=guess) for guess in (before.controls, None))
    assert warm.cost <= before.cost * (1 + 1e-12) < cold.cost
    assert warm.control_steps == cold.control_steps == 48
    still = mode(method=method, elites=3, noise=0.0)
    line = torch.linspace(-1, 1, 6, dtype=torch.float64)[:, None] * torch.tensor([1.0, -0.5]).double()
    torch.testing.assert_close(still.solve(x[0], u[0], 1, guess=line).controls, line)
    bent = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0], dtype=torch.float64)[:, None].expand(6, 2)
    knots = torch.linalg.pinv(still.spline) @ bent
    torch.testing.assert_close(still.solve(x[0], u[0], 1, guess=bent).controls, still.spline @ knots)
    for wrong in (line[:5], line * math.nan):
        with pytest.raises(ValueError, match=r"guess: expected \(6, 2\) finite inputs, got shape \("):
            still.solve(x[0], u[0], 1, guess=wrong)


def test_the_plan_runs_open_loop_between_replans():
    mppi = mode(replan_every=3)
    x, u, k = situations(1)
    memory = mppi.reset(x, u, k)
    _, memory = mppi.act(x, u, memory, k)
    theta = memory[0, :-1].reshape(3, 2)
    for step in (1, 2):
        elsewhere = x + 10 * step
        action, memory = mppi.act(elsewhere, u, memory, k + step)
        expected = interpolated(theta, step * 2 / 5).clamp(-1.5, 1.5)
        torch.testing.assert_close(action[0], expected)
        assert torch.equal(memory[0, :-1].reshape(3, 2), theta)
        assert memory[0, -1] == step + 1
    _, memory = mppi.act(x, u, memory, k + 3)
    assert not torch.equal(memory[0, :-1].reshape(3, 2), theta)


def test_a_replan_starts_from_the_plan_shifted():
    mppi = mode(noise=0.0, knots=6, replan_every=2)
    x, u, k = situations(1)
    theta = torch.arange(12, dtype=torch.float64).reshape(6, 2) / 10
    memory = torch.cat([theta.reshape(1, -1), torch.tensor([[2.0]])], 1)
    action, after = mppi.act(x, u, memory, k)
    expected = theta[[2, 3, 4, 5, 5, 5]]
    torch.testing.assert_close(after[0, :-1].reshape(6, 2), expected)
    torch.testing.assert_close(action[0], expected[0])


def test_the_guess_is_followed_step_by_step():
    guess = torch.sin(torch.arange(20, dtype=torch.float64)[:, None] * torch.tensor([0.3, 0.5]).double())
    mppi = mode(noise=0.0, knots=6, replan_every=2, guess=guess)
    x, u, k = situations(1)
    memory = mppi.reset(x, u, k)
    for step in range(25):
        action, memory = mppi.act(x, u, memory, k + step)
        torch.testing.assert_close(action[0], guess[min(step, 19)])


def test_without_a_guess_it_begins_by_holding_the_input():
    mppi = mode(noise=0.0)
    x, u, k = situations(4)
    action, _ = mppi.act(x, u, mppi.reset(x, u, k), k)
    torch.testing.assert_close(action, u.clamp(-1.5, 1.5))


def test_actions_stay_inside_their_bounds():
    mppi = mode(noise=20.0)
    x, u, k = situations(20)
    action, _ = mppi.act(x, u, mppi.reset(x, u, k), k)
    assert (action.abs() <= 1.5).all()
    assert (action.abs() == 1.5).any()


def test_cold_takes_the_best_sample_and_hot_the_mean():
    x, u, k = situations(3)
    start = u[:, None].expand(3, 3, 2)
    cold, hot = mode(temperature=0.0), mode(temperature=1e9)
    eps = cold.cfg.noise * cold._noise(k, 0)
    costs = cold._rollout(x, u, start[:, None] + eps, k)
    best = eps[torch.arange(3), costs.argmin(1)]
    torch.testing.assert_close(
        cold.act(x, u, cold.reset(x, u, k), k)[1][:, :-1].reshape(3, 3, 2), start + best
    )
    mean = start + eps.mean(1)
    torch.testing.assert_close(hot.act(x, u, hot.reset(x, u, k), k)[1][:, :-1].reshape(3, 3, 2), mean)


def test_more_iterations_go_on_from_the_last():
    once, twice = mode(iterations=1), mode(iterations=2)
    x, u, k = situations(1)
    first = once.act(x, u, once.reset(x, u, k), k)[1][0, :-1].reshape(3, 2)
    eps = [once._noise(k, i) for i in (0, 1)]
    assert not torch.equal(eps[0], eps[1])
    second = twice.act(x, u, twice.reset(x, u, k), k)[1][0, :-1].reshape(3, 2)
    assert not torch.equal(first, second)
    assert twice.control_steps == 2 * once.control_steps


def test_noise_depends_on_seed_and_step_alone():
    k = torch.tensor([7, 3, 7])
    eps = mode()._noise(k, 0)
    assert eps.shape == (3, 8, 3, 2)
    assert torch.equal(eps[0], eps[2])
    assert not torch.equal(eps[0], eps[1])
    assert not eps[:, 0].any(), "the first sample is the plan itself"
    assert torch.equal(eps, mode()._noise(k, 0))
    assert not torch.equal(eps, mode(seed=4)._noise(k, 0))


def test_the_basis_shapes_the_noise():
    bound = torch.ones(2, dtype=torch.float64)
    together = torch.tensor([[1.0, -2.0]], dtype=torch.float64)
    mppi = SamplingMpc(
        "m", SamplingCfg(horizon=4, knots=2, samples=50), Linear, COST, -bound, bound, basis=together
    )
    z = mppi._noise(torch.tensor([0]), 0)
    assert z.shape == (1, 50, 2, 1)
    torch.testing.assert_close(mppi._along_basis(z), torch.cat([z, -2 * z], -1))
    assert z[0, 1:].std() == pytest.approx(1.0, rel=0.3)


def test_memo_and_budget():
    """A situation is rolled out once; what is rolled out is counted; `forget` begins anew."""
    mppi = mode()
    x, u, k = situations(3)
    memory = mppi.reset(x, u, k)
    first = mppi.act(x, u, memory, k)
    assert mppi.control_steps == 3 * 8 * 6
    again = mppi.act(x[[2, 0]], u[[2, 0]], memory[[2, 0]], k[[2, 0]])
    assert mppi.control_steps == 3 * 8 * 6, "known already"
    assert torch.equal(again[0], first[0][[2, 0]])
    mppi.act(x[:1], u[:1], memory[:1], k[:1] + 1)
    assert mppi.control_steps == 4 * 8 * 6, "another step, other noise"
    mppi.forget()
    assert torch.equal(mppi.act(x, u, memory, k)[0], first[0])
    assert mppi.control_steps == 7 * 8 * 6


def test_equal_situations_in_one_batch_are_rolled_out_once():
    mppi = mode()
    x, u, k = (values[:1].expand(5, *values.shape[1:]) for values in situations(1))
    action, _ = mppi.act(x, u, mppi.reset(x, u, k), k)
    assert mppi.control_steps == 8 * 6
    assert torch.equal(action, action[:1].expand(5, 2))


def test_the_memo_does_not_grow_for_ever(monkeypatch):
    monkeypatch.setattr(SamplingMpc, "MEMO", 4)
    mppi = mode()
    x, u, k = situations(10)
    action, _ = mppi.act(x, u, mppi.reset(x, u, k), k)
    assert len(mppi._known) == 4
    assert torch.equal(mppi.act(x, u, mppi.reset(x, u, k), k)[0], action)


def test_a_plan_counts_what_its_modes_roll_out():
    mppi = mode()
    task = Task("linear", ModeSet([mppi]), COST, 4, Linear)
    result = plan(task, [1.0, 0.0], samples=4, sim=Linear(4))
    assert result.control_steps == 4 + 2 * 8 * 6, "one schedule of 4 steps, re-planned at steps 0 and 2"
    small = plan(task, [1.0, 0.0], samples=4, sim=Linear(4), budget=Budget(control_steps=10))
    assert small.control_steps <= 4 + 2 * 8 * 6
    assert plan(task, [1.0, 0.0], samples=4, sim=Linear(4)).control_steps == result.control_steps


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("worlds", [1, 7, 16, 200])
def test_batches_do_not_change_actions(worlds, method):
    """Alone, in any order, in a simulator of any size: the same to the bit."""
    x, u, k = situations(13)
    settings = {"method": method, "iterations": 2, "elites": 3}
    whole = mode(**settings)
    action, memory = whole.act(x, u, whole.reset(x, u, k), k)
    other = mode(worlds=worlds, **settings)
    order = torch.randperm(13)
    shuffled, _ = other.act(x[order], u[order], other.reset(x, u, k)[order], k[order])
    assert torch.equal(shuffled, action[order])
    for row in range(13):
        single = mode(worlds=worlds, **settings)
        one = slice(row, row + 1)
        alone, after = single.act(x[one], u[one], single.reset(x[one], u[one], k[one]), k[one])
        assert torch.equal(alone, action[one])
        assert torch.equal(after, memory[one])


def test_batches_do_not_change_the_jump():
    """The same for the Go2's own jump, with its twelve inputs, its basis and the C engine."""
    n = 9
    x = FOOTSTAND.state().repeat(n, 1)
    x[:, 7:] += 0.05 * torch.randn(n, 30, dtype=torch.float64)
    u, k = x[:, 7:19].clone(), torch.arange(n) % 3
    settings = SamplingCfg(horizon=6, samples=5, knots=3, noise=0.1, replan_every=2, worlds=64)

    def jump(worlds: int):
        cfg = JumpCfg(sampling=SamplingCfg(**{**vars(settings), "worlds": worlds}))
        return jump_mode(cfg, lambda count: make_sim(count, threads=1), seed=1)

    whole, parts = jump(64), jump(4)
    memory = whole.reset(x, u, k)
    for step in range(4):
        action, after = whole.act(x, u, memory, k + step)
        assert torch.equal(parts.act(x, u, memory, k + step)[0], action)
        single = jump(64)
        for row in range(0, n, 4):
            one = slice(row, row + 1)
            assert torch.equal(single.act(x[one], u[one], memory[one], k[one] + step)[0], action[one])
        memory = after


@pytest.mark.parametrize("lost", [math.nan, math.inf])
@pytest.mark.parametrize("method", METHODS)
def test_where_every_sample_diverges_the_plan_stays(method, lost):
    mpc = mode(lambda n: Linear(n, 1.0, lost), method=method, elites=3, iterations=2)
    x, u = torch.tensor([[5.0, 0.0]]).double(), torch.tensor([[0.3, -0.2]]).double()
    action, after = mpc.act(x, u, mpc.reset(x, u, torch.tensor([0])), torch.tensor([0]))
    assert torch.equal(action, u)
    torch.testing.assert_close(after[:, :-1].reshape(3, 2), u.expand(3, 2))
    assert mpc.solve(x[0], u[0], 100).cost == math.inf


def test_a_sample_that_diverges_has_no_say():
    """Samples that end in NaN weigh nothing; a situation whose samples all do keeps its plan."""
    x = torch.tensor([[0.0, 0.0], [0.9, 0.0], [5.0, 0.0]], dtype=torch.float64)
    u, k = torch.zeros(3, 2, dtype=torch.float64), torch.zeros(3, dtype=torch.long)
    risky, safe = mode(lambda n: Linear(n, edge=1.0)), mode()
    start = u[:, None].expand(3, 3, 2)
    costs = risky._rollout(x, u, start[:, None] + risky.cfg.noise * risky._noise(k, 0), k)
    lost = costs.isnan().sum(1)
    assert lost[0] < 8
    assert 0 < lost[1] < 8
    assert lost[2] == 8
    action, after = risky.act(x, u, risky.reset(x, u, k), k)
    assert after.isfinite().all()
    assert torch.equal(action[2], u[2])
    if lost[0] == 0:
        assert torch.equal(action[0], safe.act(x, u, safe.reset(x, u, k), k)[0][0])
    alone = mode(lambda n: Linear(n, edge=1.0))
    one = slice(1, 2)
    assert torch.equal(alone.act(x[one], u[one], alone.reset(x[one], u[one], k[one]), k[one])[0], action[one])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"horizon": 0}, "sampling.horizon must be at least 1, got 0"),
        ({"samples": 0}, "sampling.samples must be at least 1, got 0"),
        ({"replan_every": 0}, "sampling.replan_every must be at least 1, got 0"),
        ({"iterations": 0}, "sampling.iterations must be at least 1, got 0"),
        ({"worlds": -1}, "sampling.worlds must be at least 1, got -1"),
        ({"knots": 1}, "sampling.knots must be between 2 and the horizon 20, got 1"),
        ({"knots": 21}, "sampling.knots must be between 2 and the horizon 20, got 21"),
        ({"replan_every": 21}, "sampling.replan_every must not exceed the horizon 20, got 21"),
        ({"temperature": -0.1}, "sampling.temperature must be a number >= 0, got -0.1"),
        ({"temperature": math.nan}, "sampling.temperature must be a number >= 0, got nan"),
        ({"noise": -1.0}, "sampling.noise must be a number >= 0, got -1.0"),
        ({"method": "mpi"}, "sampling.method must be one of mppi, cem, ps, got 'mpi'"),
        ({"method": "cem", "elites": 26}, "sampling.elites must not exceed the 25 samples, got 26"),
    ],
)
def test_bad_settings(setting, message):
    with pytest.raises(ValueError, match=message):
        SamplingCfg(**setting)
