"""Worlds that differ from each other in model and latency, on the C engine and on warp."""

from __future__ import annotations

import mujoco
import pytest
import torch

from hmc.go2.model import load_model
from hmc.go2.variants import Variant
from hmc.sim.base import Sim, rollout
from hmc.sim.make import make_sim
from tests.test_sim import TOLERANCE, W, index, inputs, rest, restart, run, same, start

_made: dict[str, Sim] = {}
LATE = (2, 0, 4, 2, 1)  # physics steps, of each world


def other_robots() -> list[mujoco.MjModel]:
    """A model of each world: more and more friction, load and strength; the second comes twice."""
    made = [
        Variant(friction=0.4 + 0.2 * i, payload=0.5 * i, com=(0.01 * i, 0.0, 0.0), strength=1 - 0.05 * i)
        for i in range(W - 1)
    ]
    models = [each.model() for each in made]
    return [*models, models[1]]


def own_worlds(name: str) -> Sim:
    """An engine whose worlds have models and latencies of their own; made once."""
    if name == "warp-cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    if name not in _made:
        engine, _, device = name.partition("-")
        device = device if engine == "warp" else "cpu"
        _made[name] = make_sim(load_model(), W, engine, device=device, latency=LATE, models=other_robots())
    restart(_made[name])
    return _made[name]


@pytest.mark.parametrize("name", ["mujoco-1", "warp-cpu", "warp-cuda"])
def test_worlds_of_their_own(name):
    """Each with its model and its latency: the same as in a simulator that has these in all worlds, also
    when a few of the worlds step alone and when they take over each other's states."""
    mixed, models = own_worlds(name), other_robots()
    u = 4 * inputs(mixed, 3) - 3 * rest(mixed)
    states = run(mixed, u)
    restart(mixed)
    ids = index(mixed, 3, 0, 4)
    assert same(rollout(mixed, u[:, ids].transpose(0, 1), ids).transpose(0, 1), states[:, ids])
    mixed.load(mixed.save(index(mixed, 2)).repeat(W, 1))
    apart = run(mixed, u[:, [2] * W])[-1]
    assert len(torch.unique(apart, dim=0)) == W, "the model and the latency stay with the world"
    for world in range(W) if name == "mujoco-1" else (1, 2):
        engine, _, device = name.partition("-")
        alone = make_sim(
            load_model(),
            1,
            engine,
            device=device if engine == "warp" else "cpu",
            threads=1,
            latency=LATE[world],
            models=[models[world]],
        )
        alone.reset(start(mixed)[world, None], rest(mixed)[world, None])
        assert same(run(alone, u[:, world, None])[:, 0], states[:, world])


@pytest.mark.parametrize("name", ["warp-cpu", "warp-cuda"])
def test_engines_agree_on_worlds_of_their_own(name):
    """As `test_engines_agree`, for 30 control steps of robots that differ from each other."""
    reference, other = own_worlds("mujoco-1"), own_worlds(name)
    x, u = start(reference).float(), inputs(reference, 30).float()
    reference.reset(x.double(), rest(reference))
    other.reset(x.to(other.device), rest(other))
    for u_k in u:
        reference.step(u_k)
        other.step(u_k.to(other.device))
        assert (other.x().cpu().double() - reference.x()).abs().max() <= TOLERANCE[name]
