"""How many worlds a search has: as many as fit, on whatever device, and the same plan in parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from hmc import Ensemble, Receding, Task, memory, plan
from hmc.go2.model import HOME, load_model
from hmc.go2.policy import Policy
from hmc.go2.task import CostCfg, policy_path, stance_cost, timeline
from hmc.memory import SHARE, WORKING, make_worlds, needs
from hmc.sim.cuda import num_bytes
from hmc.sim.device import free_memory
from hmc.sim.warp import WarpSim
from tests.toy import ToySim, toy_task

HORIZON, X = 5, [0.4, -0.2]
# a toy's state 2, input 1, memory of its modes 4 and snapshot 4, in double precision
SITUATION = 8 * (2 + 1 + 4 + 4)
FIXED, EACH = 64 * (HORIZON + 1) * SITUATION, 8 * 4 + SITUATION + WORKING


def counted(sizes: list[int], **changed: Any) -> Task:
    """A toy's task that notes how many worlds its simulators have."""

    def make(worlds: int) -> ToySim:
        sizes.append(worlds)
        return ToySim(worlds)

    return replace(toy_task(HORIZON), make_sim=make, **changed)


def test_what_a_search_takes_by_hand():
    assert needs(toy_task(HORIZON), ToySim(1)) == (FIXED, EACH)
    ensemble = Ensemble(3, lambda which: ToySim(len(which)))
    robust = replace(toy_task(HORIZON), ensemble=ensemble)
    assert needs(robust, ToySim(1)) == (3 * FIXED, 4 * EACH), "its own simulator beside the task's"


@pytest.mark.parametrize(("room", "worlds"), [(1.0, 1), (6.999, 6), (7.0, 7), (1e9, 20)])
def test_as_many_as_fit_and_no_more_than_wanted(room, worlds):
    assert make_worlds(toy_task(HORIZON), 20, FIXED + room * EACH).num_worlds == worlds


def test_what_a_device_has_free_decides(monkeypatch):
    assert make_worlds(toy_task(HORIZON), 5000).num_worlds == 5000, "a CPU says for itself"
    monkeypatch.setattr(memory, "free_memory", lambda device: (FIXED + 40.5 * EACH) / SHARE)
    assert make_worlds(toy_task(HORIZON), 5000).num_worlds == 40
    assert make_worlds(toy_task(HORIZON), 5000, FIXED + 7 * EACH).num_worlds == 7, "a setting goes first"


def test_what_was_given_up_is_free(monkeypatch):
    done: list[str] = []

    def told(name: str, result: Any = None) -> None:
        def call(*_: Any) -> Any:
            done.append(name)
            return result

        monkeypatch.setattr(torch.cuda, name, call)

    told("synchronize")
    told("empty_cache")
    told("mem_get_info", (3, 8))
    assert free_memory(torch.device("cuda", 0)) == 3
    assert done == ["synchronize", "empty_cache", "mem_get_info"]
    assert free_memory(torch.device("cpu")) == float("inf")


def test_not_even_one(monkeypatch):
    with pytest.raises(ValueError, match=r"the limit of the search is 0\.03 MiB: free some memory") as error:
        plan(toy_task(HORIZON), X, room=FIXED + EACH - 72_768)
    assert "\n" not in str(error.value)
    assert f"one schedule takes {(FIXED + EACH) / 2**20:.2f} MiB" in str(error.value)
    monkeypatch.setattr(memory, "free_memory", lambda device: 0.0)
    with pytest.raises(ValueError, match=r"90% of what cpu has free is 0\.00 MiB"):
        Receding(toy_task(HORIZON))


@pytest.mark.parametrize("solver", ["sample", "exhaustive"])
def test_the_same_plan_in_parts(solver):
    sizes: list[int] = []
    whole = plan(counted(sizes), X, solver=solver, samples=45)
    assert sizes[-1] == 46
    parts = plan(counted(sizes), X, solver=solver, samples=45, room=FIXED + 3.5 * EACH)
    assert sizes[-1] == 3
    assert parts == whole
    assert parts.control_steps > whole.control_steps, "beginnings are rolled out in each part"
    assert Receding(toy_task(HORIZON), samples=45, room=FIXED + 3.5 * EACH).sim.num_worlds == 3


def test_an_exact_search_takes_all_that_fits():
    """All of Omega at once, and the schedule that it goes out from; the best does not depend on that."""
    sizes: list[int] = []
    whole = plan(counted(sizes), X, solver="exhaustive")
    assert sizes[-1] == 45 + 1
    parts = plan(counted(sizes), X, solver="exhaustive", room=FIXED + 10.5 * EACH)
    assert sizes[-1] == 10
    assert parts == whole == plan(counted(sizes), X, solver="exhaustive", samples=4)
    assert Receding(toy_task(HORIZON), solver="exhaustive").sim.num_worlds == 46
    assert Receding(toy_task(HORIZON)).sim.num_worlds == 46, "no more than 45 of the 64"


def test_a_world_on_engine_warp():
    """Against the arrays of all workspaces that steps of any number of worlds make."""
    sim: Any = WarpSim(load_model(), 7, device="cpu", substeps=1)
    said = sim.world_bytes
    for n in range(1, 8):
        sim.step(HOME.repeat(n, 1), torch.arange(n))
    made = sum(num_bytes(space._data) for space in sim._spaces.values())
    made += sim._rows.nbytes + sim._own.nbytes
    assert sum(sim._spaces) == 14, "as many again as the simulator has"
    assert made == pytest.approx(7 * said, rel=0.02)
    assert sim.world_bytes == said


class Produced(TorchDispatchMode):
    """Bytes of all tensors that operations come to."""

    bytes = 0

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        if isinstance(out, Tensor):
            self.bytes += out.numel() * out.itemsize
        return out


@torch.no_grad()
def test_modes_and_cost_work_within_what_is_set_aside():
    """All that they ever make for a world in a step on a device, as if nothing were freed on the way."""
    n, policy, cost = 50, Policy(policy_path("handstand")), stance_cost(CostCfg(), timeline(3))
    x, u, k = torch.rand(n, 37), torch.rand(n, 12), torch.zeros(n, dtype=torch.long)
    anchor = policy.reset(x, u, k)
    policy.on_device(x, u, anchor)  # loads the network
    with Produced() as produced:
        policy.on_device(x, u, anchor)
        cost.stage_terms(x, u, u, k)
    assert WORKING / 4 < produced.bytes / n < WORKING / 2
