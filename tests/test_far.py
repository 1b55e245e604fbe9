"""Planning on a device that is not the CPU: on one that refuses what a GPU refuses, at the CPU's numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch

from hmc import Evaluator, Receding, Rules, Schedule, SwitchSpace, Task, make_start, plan
from hmc.ensemble import Ensemble
from hmc.go2 import ensemble as go2_ensemble
from hmc.go2.ensemble import EnsembleCfg
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import CostCfg, FlipCfg, JumpCfg, flip_task
from hmc.sampling import SamplingCfg
from hmc.sim import make
from tests.far import Device, Far, FarSim, near
from tests.linear import Linear
from tests.test_sampling import mode as mpc_mode
from tests.test_sampling import situations
from tests.toy import Damp, Push, ToySim, toy_task

X, U = torch.tensor([0.4, -0.2]).double(), torch.zeros(1).double()
ROOM = 1e9


def toys(which: Sequence[int]) -> ToySim:
    """Members of an ensemble: one gives way where the other does not."""
    return ToySim(len(which), hidden=[0.3 * each for each in which])


def there(task: Task) -> Task:
    """The same task in simulators of the other device."""
    members, sims = task.ensemble, task.make_sim
    if members is not None:
        ours = members.make_sim
        members = Ensemble(members.size, lambda which: FarSim(ours(which)))
    return replace(task, make_sim=lambda n: FarSim(sims(n)), ensemble=members)


def safe(x: torch.Tensor, k: torch.Tensor) -> torch.Tensor:
    """A guard."""
    return x[:, 1] < 0.5


CHANGES: dict[str, Callable[[Task], Task]] = {
    "plain": lambda task: task,
    "guarded": lambda task: replace(task, rules=Rules(guards={"damp": safe}, dwell={"damp": 2})),
    "bounded": lambda task: replace(task, lower_bound=lambda x, k, steps: 0.1 * x[:, 0] ** 2),
    "robust": lambda task: replace(task, ensemble=Ensemble(2, toys)),
}


@pytest.mark.parametrize("name", CHANGES)
def test_the_same_plan(name):
    """To the bit: with guards, bounds, ensembles, in parts, and in one tick after the other."""
    task = CHANGES[name](toy_task(7, [Push(1.0), Damp()]))
    for room in (ROOM, 300_000.0):
        here = plan(task, X, u=U, solver="exhaustive", room=room)
        with Device() as device:
            assert plan(there(task), X, u=U, solver="exhaustive", room=room) == here
        assert device.uploads > 0
    loop = Receding(task, samples=9)
    ticks = [loop.tick(X, U) for _ in range(3)]
    with Device():
        loop = Receding(there(task), samples=9, room=ROOM)
        for tick in ticks:
            found = loop.tick(X, U)
            assert found.plan == tick.plan
            assert torch.equal(found.u.cpu(), tick.u)


def waits(name: str, horizon: int, limit: float) -> Counter[str]:
    """Of a rollout through all switches from a schedule of one mode, of what costs `limit` times as much."""
    task, foot = there(CHANGES[name](toy_task(horizon, [Push(1.0), Damp()]))), Schedule.constant(0, horizon)
    space = SwitchSpace(2, horizon)
    with Device() as device:
        sim = task.make_sim(len(space))
        evaluator = Evaluator(task, sim, make_start(task, sim, X, U))
        bound = evaluator.follow(foot)
        device.waits.clear()
        evaluator.costs(space.neighbours(foot, torch.arange(len(space))), limit * bound)
    return +device.waits


@pytest.mark.parametrize("horizon", [5, 8, 16, 24])
def test_how_often_a_rollout_waits(horizon):
    """Once in eight control steps, and twice at its end; all other copies flow along."""
    assert waits("plain", horizon, 1.0) == {"_to_copy": math.ceil(horizon / 8) + 1, "_local_scalar_dense": 1}


@pytest.mark.parametrize("horizon", [5, 8, 16])
def test_what_is_asked_on_the_way_waits_once(horizon):
    """A control step: what its guard bars, what is sure to cost too much, what the last step cost, and who is
    no number. Rules are looked at beforehand, all at once. Bounds wait only where there is a limit."""
    plain = {"_to_copy": math.ceil(horizon / 8) + 1, "_local_scalar_dense": 1}
    assert waits("bounded", horizon, 1.0) == {"_to_copy": horizon + 2, "_local_scalar_dense": 1}
    assert waits("bounded", horizon, math.inf) == plain
    assert waits("guarded", horizon, 1.0) == {"_to_copy": horizon + 2, "_local_scalar_dense": 1}


def test_sampling_mpc_waits_once_a_step():
    """To learn in which of its worlds it re-plans, and whether these were there before."""
    here, far = mpc_mode(replan_every=2), mpc_mode(lambda n: FarSim(Linear(n)), replan_every=2)
    x, u, k = situations(5)
    memory = here.reset(x, u, k)
    with Device() as device:
        for step in range(4):
            action, after = here.act(x, u, memory, k + step)
            device.waits.clear()
            found = far.act(*map(Far, (x, u, memory, k + step)))
            assert step == 0 or +device.waits == {"_to_copy": 1}, "constants are copied once"
            assert torch.equal(near(found[0]), action)
            assert torch.equal(near(found[1]), after)
            memory = after


@pytest.mark.parametrize(("mpc", "members", "value"), [(False, 1, 1.0), (True, 0, 0.0)])
def test_a_flip(mpc, members, value, monkeypatch):
    """Policies and critic in torch, a motion or sampling MPC as the jump: what is on a device stays there."""
    sampling = SamplingCfg(samples=3, horizon=3, knots=2, replan_every=2, worlds=4)
    jump = JumpCfg(guess=((-0.2, -2.0, 3.0, -1.7), (0.2, -1.1, 1.1, -0.8)), mpc=mpc, sampling=sampling)
    cfg = FlipCfg(
        horizon=4, command=2, jump=jump, cost=CostCfg(value=value), ensemble=EnsembleCfg(members=members)
    )
    x = FOOTSTAND.state()

    def found() -> Any:
        task = flip_task(cfg, threads=1)
        return plan(task, x, u=x[7:19], solver="exhaustive", iterations=1, room=ROOM)

    here, ours = found(), make.make_sim

    def made(*given: Any, **settings: Any) -> Any:
        return FarSim(ours(*given, **settings))

    for module in (make, go2_ensemble):
        monkeypatch.setattr(module, "make_sim", made)
    with Device():
        found()  # constants and networks are copied once
    with Device() as device:
        far = found()
    assert far.schedule == here.schedule
    assert far.cost == pytest.approx(here.cost, rel=1e-6)
    assert set(+device.waits) <= {"_to_copy", "_local_scalar_dense"}
