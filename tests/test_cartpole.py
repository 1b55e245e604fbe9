"""The closed-form cartpole against mechanics on paper, and the swing-up task."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc import Budget, Schedule, plan
from hmc.evaluate import Evaluator
from hmc.sim.cartpole import CartpoleParams, CartpoleSim
from hmc.start import make_start
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state

states = st.lists(st.floats(-3, 3), min_size=4, max_size=4)


def run(x, u, steps, sim=None):
    """State after `steps` under one constant input, (4,)."""
    sim = sim or CartpoleSim(1)
    sim.reset(torch.tensor([x], dtype=torch.float64), torch.zeros(1, 1))
    for _ in range(steps):
        sim.step(torch.tensor([[u]], dtype=torch.float64))
    return sim.x()[0]


def test_energy_is_kept_without_force():
    sim = CartpoleSim(100, dt=0.01, substeps=5)
    sim.reset(3 * torch.randn(100, 4, dtype=torch.float64), torch.zeros(100, 1))
    before = sim.energy()
    for _ in range(50):
        sim.step(torch.zeros(100, 1))
    assert float((sim.energy() - before).abs().max()) < 1e-6


@given(states, st.floats(-1, 1))
def test_power_of_the_force_is_the_only_gain(x, u):
    """dE/dt = F p': integrated by Simpson's rule over one short step."""
    sim = CartpoleSim(1, dt=1e-3)
    sim.reset(torch.tensor([x], dtype=torch.float64), torch.zeros(1, 1))
    energy, speed = float(sim.energy()), x[3]
    after = run(x, u, 1, sim)
    middle = run(x, u, 1, CartpoleSim(1, dt=5e-4))
    work = 10.0 * u * 1e-3 * (speed + 4 * float(middle[3]) + float(after[3])) / 6
    # `sim` still holds the state after the step
    assert float(sim.energy()) - energy == pytest.approx(work, abs=1e-9)


def test_momentum_is_kept_without_force():
    """(M + m) p' + m l theta' cos(theta) is the horizontal momentum."""

    def momentum(x):
        return 1.1 * x[3] + 0.1 * 0.5 * x[2] * math.cos(x[0])

    x = [1.0, 0.3, -2.0, 0.7]
    assert float(momentum(run(x, 0.0, 100).tolist())) == pytest.approx(momentum(x), abs=1e-6)


def test_accelerations_by_hand():
    """From rest: upright p'' = F / M; level p'' = F / (M + m) and theta'' = g / l."""
    h = 1e-4
    upright = run([0.0] * 4, 1.0, 1, CartpoleSim(1, dt=h))
    assert float(upright[3]) / h == pytest.approx(10.0, rel=1e-5)
    assert float(upright[2]) / h == pytest.approx(-20.0, rel=1e-5)
    level = run([math.pi / 2, 0.0, 0.0, 0.0], 1.0, 1, CartpoleSim(1, dt=h))
    assert float(level[3]) / h == pytest.approx(10.0 / 1.1, rel=1e-4)
    assert float(level[2]) / h == pytest.approx(9.81 / 0.5, rel=1e-4)


def test_small_swing_has_the_period_of_the_linear_system():
    """Hanging: omega^2 = (1 + m / M) g / l."""
    period = 2 * math.pi / math.sqrt(1.1 * 9.81 / 0.5)
    sim = CartpoleSim(1, dt=period / 200)
    quarter = run([math.pi - 1e-4, 0.0, 0.0, 0.0], 0.0, 50, sim)
    assert float(quarter[0]) == pytest.approx(math.pi, abs=1e-8)
    full = run([math.pi - 1e-4, 0.0, 0.0, 0.0], 0.0, 200, sim)
    assert float(full[0]) == pytest.approx(math.pi - 1e-4, abs=1e-8)


def test_fourth_order():
    """Halving the integration step divides the error by 2^4."""
    x, exact = [2.0, 0.0, 1.0, 0.5], run([2.0, 0.0, 1.0, 0.5], 0.7, 10, CartpoleSim(1, dt=0.05, substeps=64))
    errors = [float((run(x, 0.7, 10, CartpoleSim(1, dt=0.05, substeps=n)) - exact).norm()) for n in (2, 4, 8)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.25)


@pytest.mark.parametrize("substeps", [1, 3])
def test_what_is_differentiated_is_what_is_stepped(substeps):
    """`advance` and `step` are the same numbers, in many worlds and in one."""
    sim = CartpoleSim(5000, substeps=substeps)
    x = 3 * torch.randn(5000, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = torch.linspace(-1, 1, 5000, dtype=torch.float64)[:, None]
    sim.reset(x, u)
    sim.step(u)
    assert torch.equal(sim.x(), sim.advance(x, u))
    for world in range(0, 5000, 500):
        sim.reset(x, u)
        sim.step(u[world : world + 1], slice(world, world + 1))
        assert torch.equal(sim.x()[world], sim.advance(x, u)[world])


@given(states, st.floats(-1, 1))
def test_left_and_right_are_alike(x, u):
    mirrored = run([-value for value in x], -u, 5)
    assert torch.equal(mirrored, -run(x, u, 5))


@given(st.integers(1, 20), st.integers(0, 19), st.integers(0, 5))
def test_a_world_goes_its_way_alone(n, world, others):
    """Same bits in a batch of any size, with other worlds stepped or not, and from a snapshot."""
    world %= n
    generator = torch.Generator().manual_seed(n)
    x = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    u = torch.randn(n, 1, generator=generator, dtype=torch.float64)
    sim = CartpoleSim(n)
    sim.reset(x, u)
    ids = torch.tensor(sorted({world, *range(min(others, n))}))
    saved = sim.save(torch.tensor([world]))
    for _ in range(3):
        sim.step(u[ids], ids)
    alone = run(x[world].tolist(), float(u[world]), 3)
    assert torch.equal(sim.x(torch.tensor([world]))[0], alone)
    untouched = [i for i in range(n) if i not in ids.tolist()]
    assert torch.equal(sim.x()[untouched], x[untouched])
    branch = CartpoleSim(2)
    branch.load(saved, torch.tensor([1]))
    for _ in range(3):
        branch.step(u[world][None], torch.tensor([1]))
    assert torch.equal(branch.x()[1], alone)


@pytest.mark.parametrize("name", ["cart_mass", "pole_mass", "pole_length", "gear"])
def test_impossible_parameters_are_named(name):
    with pytest.raises(ValueError, match=f"cartpole {name} must be more than 0, got -1"):
        CartpoleParams(**{name: -1.0})


def test_impossible_settings_are_named():
    with pytest.raises(ValueError, match="num_worlds must be at least 1, got 0"):
        CartpoleSim(0)
    with pytest.raises(ValueError, match="dt=0"):
        CartpoleSim(1, dt=0.0)
    with pytest.raises(ValueError, match="num_modes must be at least 2 inputs, got 1"):
        CartpoleCfg(num_modes=1)


def test_modes_are_inputs_uniformly_spaced():
    task = cartpole(CartpoleCfg(num_modes=5))
    x, u, k = torch.zeros(1, 4), torch.zeros(1, 1), torch.zeros(1, dtype=torch.long)
    inputs = [float(mode.act(x, u, torch.zeros(1, 0), k)[0]) for mode in task.modes]
    assert inputs == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert task.modes.names == ("-10 N", "-5 N", "0 N", "5 N", "10 N")


def test_the_cost_of_hanging_still():
    """(cos(pi) - 1)^2 = 4: 4 x 4 a second over 2 s, and 4 x 4 at the end."""
    task = cartpole()
    sim = task.make_sim(1)
    terms = Evaluator(task, sim, make_start(task, sim, initial_state())).terms(Schedule.constant(2, 100))
    wanted = {"angle": 32.0, "position": 0.0, "velocity": 0.0, "input": 0.0, "final angle": 16.0}
    assert terms == pytest.approx(wanted, abs=1e-9)


def test_the_printed_weights():
    """Each term of one state and input, by hand."""
    cost = cartpole().cost
    x = torch.tensor([[math.pi / 2, 2.0, 3.0, -1.0]], dtype=torch.float64)
    u = torch.tensor([[0.5]], dtype=torch.float64)
    terms = cost.stage_terms(x, u, u, torch.zeros(1, dtype=torch.long))[0].tolist()
    assert terms == pytest.approx([4.0, 0.4, 1.0, 0.25])
    assert cost.terminal_terms(x, torch.zeros(1, dtype=torch.long))[0].tolist() == pytest.approx([4.0])


@given(st.integers(1, 40), st.integers(0, 99))
def test_the_cost_in_one_call(n, seed):
    """To the bit that of the terms one by one, of whichever layout the states are."""
    generator = torch.Generator().manual_seed(seed)
    x = 3 * torch.randn(n, 4, generator=generator, dtype=torch.float64)
    u, k = torch.randn(n, 1, generator=generator, dtype=torch.float64), torch.zeros(n, dtype=torch.long)
    cost = cartpole().cost
    wanted = torch.stack([term(x, u, u, k) for term in cost.stage.values()], 1)
    for states in (x, x.T.clone().T):
        assert torch.equal(cost.stage_terms(states, u, u, k), wanted)


def test_swing_up():
    """From hanging the search gets the pole up: within 35 degrees of upright at the end."""
    cfg = CartpoleCfg(horizon=50, dt=0.04, num_modes=3)
    task = cartpole(cfg)
    sim = task.make_sim(128)
    result = plan(
        task, initial_state(cfg), schedule=[1] * 50, samples=128, budget=Budget(draws=2500), seed=0, sim=sim
    )
    end = Evaluator(task, sim, make_start(task, sim, initial_state(cfg))).trace(result.schedule).x[-1]
    assert math.cos(float(end[0])) > 0.82
    assert result.cost < 0.6 * result.incumbent_cost
