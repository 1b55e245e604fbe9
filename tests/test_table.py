"""The transposition table: what it answers, and that schedules never share a row by mistake."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc import Schedule, SwitchSpace
from hmc.table import Table


@pytest.mark.parametrize("num_modes", [2, 256, 257, 70_000])
@given(data=st.data())
def test_rows_are_equal_where_schedules_are(num_modes, data):
    modes = st.lists(st.integers(0, num_modes - 1), min_size=4, max_size=4)
    schedules = data.draw(st.lists(modes, min_size=1, max_size=8))
    schedules += [[0, 0, 0, 0], [num_modes - 1, 0, 0, 0], [0, 0, 0, num_modes - 1]]
    table = Table(num_modes, 1)
    rows = table.rows(torch.tensor(schedules)).tolist()
    for a, one in zip(rows, schedules, strict=True):
        for b, other in zip(rows, schedules, strict=True):
            assert (a == b) == (one == other)
    assert table.rows(torch.tensor(schedules[::-1])).tolist() == rows[::-1]


@given(data=st.data(), num_modes=st.integers(2, 6), horizon=st.integers(1, 9))
def test_neighbours_have_the_rows_of_their_schedules(data, num_modes, horizon):
    mode = st.integers(0, num_modes - 1)
    base = Schedule(tuple(data.draw(st.lists(mode, min_size=horizon, max_size=horizon))))
    space = SwitchSpace(num_modes, horizon)
    switched = space.neighbours(base, torch.arange(len(space)))
    table, schedules = Table(num_modes, 1), switched.tensor()
    rows = table.rows(switched)
    np.testing.assert_array_equal(table.rows(schedules), rows)
    distinct = {tuple(schedule) for schedule in schedules.tolist()}
    assert len(set(rows.tolist())) == len(distinct)


def test_a_million_schedules_have_a_million_rows():
    every = torch.cartesian_prod(*[torch.arange(10, dtype=torch.uint8)] * 6)
    assert len(np.unique(Table(10, 1).rows(every))) == 10**6


def test_a_pruned_cost_answers_only_those_who_have_no_use_for_it():
    table = Table(3, 2)
    rows = table.rows(torch.tensor([[0, 1], [1, 1], [2, 1], [0, 1]]))
    assert rows[0] == rows[3]
    assert len(set(rows.tolist())) == 3
    table.learn(
        rows[:2], np.array([5.0, 7.0]), np.array([False, True]), np.array([[2.0, 3.0], [math.nan] * 2])
    )
    assert table.missing(rows, 6.0).tolist() == [False, False, True, False]
    np.testing.assert_equal(table.costs(rows, 6.0), [5.0, math.inf, math.nan, 5.0])
    assert table.missing(rows, 7.0).tolist() == [False, True, True, False]
    np.testing.assert_equal(table.costs(rows, math.inf), [5.0, math.nan, math.nan, 5.0])
    assert table.terms(int(rows[0])).tolist() == [2.0, 3.0]
    table.learn(rows[1:2], np.array([9.0]), np.array([False]), np.array([[4.0, 5.0]]))
    np.testing.assert_equal(table.costs(rows, math.inf), [5.0, 9.0, math.nan, 5.0])


def test_it_grows():
    table = Table(5, 1)
    every = torch.cartesian_prod(*[torch.arange(5)] * 4)
    for part in every.split(100):
        cost = part.double().numpy() @ [1.0, 10.0, 100.0, 1000.0]
        table.learn(table.rows(part), cost, np.zeros(len(part), dtype=bool), cost[:, None])
    shuffled = every[torch.randperm(len(every))]
    expected = shuffled.double().numpy() @ [1.0, 10.0, 100.0, 1000.0]
    np.testing.assert_array_equal(table.costs(table.rows(shuffled), math.inf), expected)
