"""What waits for a device in a rollout, without one: operations whose outcome the host must have to go on."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from hmc import Cost, Evaluator, Rules, make_start, rollout
from hmc.sampling import METHODS
from hmc.sim.device import upload
from tests.test_sampling import mode, situations
from tests.toy import COST, Bad, Damp, Push, all_schedules, toy_task

WAITING = {"_local_scalar_dense", "nonzero", "_unique2", "unique_dim", "masked_select", "equal", "is_nonzero"}
X = [0.4, -0.2]


class Waits(TorchDispatchMode):
    """Counts operations that make the host wait for numbers, by name."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        self.found[name] += name in WAITING
        if name == "index" and any(each is not None and each.dtype == torch.bool for each in args[1]):
            self.found["index by flags"] += 1
        return func(*args, **(kwargs or {}))


def costs(bound: float = math.inf, worlds: int = 81) -> tuple[torch.Tensor, Evaluator]:
    """All schedules of a toy whose third mode ends in NaN, and whose states may."""
    task = toy_task(4, [Push(1.0), Damp(), Bad(2)], blow_up=1.6)
    sim = task.make_sim(worlds)
    evaluator = Evaluator(task, sim, make_start(task, sim, X))
    return evaluator.costs(all_schedules(3, 4), bound), evaluator


@pytest.mark.parametrize("worlds", [1, 7, 81])
def test_what_diverges_is_found_later_at_the_same_costs(monkeypatch, worlds):
    now, here = costs(worlds=worlds)
    some = float(now[now.isfinite()].median())
    bounded, _ = costs(some, worlds)
    monkeypatch.setattr(rollout, "far", lambda device: True)
    then, there = costs(worlds=worlds)
    assert 0 < here.diverged == there.diverged < 81
    assert torch.equal(then, now)
    assert there.own_steps >= here.own_steps
    assert torch.equal(costs(some, worlds)[0], bounded)


@pytest.mark.parametrize("asked", [("guards",), ("bound",), ("guards", "bound")])
@pytest.mark.parametrize("share", [1.0, 0.3, 0.03])
def test_what_is_asked_on_the_way_is_found_together(asked, share, monkeypatch):
    """Whoever diverges, is barred or costs too much does so in the same order, wherever he is looked at."""
    task = toy_task(5, [Push(1.0), Damp(), Bad(2)], blow_up=1.6)
    if "guards" in asked:
        # no number is below either: what diverges has to be found before guards are asked
        guards = {"damp": lambda x, k: x[:, 1] < 0.5, "bad": lambda x, k: x[:, 0] < 0.7}
        task = replace(task, rules=Rules(guards=guards))
    schedules = all_schedules(3, 5)

    def found(bound: float) -> tuple[torch.Tensor, tuple[int, ...]]:
        now = task if "bound" not in asked else replace(task, lower_bound=lambda x, k, n: 0.05 * x[:, 0] ** 2)
        evaluator = Evaluator(now, now.make_sim(100), make_start(now, now.make_sim(1), X))
        costs = evaluator.costs(schedules, bound)
        return costs, (evaluator.diverged, evaluator.ruled_out, evaluator.pruned)

    free = found(math.inf)[0]
    bound = float(free[free.isfinite()].quantile(share))
    here = [found(bound), found(math.inf)]
    monkeypatch.setattr(rollout, "far", lambda device: True)
    there = [found(bound), found(math.inf)]
    for (costs, counts), (others, other_counts) in zip(here, there, strict=True):
        assert torch.equal(costs, others)
        assert counts == other_counts
    assert ("guards" in asked) == (here[1][1][1] > 0)
    assert here[1][1][0] > 0


def waits_of(horizon: int) -> int:
    """Of a rollout through all schedules of two modes."""
    task = toy_task(horizon, [Push(1.0), Damp()])
    sim = task.make_sim(64)
    evaluator = Evaluator(task, sim, make_start(task, sim, X))
    schedules = all_schedules(2, horizon)
    with Waits() as waits:
        evaluator.costs(schedules)
    return waits.found.total()


def test_no_step_waits_but_for_costs(monkeypatch):
    """Whose copies to the host a CPU does not make; the rest is of the whole rollout, at any horizon."""
    here = waits_of(4), waits_of(6)
    assert here[1] - here[0] == 2 * 2, "states and inputs of each step"
    monkeypatch.setattr(rollout, "far", lambda device: True)
    assert waits_of(4) == waits_of(6) == here[0] - 2 * 4


@pytest.mark.parametrize(("horizon", "share"), [(5, 1.0), (9, 1.0), (9, 0.1), (9, 0.01)])
def test_costs_are_waited_for_once_in_eight_steps(horizon, share, monkeypatch):
    """What is beyond its bound goes on until then, and so do its children; nothing else changes."""
    made: list[int] = []

    def position(*given: torch.Tensor) -> torch.Tensor:
        made.append(len(given[0]))
        return COST.stage["position"](*given)

    cost = Cost({**COST.stage, "position": position}, COST.terminal, nonnegative=True)
    task, schedules = toy_task(horizon, [Push(1.0), Damp()], cost), all_schedules(2, horizon)

    def found(bound: float) -> tuple[torch.Tensor, int]:
        sim = task.make_sim(len(schedules))
        evaluator = Evaluator(task, sim, make_start(task, sim, X))
        made.clear()
        costs = evaluator.costs(schedules, bound)
        return costs, evaluator.own_steps

    bound = float(found(math.inf)[0].quantile(share))
    costs, steps = found(bound)
    assert len(made) == horizon
    monkeypatch.setattr(rollout, "far", lambda device: True)
    later, more = found(bound)
    assert torch.equal(costs, later)
    assert len(made) == math.ceil(horizon / 8)
    assert steps == more if share == 1 else steps < more


def test_what_a_gpu_fetches_is_pinned(monkeypatch):
    """From other memory it could not be fetched beside what the host does; a CPU has no use for that."""
    done: list[Any] = []

    def pinned(values: torch.Tensor) -> torch.Tensor:
        done.append("pin")
        return values

    monkeypatch.setattr(torch.Tensor, "pin_memory", pinned)
    monkeypatch.setattr(torch.Tensor, "to", lambda values, device, **how: done.append((device.type, how)))
    for name in ("cuda:0", "cpu"):
        upload(np.arange(3), torch.device(name))
    assert done == ["pin", ("cuda", {"non_blocking": True}), ("cpu", {"non_blocking": True})]


@pytest.mark.parametrize("method", METHODS)
def test_a_replan_does_not_wait(method, monkeypatch):
    """Its noise is made on the CPU, of control steps that are known there."""
    mpc = mode(method=method, iterations=2, elites=3, guess=torch.rand(9, 2).double())
    x, u, k = situations(5)
    theta = mpc.reset(x, u, k)[:, :-1].reshape(5, 3, 2)
    noise = [mpc._noise(k, i) for i in range(2)]
    monkeypatch.setattr(mpc, "_noise", lambda k, i, like: noise[i])
    mpc._replan(x, u, theta, k)  # makes its simulator
    with Waits() as waits:
        mpc._replan(x, u, theta, k)
    assert waits.found.total() == 0, waits.found
    with Waits() as waits:
        mpc.act(x, u, mpc.reset(x, u, k), k)
    assert waits.found.total() == 0, "but for the one copy, which a CPU does not make"
