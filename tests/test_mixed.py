"""Simulators of several kinds as one: the same worlds as each by itself."""

from __future__ import annotations

from functools import partial

import mujoco
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc.sim.base import Sim
from hmc.sim.check import tell_overflow
from hmc.sim.mixed import Mixed
from hmc.sim.mujoco import MujocoSim
from hmc.tasks.cartpole import CartpoleCfg, cartpole
from tests.toy import ToySim

POINT = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.25"><flag autoreset="disable"/></option>
  <worldbody>
    <body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="slide"/></actuator>
</mujoco>""")
MAKE = [
    partial(ToySim, hidden=0.3),
    partial(MujocoSim, POINT, substeps=2, threads=1),
    partial(ToySim, hidden=-0.5),
]


@given(
    kinds=st.lists(st.integers(0, 2), min_size=1, max_size=8),
    steps=st.lists(st.lists(st.integers(0, 7), max_size=8, unique=True), min_size=1, max_size=4),
)
def test_worlds_are_as_in_a_simulator_of_their_kind(kinds, steps):
    """A step of some worlds, in any order, then copies among worlds of a kind, then a step of all."""
    mixed, w = Mixed(MAKE, kinds), len(kinds)
    assert isinstance(mixed, Sim)
    assert (mixed.num_worlds, mixed.nx, mixed.nu, mixed.dt) == (w, 2, 1, 0.5)
    own = [MAKE[kind](1) for kind in kinds]
    x, u = torch.rand(w, 2, dtype=torch.float64), torch.rand(w, 1, dtype=torch.float64)
    mixed.reset(x, u)
    for i, sim in enumerate(own):
        sim.reset(x[i : i + 1], u[i : i + 1])
    for some in steps:
        ids = torch.tensor([i for i in some if i < w], dtype=torch.long)
        push = torch.rand(len(ids), 1, dtype=torch.float64)
        mixed.step(push, ids)
        for row, i in enumerate(ids.tolist()):
            own[i].step(push[row : row + 1])
        rows = mixed.save(ids)
        assert torch.equal(mixed.x(ids), torch.cat([own[i].x() for i in ids.tolist()] or [rows[:, :2]]))
        mixed.load(rows, ids)
    source = [kinds.index(kind) for kind in kinds]
    mixed.load(mixed.save(torch.tensor(source)))
    mixed.step(u, slice(0, w))
    for i, sim in enumerate(own):
        sim.load(own[source[i]].save()) if source[i] != i else None
    for i, sim in enumerate(own):
        sim.step(u[i : i + 1])
        assert torch.equal(mixed.x(slice(i, i + 1)), sim.x())
        assert torch.equal(mixed.u(slice(i, i + 1)), sim.u())


def test_what_does_not_go_together_is_refused():
    for kinds in ([], [0, 3], [-1, 0]):
        with pytest.raises(ValueError, match="expected kinds of 0 to 2, one a world, got"):
            Mixed(MAKE, kinds)
    other = cartpole(CartpoleCfg()).make_sim
    with pytest.raises(ValueError, match=r"must agree in nx, got \[2, 4\]"):
        Mixed([ToySim, other], [0, 1])
    Mixed([ToySim, other], [0, 0])  # a kind that nobody is of is not made
    mixed = Mixed(MAKE, [0, 1])
    with pytest.raises(ValueError, match=r"u must be \(2, 1\)"):
        mixed.step(torch.zeros(1, 1, dtype=torch.float64))


def test_what_did_not_fit_in_one_of_them_is_told():
    class Full(ToySim):
        def overflow(self) -> dict[str, int]:
            return {"contacts": 2, "constraints": 0}

    mixed = Mixed([Full, ToySim, Full], [0, 1, 2, 0])
    with pytest.warns(UserWarning, match="4 by contacts; give the simulator more contacts="):
        tell_overflow(mixed)
