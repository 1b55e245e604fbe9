"""What users get wrong in a cost, a rule or a start is named; what cannot be judged has no say."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hmc import Budget, Cost, Ensemble, Mode, ModeSet, Rules, make_start, plan
from hmc.go2.task import JumpCfg
from hmc.running import Running
from hmc.sampling import METHODS, SamplingCfg
from hmc.sim.check import check_latency
from tests.linear import Linear
from tests.test_sampling import mode, situations
from tests.toy import COST, Push, Ramp, ToySim, toy_task

X = [0.3, 0.0]


@pytest.mark.parametrize("lost", [math.inf, -math.inf])
@pytest.mark.parametrize("method", METHODS)
def test_what_costs_no_number_has_as_little_say_as_nan(method, lost):
    """A wall written as an infinite cost: a part of the samples runs into it."""
    x, u, k = situations(20)
    x *= 0.4
    moved = [
        mode(partial(Linear, edge=1.0, lost=value), method=method, elites=3, iterations=2)
        for value in (math.nan, lost)
    ]
    memory = moved[0].reset(x, u, k)
    found = [each.act(x, u, memory, k)[0] for each in moved]
    assert torch.equal(*found)
    assert not torch.equal(found[0], mode(method=method, elites=3, iterations=2).act(x, u, memory, k)[0])


def test_mppi_by_hand_with_a_sample_that_has_no_say():
    cfg = SamplingCfg(samples=3, temperature=0.5)
    noise = torch.tensor([0.0, 1.0, 50.0], dtype=torch.float64)[None, :, None, None]
    costs = torch.tensor([[1.0, 0.5, math.inf]], dtype=torch.float64)
    weight = math.exp(-0.5 / (0.5 * math.sqrt(0.25 / 2)))
    moved, _ = METHODS["mppi"](cfg, noise, costs)
    assert float(moved) == pytest.approx(1 / (1 + weight))


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize(
    ("term", "got"),
    [
        (lambda x, u, u_prev, k: u.square(), r"\(\d+, 1\)"),
        (lambda x, u, u_prev, k: x.square().sum(), r"\(\)"),
        (lambda x, u, u_prev, k: 1.0, "1.0"),
    ],
)
def test_a_cost_term_of_another_shape_is_named(cheap, term, got):
    stage = {"place": lambda x, u, u_prev, k: x[:, 0] ** 2, "effort": term}
    with pytest.raises(ValueError, match=rf"cost term 'effort': expected a tensor of shape .*, got {got}"):
        plan(toy_task(4, [Push(0.0), Push(1.0)], Cost(stage), cheap=cheap), X)
    end = Cost({}, {"end": lambda x, k: term(x, x[:, :1], x, k)})
    with pytest.raises(ValueError, match=rf"cost term 'end': expected a tensor of shape .*, got {got}"):
        plan(toy_task(4, [Push(0.0), Push(1.0)], end, cheap=cheap), X)


def test_terms_in_one_call_are_as_many():
    cost = Cost(
        {"one": lambda x, u, u_prev, k: x[:, 0], "two": lambda x, u, u_prev, k: x[:, 1]},
        on_cpu=lambda x, u, u_prev, k: x[:, :1],
    )
    with pytest.raises(ValueError, match=r"cost on_cpu: expected a tensor of shape \(\d+, 2\)"):
        plan(toy_task(4, [Push(0.0), Push(1.0)], cost), X)


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize(
    ("says", "got"),
    [
        (lambda x, k: True, "True"),
        (lambda x, k: torch.ones(len(x), 1, dtype=torch.bool), r"torch.bool \(\d+, 1\)"),
        (lambda x, k: torch.ones(len(x)), r"torch.float32 \(\d+,\)"),
    ],
)
def test_a_guard_that_does_not_say_yes_or_no_of_each_state_is_named(cheap, says, got):
    """`~True` is -2, which is as good as a no."""
    task = replace(toy_task(4, [Push(0.0), Push(1.0)], cheap=cheap), rules=Rules(guards={"push1": says}))
    with pytest.raises(ValueError, match=rf"rules.guards of mode 'push1': expected .* got {got}"):
        plan(task, X)


def test_a_mode_that_forgets_the_memory_is_named():
    """Of two worlds, the two actions alone passed for actions and memory."""

    class Forgetful(Push):
        def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> Any:
            return super().act(x, u, memory, k)[0]

    with pytest.raises(
        ValueError, match=r"mode 'push1': act\(\) must return \(actions, memory\), got a Tensor"
    ):
        plan(toy_task(4, [Push(0.0), Forgetful(1.0)]), X)


def test_modes_that_are_none_yet():
    modes: list[Any] = [Push(0.0), Ramp]
    with pytest.raises(ValueError, match=r"modes must be a ModeSet, got list: pass ModeSet\(\[mode, ...\]\)"):
        replace(toy_task(4), modes=[Push(0.0), Push(1.0)])
    with pytest.raises(ValueError, match=r"mode Ramp is a class: pass an object of it, Ramp\(...\)"):
        ModeSet(modes)


def test_a_seed_below_zero():
    with pytest.raises(ValueError, match="seed must be >= 0, got -1"):
        plan(toy_task(4), X, seed=-1)


def test_how_long_no_mode_has_been_running_is_refused():
    with pytest.raises(ValueError, match="ran=3 was given without the mode that ran"):
        plan(toy_task(4), X, ran=3)
    task = toy_task(4)
    with pytest.raises(ValueError, match="ran=0 was given without the mode that ran"):
        make_start(task, task.make_sim(1), X, ran=0)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"spacing": 0}, "jump.spacing must be at least 1 .* got 0"),
        ({"dwell": -1}, "jump.dwell at least 0, got 8, -1"),
        (
            {"guess": ((0.1, 0.2, 0.3),)},
            r"jump.guess: each point is .* \(0.1, 0.2, 0.3\)",
        ),
    ],
)
def test_a_guess_of_the_jump_that_is_none(given, words):
    with pytest.raises(ValueError, match=words):
        JumpCfg(**given)


class Failing(Mode):
    """Never comes to an action."""

    name = "failing"

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        raise KeyboardInterrupt


def test_a_mode_that_fails_as_it_is_entered_changes_nothing():
    running = Running(ModeSet([Ramp(), Failing()]))
    x, u = torch.tensor(X, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    for step in range(5):
        running.act(0, x, u, step)
    before = running.mode, running.ran, running.memory, running.u
    with pytest.raises(KeyboardInterrupt):
        running.act(1, x, u, 5)
    assert (running.mode, running.ran, running.memory, running.u) == before
    assert running.ran == 5


def test_nor_does_one_that_fails_after_it_has_changed_its_memory():
    class Breaks(Mode):
        name, memory_size = "breaks", 1

        def act(self, x, u, memory, k):
            memory += 1
            if k[0] == 2:
                raise KeyboardInterrupt
            return u, memory

    running = Running(ModeSet([Breaks()]))
    x, u = torch.tensor(X, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    for step in range(2):
        running.act(0, x, u, step)
    with pytest.raises(KeyboardInterrupt):
        running.act(0, x, u, 2)
    assert running.memory is not None
    assert running.memory.tolist() == [2.0]


@pytest.mark.parametrize(
    ("gives", "words"),
    [
        (lambda u, memory: None, r"act\(\) must return \(actions, memory\), got a NoneType"),
        (lambda u, memory: u[:1].repeat(2, 1), r"act\(\) must return \(actions, memory\), got a Tensor"),
        (lambda u, memory: (0.5, memory), r"act\(\) actions are 0.5, expected a tensor of shape \(\d+, 1\)"),
        (lambda u, memory: (u, None), r"act\(\) memory are None, expected a tensor of shape \(\d+, 1\)"),
    ],
)
def test_a_mode_that_gives_something_else_is_named(gives, words):
    class Slips(Mode):
        name, memory_size = "slips", 1

        def act(self, x, u, memory, k):
            return gives(u, memory)

    with pytest.raises(ValueError, match=f"mode 'slips': {words}"):
        plan(toy_task(4, [Slips()]), X)


@pytest.mark.parametrize("which", ["lower_bound", "tail_bound"])
@pytest.mark.parametrize(
    ("bound", "got"), [(lambda x: torch.full((len(x), 1), 0.1), r"\(\d+, 1\)"), (lambda x: 0.1, "0.1")]
)
def test_a_bound_of_another_shape_is_named(which, bound, got):
    bounds = {"lower_bound": lambda x, k, steps: bound(x), "tail_bound": lambda mode, x, k, steps: bound(x)}
    task = replace(toy_task(5), **{which: bounds[which]})
    with pytest.raises(ValueError, match=rf"{which}: expected a tensor of shape \(\d+,\) .*, got {got}"):
        plan(task, [1.5, 1.0], solver="exhaustive")


def test_snapshots_of_all_worlds_in_place_of_one_are_refused():
    task, sim = toy_task(4), ToySim(3)
    sim.reset(torch.tensor([X]).double().expand(3, -1), torch.zeros(3, 1).double())
    with pytest.raises(ValueError, match=r"task 'toy': snapshot: expected 4 numbers, .* got shape \(3, 4\)"):
        plan(task, X, snapshot=sim.save())
    assert plan(task, X, snapshot=sim.save()[0].numpy()) == plan(task, X, snapshot=sim.save()[0])


def test_a_disturbed_state_that_is_no_number_is_refused():
    def disturb(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return torch.stack([x, x * math.nan]), torch.stack([u, u])

    lost = Ensemble(2, lambda which: ToySim(len(which)), disturb=disturb)
    with pytest.raises(ValueError, match="disturb gave x or u with numbers that are not finite"):
        plan(replace(toy_task(4), ensemble=lost), X)


def test_a_number_of_draws_may_be_written_as_1e1():
    assert plan(toy_task(4), X, samples=3, budget=Budget(draws=1e1)).draws == 10


def test_a_latency_of_numpy_s_is_one_of_all_worlds():
    assert check_latency(np.int64(2), 3, 4) == [2, 2, 2]


@pytest.mark.parametrize("cheap", [False, True])
def test_a_cost_in_one_call_may_keep_what_it_gives(cheap):
    """One that computes into a buffer of its own, and one that is always the same."""
    buffer, ones = torch.empty(1000, 3, dtype=torch.float64), torch.ones(1000, 1, dtype=torch.float64)

    def buffered(x: Tensor, *rest: Tensor) -> Tensor:
        buffer[: len(x)] = torch.stack([term(x, *rest) for term in COST.stage.values()], 1)
        return buffer[: len(x)]

    time = Cost({"time": lambda x, u, u_prev, k: ones[: len(x), 0]}, nonnegative=True)
    for cost, at_once in ((COST, buffered), (time, lambda x, *rest: ones[: len(x)])):
        wanted = plan(toy_task(5, cost=cost, cheap=cheap), [1.5, 1.0], samples=4)
        task = toy_task(5, cost=replace(cost, on_cpu=at_once), cheap=cheap)
        found = plan(task, [1.5, 1.0], samples=4)
        assert found == wanted
        assert found.known.cost == wanted.known.cost
    assert bool((ones == 1).all())


@pytest.mark.parametrize(("dtype", "wall"), [(torch.float32, 1e20), (torch.float64, 1e200)])
def test_a_sample_that_costs_too_much_to_be_squared_has_no_say(dtype, wall):
    cfg = SamplingCfg(samples=3, temperature=0.5)
    noise = torch.tensor([0.0, 1.0, 50.0], dtype=dtype)[None, :, None, None]
    moved, inf = (
        METHODS["mppi"](cfg, noise, torch.tensor([[1.0, 0.5, high]], dtype=dtype))[0]
        for high in (wall, math.inf)
    )
    assert torch.equal(moved, inf)
