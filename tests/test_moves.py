"""Two switches at once: moves of a schedule's stretches, hand-overs by way of a third mode."""

from __future__ import annotations

from itertools import pairwise
from unittest import mock

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from hmc import Cost, ModeSet, Schedule, SwitchSpace, Task, plan
from hmc.moves import SHIFTS, handovers, moves
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state
from tests.toy import Push, ToySim

ALL = 10_000
NAMES = ("a", "b", "c")


def stitched(schedule: Schedule, switches) -> Schedule:
    for switch in switches:
        schedule = schedule.stitch(switch)
    return schedule


def bounds(modes) -> list[int]:
    """Where the mode changes."""
    return [i + 1 for i, (a, b) in enumerate(pairwise(modes)) if a != b]


def order(modes) -> list[int]:
    """The modes one after the other, however long each runs."""
    return [modes[0], *(b for a, b in pairwise(modes) if a != b)]


def by_hand(modes: tuple[int, ...]) -> set[tuple[int, ...]]:
    """All schedules in which one bound, or both bounds of a stretch, have moved by one of SHIFTS."""
    at, names, found = bounds(modes), order(modes), set()
    for size in (*SHIFTS, *(-size for size in SHIFTS)):
        for which in [(i,) for i in range(len(at))] + list(pairwise(range(len(at)))):
            moved = [value + size * (i in which) for i, value in enumerate(at)]
            whole = [0, *moved, len(modes)]
            lengths = [b - a for a, b in pairwise(whole)]
            if min(lengths[1:]) < 1 or lengths[0] < 0:
                continue
            found.add(tuple(m for m, length in zip(names, lengths, strict=True) for _ in range(length)))
    return found


@given(st.lists(st.integers(0, 2), min_size=2, max_size=30).map(tuple))
def test_moves_are_all_that_move_one_or_two_bounds(modes):
    schedule = Schedule(modes, NAMES)
    tried = [stitched(schedule, each).modes for each in moves(schedule, np.random.default_rng(0), ALL)]
    assert set(tried) == by_hand(modes)
    assert len(tried) == len(set(tried))
    assert schedule.modes not in tried


def test_a_stretch_moves_as_a_whole():
    schedule = Schedule((0,) * 10 + (1,) * 3 + (2,) * 7, NAMES)
    tried = {stitched(schedule, each).modes for each in moves(schedule, np.random.default_rng(0), ALL)}
    assert (0,) * 12 + (1,) * 3 + (2,) * 5 in tried
    assert (0,) * 2 + (1,) * 3 + (2,) * 15 in tried
    assert (0,) * 10 + (1,) * 7 + (2,) * 3 in tried
    assert (0,) * 9 + (1,) * 4 + (2,) * 7 in tried


def test_the_pick_is_random_and_no_more_than_asked_for():
    schedule = Schedule((0,) * 30 + (1,) * 10 + (2,) * 30, NAMES)
    picks = [moves(schedule, np.random.default_rng(seed), 3) for seed in range(30)]
    assert {len(pick) for pick in picks} == {3}
    assert len({str(pick) for pick in picks}) > 20
    assert moves(schedule, np.random.default_rng(0), 0) == []
    assert moves(Schedule((1,) * 9, NAMES), np.random.default_rng(0), 5) == []


def test_hand_overs_lead_on_to_a_third_mode():
    space = SwitchSpace(3, 12)
    found = handovers(space, 0, 0, ALL)
    assert len(found) > 0
    for first, then in found:
        assert first.start + first.duration == then.start + then.duration == 12
        assert first.start < then.start
        assert first.mode != then.mode
    assert handovers(space, 0, 0, 2) == found[:2]
    assert handovers(SwitchSpace(3, 1), 0, 0, 2) == []


class Counter(ToySim):
    """x is the sum of the inputs."""

    nx, dt = 1, 1.0

    def x(self, ids=None):
        return self.rows[self._at(ids), :1].clone()

    def reset(self, x, u, ids=None):
        self.rows[self._at(ids)] = torch.cat([x, u, u, u], dim=1)

    def step(self, u, ids=None):
        self.reset(self.x(ids) + u, u, ids)

    def u(self, ids=None):
        return self.rows[self._at(ids), 1:2].clone()


def test_a_move_gets_past_what_no_single_switch_improves():
    """Exactly three steps of pushing are wanted, the later the better; more or fewer cost more."""
    early = torch.arange(10).flip(0).double()
    cost = Cost(
        stage={"early": lambda x, u, u_prev, k: 0.01 * early[k] * u[:, 0]},
        terminal={"count": lambda x, k: (x[:, 0] - 3.0).square()},
        nonnegative=True,
    )
    modes = ModeSet([Push(0.0), Push(1.0)])
    task = Task("count", modes, cost, 10, Counter)
    start = [0] * 2 + [1] * 3 + [0] * 5
    stuck = plan(task, [0.0], schedule=start, solver="exhaustive")
    assert stuck.locally_optimal
    assert stuck.schedule.modes == tuple(start)
    freed = plan(task, [0.0], schedule=start, samples=20, moves=40)
    assert freed.schedule.modes == (0,) * 6 + (1,) * 3 + (0,)
    assert freed.cost < stuck.cost
    assert freed.draws > stuck.draws, "moves are paid for like other draws"


def test_each_batch_has_pairs_of_its_own():
    """Until a schedule improves, what was tried beside a batch before is not tried again."""
    asked: list[tuple[int, ...]] = []

    def noted(space: SwitchSpace, k: int, position: int, n: int):
        found = handovers(space, k, position, n)
        asked.append(tuple(hash(pair) for pair in found))
        return found

    task = cartpole(CartpoleCfg(horizon=12))
    best = plan(task, initial_state(), solver="exhaustive").schedule
    with mock.patch("hmc.solvers.handovers", noted):
        found = plan(task, initial_state(), schedule=best, samples=64, max_samples=64, pairs=4)
    assert not found.switches
    assert len(asked) >= 4
    assert len(set(asked)) == len(asked)


def test_nothing_is_tried_where_there_is_no_room():
    schedule = Schedule((0,) * 10 + (1,) * 10 + (2,) * 10, NAMES)
    assert moves(schedule, np.random.default_rng(0), 0) == []
