"""Schedules, switches, and the space of all switches."""

from __future__ import annotations

import tracemalloc
from collections import Counter
from dataclasses import FrozenInstanceError
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc.schedule import Draws, InOrder, Schedule, Switch, SwitchSpace, TailsFirst, batch, tails

NAMES = ("foot", "jump", "hand")
modes = st.lists(st.integers(0, 2), min_size=1, max_size=30)
spaces = st.builds(SwitchSpace, st.integers(1, 5), st.integers(1, 60_000))


def test_stitch_by_hand():
    schedule = Schedule((0, 0, 1, 1, 2), NAMES)
    assert schedule.stitch(Switch(2, 1, 3)).modes == (0, 2, 2, 2, 2)
    assert schedule.stitch(Switch(1, 0, 5)).modes == (1, 1, 1, 1, 1)
    assert schedule.stitch(Switch(1, 4, 1)).modes == (0, 0, 1, 1, 1)
    assert schedule.modes == (0, 0, 1, 1, 2), "stitching must not change the schedule itself"


def test_shift_by_hand():
    assert Schedule((0, 1, 2)).shift().modes == (1, 2, 2)
    assert Schedule((0, 1, 2)).shift(fill=0).modes == (1, 2, 0)
    assert Schedule((1,)).shift().modes == (1,)


def test_prints_as_runs():
    text = "foot x35 | jump x12 | hand x53"
    assert str(Schedule((0,) * 35 + (1,) * 12 + (2,) * 53, NAMES)) == text
    assert str(Schedule((1, 0, 0))) == "1 x1 | 0 x2"


@given(modes)
def test_runs_rebuild_the_schedule(items):
    schedule = Schedule(tuple(items))
    runs = schedule.runs()
    assert all(a.stop == b.start and a.mode != b.mode for a, b in pairwise(runs))
    rebuilt = Schedule.constant(0, len(items))
    for run in runs:
        rebuilt = rebuilt.stitch(run)
    assert rebuilt == schedule


def test_is_a_value():
    a, b = Schedule((0, 1), NAMES), Schedule([0, 1])
    assert a == b
    assert hash(a) == hash(b)
    assert a != Schedule((1, 0))
    assert Schedule(torch.tensor([2, 0])).modes == (2, 0)
    assert torch.equal(batch([a, Schedule((1, 2))]), torch.tensor([[0, 1], [1, 2]]))
    with pytest.raises(FrozenInstanceError):
        setattr(a, "modes", (1, 1))  # noqa: B010


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Schedule(()), "at least one control step"),
        (lambda: Schedule((0, 3), NAMES), r"step 1: unknown mode 3, expected 0 to 2 \(foot, jump, hand\)"),
        (lambda: Schedule((0, -1)), "step 1: unknown mode -1"),
        (lambda: Schedule((0, 0)).stitch(Switch(1, 1, 2)), "ends at step 3, after the schedule's 2 steps"),
        (lambda: Switch(0, 0, 0), "duration >= 1"),
        (lambda: Switch(0, -1, 1), "start >= 0"),
        (lambda: SwitchSpace(0, 5), "num_modes=0"),
        (lambda: SwitchSpace(2, 0), "horizon=0"),
        (lambda: SwitchSpace(2, 3).index(Switch(2, 0, 1)), "not among 2 modes x 3 steps"),
        (lambda: SwitchSpace(2, 3).index(Switch(0, 2, 2)), "not among 2 modes x 3 steps"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_mode_index_is_an_integer():
    with pytest.raises(TypeError):
        Schedule((0.5, 1.0))


@pytest.mark.parametrize("horizon", range(1, 10))
@pytest.mark.parametrize("num_modes", [1, 3])
def test_space_holds_every_switch_once(num_modes, horizon):
    space = SwitchSpace(num_modes, horizon)
    every = {
        (m, mu, nu) for m in range(num_modes) for mu in range(horizon) for nu in range(1, horizon - mu + 1)
    }
    listed = [space[i] for i in range(len(space))]
    assert len(space) == num_modes * horizon * (horizon + 1) // 2 == len(every)
    assert {(s.mode, s.start, s.duration) for s in listed} == every
    assert [space.index(s) for s in listed] == list(range(len(space)))
    for outside in (-1, len(space)):
        with pytest.raises(IndexError):
            space[outside]


@given(st.data(), spaces)
def test_space_is_a_bijection_at_any_size(data, space):
    index = data.draw(st.integers(0, len(space) - 1))
    switch = space[index]
    assert switch.mode < space.num_modes
    assert switch.stop <= space.horizon
    assert space.index(switch) == index
    parts = space.split(torch.tensor([index]))
    assert [int(part) for part in parts] == [switch.mode, switch.start, switch.duration]


@given(st.data(), spaces)
def test_every_switch_has_an_index(data, space):
    start = data.draw(st.integers(0, space.horizon - 1))
    switch = Switch(
        data.draw(st.integers(0, space.num_modes - 1)),
        start,
        data.draw(st.integers(1, space.horizon - start)),
    )
    assert space[space.index(switch)] == switch


@given(st.builds(SwitchSpace, st.integers(1, 3), st.integers(1, 20)), st.integers(1, 12))
def test_coarse_switches_begin_and_end_at_cuts(space, parts):
    cuts = {i * space.horizon // parts for i in range(parts + 1)}
    switches = [space[i] for i in range(len(space))]
    expected = [i for i, switch in enumerate(switches) if {switch.start, switch.stop} <= cuts]
    assert space.coarse(parts).tolist() == expected


def test_space_of_more_than_a_billion():
    space = SwitchSpace(3, 100_000)
    assert len(space) == 15_000_150_000
    ends = [0, 1, len(space) // 2, len(space) - 2, len(space) - 1]
    assert [space.index(space[i]) for i in ends] == ends


@given(st.data(), modes)
def test_stitching_by_index_is_stitching(data, items):
    schedule, space = Schedule(tuple(items)), SwitchSpace(3, len(items))
    indices = data.draw(st.lists(st.integers(0, len(space) - 1), max_size=8))
    rows = space.stitch(schedule, torch.tensor(indices, dtype=torch.long))
    assert rows.tolist() == [list(schedule.stitch(space[i])) for i in indices]


@given(st.integers(1, 200), st.lists(st.integers(1, 50), max_size=20), st.integers(0, 99))
def test_draws_visit_all_exactly_once(size, sizes, seed):
    draws = Draws(size, np.random.default_rng(seed))
    taken = [draws.take(n) for n in [*sizes, size]]
    assert sorted(torch.cat(taken).tolist()) == list(range(size))
    assert draws.left == 0
    assert len(draws.take(5)) == 0


def test_draws_do_not_depend_on_the_batch_size():
    def drawn(sizes):
        draws = Draws(100, np.random.default_rng(3))
        return torch.cat([draws.take(n) for n in sizes]).tolist()

    assert drawn([100]) == drawn([1] * 100) == drawn([7, 64, 29])
    assert drawn([100]) != Draws(100, np.random.default_rng(4)).take(100).tolist()


def test_every_order_is_equally_likely():
    runs = 4800
    seen = Counter(tuple(Draws(4, np.random.default_rng(seed)).take(4).tolist()) for seed in range(runs))
    expected = runs / 24
    chi2 = sum((seen[order] - expected) ** 2 / expected for order in seen) + expected * (24 - len(seen))
    assert chi2 < 49.7, "chi-square with 23 degrees of freedom exceeds its 99.9 % quantile"


def test_draws_from_a_billion_use_little_memory():
    space = SwitchSpace(2, 40_000)
    assert len(space) > 1e9
    tracemalloc.start()
    draws = Draws(len(space), np.random.default_rng(0))
    indices = draws.take(10_000)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(set(indices.tolist())) == 10_000
    assert peak < 8e6
    # the mean of uniform draws, within 5 standard errors
    assert abs(float(indices.double().mean()) / len(space) - 0.5) < 5 / np.sqrt(12 * 10_000)


def test_in_order():
    order = InOrder(5)
    assert [order.take(3).tolist(), order.take(3).tolist(), order.take(3).tolist()] == [[0, 1, 2], [3, 4], []]
    assert order.left == 0


def test_in_order_after_some_that_come_first():
    order, taken = InOrder(6, torch.tensor([1, 4])), []
    while order.left > 0:
        taken.append(order.take(3).tolist())
    assert taken == [[1, 4], [0, 2, 3], [5]]
    assert [InOrder(6, torch.tensor([1, 4])).take(1).tolist(), InOrder(0).take(3).tolist()] == [[1], []]


@given(num_modes=st.integers(1, 4), horizon=st.integers(1, 12), n=st.integers(1, 40), seed=st.integers(0, 99))
def test_tails_first_takes_every_switch_once_and_the_tails_before_the_rest(num_modes, horizon, n, seed):
    space = SwitchSpace(num_modes, horizon)
    draws, taken = TailsFirst(space, np.random.default_rng(seed)), []
    while draws.left > 0:
        taken += draws.take(n).tolist()
    assert sorted(taken) == list(range(len(space)))
    assert all(space[i].stop == horizon for i in taken[: num_modes * horizon])


@given(num_modes=st.integers(1, 4), horizon=st.integers(2, 30), n=st.integers(1, 9), first=st.integers(0, 99))
def test_searches_in_a_row_come_to_every_handover_before_they_come_to_one_again(num_modes, horizon, n, first):
    """A handover is a mode and the control step at which it takes over for good, modulo the horizon."""
    space = SwitchSpace(num_modes, horizon)
    size = num_modes * horizon
    seen = []
    for k in range(first, first + size // n):
        taken = TailsFirst(space, np.random.default_rng(k), k, k * n).take(n).tolist()
        seen += [(space[i].mode, (k + space[i].start) % horizon) for i in taken]
    assert len(seen) == len(set(seen)) == size - size % n


def test_tails_are_spread_over_the_horizon():
    """Any 20 in a row leave no gap longer than a fifth of the horizon, and no mode less than a quarter."""
    space = SwitchSpace(3, 75)
    order = list(tails(space, 0, 0))
    for i in range(0, len(order) - 20, 20):
        moments = sorted(tail.start for tail in order[i : i + 20])
        assert max(b - a for a, b in pairwise([0, *moments, 75])) <= 15
        assert min(sum(tail.mode == m for tail in order[i : i + 20]) for m in range(3)) >= 5
