"""Mode sets, costs and tasks: what they hold and what they refuse."""

from __future__ import annotations

import pytest
import torch

import hmc
from hmc import Cost, ModeSet, Sim, Task
from tests.toy import COST, Damp, Push, Ramp, ToySim


def test_a_mode_set_is_found_by_name_and_index():
    modes = ModeSet([Push(1.0), Damp(), Ramp()])
    assert modes.names == ("push1", "damp", "ramp")
    assert [mode.name for mode in modes] == list(modes.names)
    assert modes["ramp"] is modes[2]
    assert (modes.index("damp"), modes.index(1)) == (1, 1)
    assert modes.memory_size == 4, "the largest of its modes"


@pytest.mark.parametrize("name", ["dmap", 3, -1])
def test_an_unknown_mode_is_named(name):
    with pytest.raises(KeyError, match=f"unknown mode {name!r}: this set has push1, damp"):
        ModeSet([Push(1.0), Damp()]).index(name)


def test_a_near_name_is_suggested():
    with pytest.raises(KeyError, match="did you mean 'damp'"):
        ModeSet([Push(1.0), Damp()])["dmap"]


def test_an_empty_mode_set_is_refused():
    with pytest.raises(ValueError, match="at least one mode, got none"):
        ModeSet([])


def test_equal_names_are_refused():
    with pytest.raises(ValueError, match="two modes are called 'damp'"):
        ModeSet([Damp(), Damp()])


@pytest.mark.parametrize("horizon", [0, -3])
def test_a_horizon_of_nothing_is_refused(horizon):
    with pytest.raises(
        ValueError, match=f"task 'toy': horizon must be at least 1 control step, got {horizon}"
    ):
        Task("toy", ModeSet([Damp()]), COST, horizon, ToySim)


def test_cost_terms_in_order():
    cost = Cost(
        stage={"a": lambda x, u, u_prev, k: x[:, 0], "b": lambda x, u, u_prev, k: (u - u_prev)[:, 0]},
        terminal={"c": lambda x, k: x[:, 1] * k},
    )
    x, u, k = torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([[5.0], [6.0]]), torch.tensor([7, 8])
    assert cost.names == ("a", "b", "c")
    assert cost.stage_terms(x, u, torch.ones(2, 1), k).tolist() == [[1.0, 4.0], [3.0, 5.0]]
    assert cost.terminal_terms(x, k).tolist() == [[14.0], [32.0]]
    only_end = Cost(stage={}, terminal=cost.terminal)
    assert only_end.stage_terms(x, u, u, k).shape == (2, 0)
    assert Cost(stage=cost.stage).terminal_terms(x, k).shape == (2, 0)


def test_a_cost_without_terms_or_with_a_name_twice_is_refused():
    with pytest.raises(ValueError, match="at least one term"):
        Cost(stage={})
    with pytest.raises(ValueError, match="stage and a terminal term are both called 'a'"):
        Cost(stage={"a": lambda x, u, u_prev, k: k}, terminal={"a": lambda x, k: k})


def test_the_public_names_are_there():
    assert isinstance(ToySim(1), Sim)
    assert all(getattr(hmc, name) is not None for name in hmc.__all__)
    assert set(hmc.__all__) <= set(dir(hmc))
    with pytest.raises(AttributeError, match="no attribute 'Plann'"):
        _ = hmc.Plann
