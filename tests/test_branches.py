"""The tree of schedules that begin alike, against sets of prefixes."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc.branches import branches, in_order


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
    every = {tuple(branch[:i]) for branch in rows for i in range(horizon + 1)}
    assert every <= seen


def test_neighbours_in_order_share_most():
    rows = torch.tensor([[1, 0, 0], [0, 1, 1], [1, 0, 1], [0, 1, 0], [2, 2, 2]]).numpy()
    assert in_order(rows, [1, 0, 1]).tolist() == [2, 0, 1, 3, 4]
