"""The tree of schedules that begin alike, against sets of prefixes."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc import Schedule, SwitchSpace
from hmc.branches import added_steps, branches, fan, in_order


@given(data=st.data(), modes=st.integers(1, 300), horizon=st.integers(1, 8), n=st.integers(1, 40))
def test_branches_are_the_prefix_tree(data, modes, horizon, n):
    mode = st.integers(0, modes - 1)
    row = st.lists(mode, min_size=horizon, max_size=horizon)
    rows = data.draw(st.lists(row, min_size=n, max_size=n))
    trunk = data.draw(st.lists(mode, max_size=horizon))
    tree = branches(torch.tensor(rows), trunk)
    assert sorted(tree.row.tolist()) == list(range(n))
    assert tree.modes.tolist() == [rows[i] for i in tree.row.tolist()]
    assert (tree.born[0], tree.born[-1], len(tree.born)) == (0, n, horizon + 2)
    seen = {tuple(trunk[:i]) for i in range(len(trunk) + 1)}
    birth = [next(i for i in range(horizon + 1) if tree.born[i + 1] > j) for j in range(n)]
    for j, (branch, parent) in enumerate(zip(tree.modes.tolist(), tree.parent.tolist(), strict=True)):
        stem = trunk if parent < 0 else tree.modes[parent].tolist()
        assert branch[: birth[j]] == stem[: birth[j]]
        assert parent < j
        assert parent < 0 or birth[parent] < birth[j], "there before, so that it can be copied"
        new = {tuple(branch[:i]) for i in range(birth[j] + 1, horizon + 1)}
        assert not new & seen, "no beginning twice"
        seen |= new
    for number, one in enumerate(rows):
        path = tree.path(number)
        assert len(path) == horizon + 1
        for i, j in enumerate(path):  # at step i it is known by its modes so far, or still the trunk
            if j >= 0:
                assert birth[j] <= i
                assert tree.modes[j].tolist()[:i] == one[:i]
            else:
                assert trunk[:i] == one[:i]
        assert tree.row[path[-1]] == number
    every = {tuple(branch[:i]) for branch in rows for i in range(horizon + 1)}
    assert every <= seen


def test_neighbours_in_order_share_most():
    rows = torch.tensor([[1, 0, 0], [0, 1, 1], [1, 0, 1], [0, 1, 0], [2, 2, 2]])
    assert in_order(rows, [1, 0, 1]).tolist() == [2, 0, 1, 3, 4]


def test_small_types_are_as_good():
    """T and M + 1 are beyond what a byte holds."""
    rows = torch.randint(0, 100, (20, 200), generator=torch.Generator().manual_seed(0))
    rows[10:] = rows[:10]
    rows[10:, 150:] = 99 - rows[10:, 150:]
    trunk = rows[3].tolist()
    wide = branches(rows, trunk)
    for kind in (torch.int8, torch.uint8, torch.int16):
        small = branches(rows.to(kind), trunk)
        assert torch.equal(small.row, wide.row)
        assert torch.equal(small.modes.long(), wide.modes)
        assert (small.born, small.parent.tolist()) == (wide.born, wide.parent.tolist())
    full = torch.tensor([[255, 0], [0, 255], [255, 255]], dtype=torch.uint8)
    assert branches(full, [255, 0]).modes.tolist() == [[0, 255], [255, 255], [255, 0]]


@given(data=st.data(), modes=st.integers(1, 4), horizon=st.integers(1, 6), n=st.integers(0, 20))
def test_added_steps_are_the_new_beginnings(data, modes, horizon, n):
    mode = st.integers(0, modes - 1)
    rows = data.draw(st.lists(st.lists(mode, min_size=horizon, max_size=horizon), min_size=n, max_size=n))
    trunk = data.draw(st.lists(mode, max_size=horizon))
    added, alone = added_steps(torch.tensor(rows, dtype=torch.long).reshape(n, horizon), trunk)
    lead = {tuple(trunk[: i + 1]) for i in range(len(trunk))}
    seen = set(lead)
    for row, more, by_itself in zip(rows, added.tolist(), alone.tolist(), strict=True):
        beginnings = {tuple(row[: i + 1]) for i in range(horizon)}
        assert more == len(beginnings - seen)
        assert by_itself == len(beginnings - lead)
        seen |= beginnings


@given(data=st.data(), modes=st.integers(1, 4), horizon=st.integers(1, 8))
def test_a_fan_is_the_tree_of_its_schedules(data, modes, horizon):
    """In closed form: the same beginnings, born when their stems are there, as of the schedules spelt out."""
    mode = st.integers(0, modes - 1)
    base = data.draw(st.lists(mode, min_size=horizon, max_size=horizon))
    known, beside = data.draw(st.lists(mode, max_size=horizon)), data.draw(st.booleans())
    agree = data.draw(st.integers(0, horizon))
    trunk = (base[:agree] + known[agree:]) if beside else base
    space = SwitchSpace(modes, horizon)
    drawn = data.draw(st.lists(st.integers(0, len(space) - 1), min_size=1, max_size=40))
    switched = space.neighbours(Schedule(tuple(base)), torch.tensor(drawn))
    rows = switched.tensor()
    names = list(zip(switched.mode.tolist(), switched.start.tolist(), switched.stop.tolist(), strict=True))
    assert len(set(names)) == len(rows.unique(dim=0)), "equal if and only if the schedules are"
    each = [i for i, name in enumerate(names) if name not in names[:i]]
    if beside:
        each = [i for i in each if rows[i].tolist() != base]
    if not each:
        return
    switched, rows = switched[np.array(each)], rows[each]
    if beside:
        rows = torch.cat([torch.tensor([base], dtype=rows.dtype), rows])
    tree = fan(switched, trunk, beside)
    assert sorted(tree.row.tolist()) == list(range(len(rows)))
    assert torch.equal(tree.modes, rows[tree.row])
    birth = np.searchsorted(tree.born[1:], np.arange(len(rows)), "right")
    for j, (branch, parent) in enumerate(zip(tree.modes.tolist(), tree.parent.tolist(), strict=True)):
        stem = trunk if parent < 0 else tree.modes[parent].tolist()
        assert branch[: birth[j]] == stem[: birth[j]]
        assert parent < 0 or birth[parent] < birth[j]
        assert (parent < 0) == (j - tree.born[birth[j]] < tree.seeds[birth[j]])
    new = {tuple(row[: i + 1]) for row in rows.tolist() for i in range(horizon)}
    new -= {tuple(trunk[: i + 1]) for i in range(len(trunk))}
    assert horizon * len(rows) - int(birth.sum()) == len(new), "no beginning twice"
