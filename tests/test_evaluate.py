"""Evaluating schedules: exact costs, whatever the batch; memory, divergence, pruning and repeats."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hmc.cost import Cost
from hmc.evaluate import Evaluator
from hmc.schedule import Schedule, SwitchSpace
from hmc.start import make_start
from tests.toy import COST, Bad, Damp, Push, Ramp, ToySim, all_schedules, slow_cost, toy_task

X = [0.4, -0.2]


def evaluator(task=None, num_worlds=16, x=X, **start) -> Evaluator:
    task = task or toy_task()
    sim = task.make_sim(num_worlds)
    return Evaluator(task, sim, make_start(task, sim, x, **start))


def test_cost_by_hand():
    """v += 0.1 u, p += 0.1 v from rest, all sin terms left out: J and its terms on paper."""

    class Glider(ToySim):
        dt = 0.1

        def step(self, u, ids=None):
            p, v, _, h = self.save(ids).unbind(1)
            v = v + 0.1 * u[:, 0]
            self.rows[ids] = torch.stack([p + 0.1 * v, v, u[:, 0], h], dim=1)

    cost = Cost(
        stage={
            "position": lambda x, u, u_prev, k: x[:, 0],
            "rate": lambda x, u, u_prev, k: (u - u_prev)[:, 0] ** 2,
            "clock": lambda x, u, u_prev, k: k.to(x.dtype),
        },
        terminal={"end": lambda x, k: 100 * x[:, 1] + k.to(x.dtype)},
    )
    task = toy_task(2, [Push(1.0), Push(-2.0)], cost)
    sim = Glider(3)
    rolled = Evaluator(task, sim, make_start(task, sim, [1.0, 0.0], u=[0.5], k=7))
    # x: (1, 0), after u = 1: (1.01, 0.1), after u = -2: (1.0, -0.1)
    terms = {"position": (1 + 1.01) * 0.1, "rate": (0.25 + 9) * 0.1, "clock": (7 + 8) * 0.1, "end": -10 + 9}
    schedule = Schedule((0, 1))
    assert rolled.terms(schedule) == pytest.approx(terms, abs=1e-12)
    assert rolled.cost(schedule) == pytest.approx(sum(terms.values()), abs=1e-12)


@pytest.mark.parametrize("start", [{}, {"u": [0.7], "mode": 2, "memory": [2.0, 0.3, -0.5, 3.0], "k": 5}])
def test_costs_are_those_of_the_definition(start):
    task = toy_task(4)
    rows = all_schedules(3, 4)
    costs = evaluator(task, **start).costs(rows)
    slow = [slow_cost(task, row.tolist(), X, **start) for row in rows]
    assert costs.tolist() == slow


@pytest.mark.parametrize("num_worlds", [1, 2, 3, 7, 64, 1000])
def test_a_cost_does_not_depend_on_chunk_or_company(num_worlds):
    rows = all_schedules(3, 6)
    alone = evaluator(num_worlds=1000).costs(rows)
    order = torch.randperm(len(rows))[:100]
    assert torch.equal(evaluator(num_worlds=num_worlds).costs(rows[order]), alone[order])


def test_memory_is_reset_exactly_where_the_mode_changes():
    ramp = Ramp()
    task = toy_task(6, [Push(1.0), Damp(), ramp])
    evaluator(task, k=10, u=[0.25]).cost(Schedule((2, 2, 0, 2, 2, 2)))
    assert [k for k, _, _ in ramp.entries] == [10, 13]
    assert ramp.entries[0] == (10, 0.4, 0.25)
    assert ramp.entries[1][2] == 1.0, "entry must see the input of the mode that ran before"


def test_a_running_mode_goes_on_with_its_memory():
    ramp = Ramp()
    task = toy_task(6, [Push(1.0), Damp(), ramp])
    running = {"mode": "ramp", "memory": [4.0, 0.1, 0.2, 6.0], "k": 10}
    evaluator(task, **running).cost(Schedule((2, 2, 2, 0, 0, 2)))
    assert [k for k, _, _ in ramp.entries] == [15]
    ramp.entries.clear()
    evaluator(task, **running).cost(Schedule((0, 2, 2, 2, 2, 2)))
    assert [k for k, _, _ in ramp.entries] == [11], "left at the first step, its memory is gone"


def test_one_batched_call_a_mode_a_step():
    calls = []

    class Counted(Damp):
        def act(self, x, u, memory, k):
            calls.append((int(k[0]), len(x)))
            return super().act(x, u, memory, k)

    task = toy_task(3, [Push(1.0), Counted()])
    evaluator(task).costs(torch.tensor([[1, 0, 1], [1, 0, 1], [1, 1, 0], [0, 1, 1], [0, 1, 0], [0, 0, 0]]))
    assert calls == [(0, 1), (1, 2), (2, 2)], "equal schedules and equal beginnings are one world"


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_bad_action_costs_inf_and_disturbs_nobody(value, cheap):
    good = evaluator(toy_task(6, [Push(1.0), Damp(), Push(0.5)]))
    bad = evaluator(toy_task(6, [Push(1.0), Damp(), Bad(after=3, value=value)], cheap=cheap))
    rows = all_schedules(3, 6)
    hit = (rows[:, 3:] == 2).any(1)
    costs = bad.costs(rows)
    assert bool(costs[hit].isinf().all())
    assert torch.equal(costs[~hit], good.costs(rows)[~hit])
    assert bad.diverged == int(hit.sum())
    assert bad.rollouts == len(rows)


def test_a_diverged_world_is_not_stepped_any_more():
    task = toy_task(6, [Push(0.0), Push(50.0)], blow_up=1.5)
    sim = ToySim(4, blow_up=1.5)
    task_evaluator = Evaluator(task, sim, make_start(task, sim, X))
    rows = torch.tensor([[0] * 6, [1] * 6, [0, 1, 1, 1, 1, 1]])
    costs = task_evaluator.costs(rows)
    assert costs.isinf().tolist() == [False, True, True]
    assert task_evaluator.diverged == 2
    steps = sorted(sum(world in ids for ids in sim.stepped) for world in range(3))
    assert steps == [1, 1, 6], "each until its state stops being finite"
    assert task_evaluator.control_steps == sum(steps)
    assert all(math.isnan(v) for v in task_evaluator.terms(Schedule((1,) * 6)).values())


@pytest.mark.parametrize("where", ["stage", "terminal"])
def test_a_bad_cost_is_a_diverged_world(where):
    def spoilt(x, *rest):
        return torch.where(x[:, 0] > 0.5, math.nan, x[:, 0])

    stage = {"a": lambda x, u, u_prev, k: x[:, 0] ** 2, **({"s": spoilt} if where == "stage" else {})}
    terminal = {"b": lambda x, k: x[:, 1], **({"t": spoilt} if where == "terminal" else {})}
    rolled = evaluator(toy_task(6, [Push(-1.0), Push(5.0)], Cost(stage, terminal)))
    assert rolled.costs(torch.tensor([[0] * 6, [1] * 6])).isinf().tolist() == [False, True]
    assert rolled.diverged == 1


def test_an_overflowing_cost_is_diverged_not_pruned():
    stage = {"a": lambda x, u, u_prev, k: torch.where(u[:, 0] > 2, math.inf, 1.0)}
    rolled = evaluator(toy_task(6, [Push(0.0), Push(5.0)], Cost(stage, nonnegative=True)))
    assert rolled.costs(torch.tensor([[0] * 6, [1] * 6]), bound=100.0).isinf().tolist() == [False, True]
    assert (rolled.diverged, rolled.pruned) == (1, 0)


def next_step(x: Tensor, k: Tensor, steps: int) -> Tensor:
    """What the next step costs by its state alone: often all that it costs, to the last bit or one beside."""
    position, velocity = (COST.stage[name](x, x, x, k) for name in ("position", "velocity"))
    return 0.5 * (position + velocity)


@settings(max_examples=60)
@given(
    rank=st.integers(0, 80),
    x=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    num_worlds=st.integers(8, 100),
    looks_ahead=st.booleans(),
    cheap=st.booleans(),
)
def test_pruning_is_exact_up_to_the_bound(rank, x, num_worlds, looks_ahead, cheap):
    rows = all_schedules(3, 4)
    plain = evaluator(toy_task(4), 81, x).costs(rows)
    bound = float(plain.sort().values[rank])
    task = replace(toy_task(4, cheap=cheap), lower_bound=next_step if looks_ahead else None)
    pruning = evaluator(task, num_worlds, x)
    costs = pruning.costs(rows, bound)
    assert torch.equal(costs[plain <= bound], plain[plain <= bound])
    assert bool((costs[plain > bound] > bound).all())
    assert pruning.diverged == 0
    assert torch.equal(pruning.costs(rows), plain), "asked again without a bound, all is exact"


def test_pruning_saves_steps_and_only_where_terms_are_nonnegative():
    rows = all_schedules(3, 6)
    plain = evaluator()
    low = float(plain.costs(rows).min()) / 4
    pruning = evaluator()
    assert bool(pruning.costs(rows, low).isinf().all())
    assert pruning.pruned == len(rows)
    assert pruning.control_steps < 0.6 * plain.control_steps
    signed = evaluator(toy_task(6, cost=Cost(plain.task.cost.stage, plain.task.cost.terminal)))
    assert torch.equal(signed.costs(rows, low), plain.costs(rows))
    assert signed.control_steps == plain.control_steps


def test_equal_schedules_are_rolled_out_once():
    rolled = evaluator()
    rows = torch.tensor([[0, 1, 2, 0, 1, 2], [1] * 6, [0, 1, 2, 0, 1, 2]])
    costs = rolled.costs(rows)
    assert costs[0] == costs[2]
    assert (rolled.rollouts, rolled.control_steps) == (2, 12)
    assert torch.equal(rolled.costs(rows.flip(0)), costs.flip(0))
    assert (rolled.rollouts, rolled.control_steps) == (2, 12)


def prefixes(rows: torch.Tensor) -> set[tuple[int, ...]]:
    """Every beginning of every schedule."""
    return {tuple(row[: i + 1]) for row in rows.tolist() for i in range(len(row))}


def test_every_beginning_is_rolled_out_once():
    rolled = evaluator(num_worlds=1000)
    rows = all_schedules(3, 6)
    rolled.costs(rows)
    assert rolled.control_steps == sum(3**i for i in range(1, 7))
    again = evaluator(num_worlds=1000)
    again.follow(Schedule((0, 1, 2, 2, 1, 0)))
    assert again.control_steps == 6
    again.costs(
        torch.tensor([[0, 1, 2, 2, 1, 1], [0, 1, 0, 0, 0, 0], [0, 1, 0, 0, 1, 0], [1, 1, 2, 2, 1, 0]])
    )
    assert again.control_steps == 6 + 1 + (4 + 2) + 6


def test_all_of_omega_takes_a_quarter_of_the_control_steps():
    """The figure of docs/planner.md: T = 50, M = 3, nothing pruned, everything in one batch."""
    task, space = toy_task(50, cost=Cost(COST.stage, COST.terminal)), SwitchSpace(3, 50)
    rolled = evaluator(task, num_worlds=len(space))
    incumbent = Schedule.constant(0, 50)
    rolled.follow(incumbent)
    rolled.costs(space.stitch(incumbent, torch.arange(len(space))))
    assert 0.2 < rolled.control_steps / (50 * len(space)) < 0.25


@settings(max_examples=80)
@given(
    rows=st.lists(st.lists(st.integers(0, 2), min_size=5, max_size=5), min_size=1, max_size=30),
    trunk=st.lists(st.integers(0, 2), min_size=5, max_size=5),
    num_worlds=st.sampled_from([1, 2, 5, 64]),
    bounded=st.booleans(),
    cheap=st.booleans(),
)
def test_shared_beginnings_change_no_cost(rows, trunk, num_worlds, bounded, cheap):
    """Whatever was followed and in how many worlds: bit for bit the cost of a rollout by itself."""
    task = toy_task(5, hidden=0.4, cheap=cheap)
    start = {"u": [0.7], "mode": 2, "memory": [2.0, 0.3, -0.5, 3.0], "k": 5}
    rolled = evaluator(task, num_worlds, **start)
    assert rolled.follow(Schedule(tuple(trunk))) == slow_cost(task, trunk, X, **start)
    rows = torch.tensor(rows)
    slow = torch.tensor([slow_cost(task, row.tolist(), X, **start) for row in rows], dtype=torch.float64)
    bound = float(slow.median()) if bounded else math.inf
    costs = rolled.costs(rows, bound)
    assert torch.equal(costs[slow <= bound], slow[slow <= bound])
    assert bool((costs[slow > bound] > bound).all())
    if not bounded and num_worlds == 64:
        assert rolled.control_steps == 5 + len(prefixes(rows) - prefixes(torch.tensor([trunk])))


@given(
    rows=st.lists(st.lists(st.integers(0, 2), min_size=5, max_size=5), min_size=1, max_size=30),
    known=st.lists(st.integers(0, 2), min_size=5, max_size=5),
    after=st.lists(st.integers(0, 2), min_size=5, max_size=5),
    num_worlds=st.sampled_from([1, 2, 5, 64]),
)
def test_what_a_batch_needs_is_known_before(rows, known, after, num_worlds):
    """Exactly where it fits into the simulator, else never more; what is recorded beside it counts."""
    rolled, rows = evaluator(toy_task(5), num_worlds), torch.tensor(rows)
    rolled.follow(Schedule(tuple(known)))
    rolled.costs(torch.tensor([after]))
    rolled.follow(Schedule(tuple(after)))
    before, needs = rolled.control_steps, rolled.needs(rows)
    assert len(needs) == len(rows)
    assert (np.diff(needs) >= 0).all()
    assert needs[-1] <= rolled.most(len(rows))
    first = len(rows) // 2
    rolled.costs(rows[:first])
    taken = rolled.control_steps - before
    rolled.costs(rows[first:])
    if num_worlds == 64 and first > 0 and taken > 0:
        assert taken == needs[first - 1]
    assert taken <= (needs[first - 1] if first > 0 else 0)


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_what_is_known_from_before_is_taken_over(steps):
    task = toy_task(6, hidden=0.4)
    whole = evaluator(task).trace(Schedule((0, 2, 2, 1, 2, 2)))
    known, start = whole.since(steps), whole.start(steps)
    fresh = Evaluator(task, task.make_sim(4), start)
    told = Evaluator(task, task.make_sim(4), start, known)
    schedule = Schedule((*known.modes, *[2] * steps))
    assert told.follow(schedule) == fresh.follow(schedule)
    assert told.control_steps == steps
    assert torch.equal(told.trunk.snapshots, fresh.trunk.snapshots)
    assert torch.equal(told.costs(all_schedules(3, 6)), fresh.costs(all_schedules(3, 6)))
    for elsewhere in (whole.start(steps + 1), whole.start(steps, exact=False)):
        other = Evaluator(task, task.make_sim(4), elsewhere, known)
        other.follow(schedule)
        met = steps == 0 and elsewhere.k == whole.k  # a fresh start has no history to differ by
        assert other.control_steps == (0 if met else 6)


def test_stopping_leaves_unknown_what_is_not_finished():
    rolled = evaluator(num_worlds=2)
    asked = iter(range(100))
    rows = torch.tensor([[0] * 6, [1] * 6, [2] * 6, [0, 1, 0, 1, 0, 1], [1] * 6])
    costs = rolled.costs(rows, stop=lambda: next(asked) >= 8)
    assert costs.isnan().tolist() == [False, True, True, False, True], "in pairs that begin alike"
    whole = rolled.costs(rows)
    assert torch.equal(whole[[0, 3]], costs[[0, 3]])


def test_a_mode_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="modes 0 to 3: task 'toy' has 0 to 2"):
        evaluator().costs(torch.tensor([[0, 1, 2, 3, 0, 0]]))


def test_no_schedules_no_costs():
    assert evaluator().costs(torch.empty(0, 6, dtype=torch.long)).tolist() == []


@pytest.mark.parametrize("exact", [True, False])
@given(
    row=st.lists(st.integers(0, 2), min_size=6, max_size=6),
    i=st.integers(0, 5),
    strength=st.sampled_from([0.0, 0.4]),
)
def test_a_trace_goes_on_from_any_step(exact, row, i, strength):
    """Re-planning from step i continues the trajectory bit for bit, if nothing is hidden or it is known."""
    task = toy_task(6, hidden=strength)
    rolled = evaluator(task, u=[0.3], k=4)
    whole = rolled.trace(Schedule(tuple(row)))
    assert whole.cost == rolled.cost(Schedule(tuple(row)))
    assert float(whole.stage.sum() + whole.terminal.sum()) == pytest.approx(whole.cost, rel=1e-12)
    tail = Schedule(tuple(row[i:]) + (row[-1],) * i)
    rest = Evaluator(task, task.make_sim(3), whole.start(i, exact=exact)).trace(tail)
    assert rest.k == 4 + i
    n = 7 - i
    same = torch.equal(rest.x[:n], whole.x[i:]) and torch.equal(rest.u[:n], whole.u[i:])
    if exact or strength == 0.0:
        assert same
        assert torch.equal(rest.memory[:n], whole.memory[i:])
        assert torch.equal(rest.snapshots[:n], whole.snapshots[i:]) or not exact
        assert torch.equal(rest.stage[: n - 1], whole.stage[i:])
    elif 1 <= i <= 4:
        assert not same, "the hidden input was to matter"


@given(
    rows=st.lists(st.lists(st.integers(0, 2), min_size=6, max_size=6), min_size=1, max_size=9),
    trunk=st.lists(st.integers(0, 2), min_size=6, max_size=6),
    pick=st.integers(0, 8),
    bound=st.sampled_from([math.inf, 4.0]),
    cheap=st.booleans(),
)
def test_a_schedule_of_the_last_batch_was_recorded_with_it(rows, trunk, pick, bound, cheap):
    """To follow it takes no control step more, and its trace is that of a rollout of its own."""
    rolled, alone = evaluator(toy_task(6, cheap=cheap)), evaluator(toy_task(6))
    rolled.follow(Schedule(tuple(trunk)))
    chosen = Schedule(tuple(rows[pick % len(rows)]))
    cost = float(rolled.costs(torch.tensor(rows), bound)[pick % len(rows)])
    before = rolled.control_steps
    assert rolled.follow(chosen) == alone.follow(chosen)
    if cost < math.inf:
        assert rolled.control_steps == before
        assert rolled.pending == 0
    rolled.record()
    for part in ("x", "u", "memory", "mode", "snapshots", "stage", "terminal"):
        assert torch.equal(getattr(rolled.trunk, part), getattr(alone.trunk, part)), part
    assert rolled.trunk.modes == chosen.modes


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize("bound", [math.inf, 0.1, 3.0])
def test_among_many_the_schedule_followed_is_recorded(bound, cheap):
    """Too many to record them all: the one that is followed goes on, wherever it is among them."""
    rows, rolled, alone = (
        all_schedules(3, 5),
        evaluator(toy_task(5, cheap=cheap), 300),
        evaluator(toy_task(5)),
    )
    rolled.follow(Schedule((0, 1, 0, 0, 0)))
    rolled.costs(rows[::2])
    for modes in ((2, 1, 1, 0, 2), (0, 1, 2, 2, 0), (0, 0, 0, 0, 2)):
        assert rolled.follow(Schedule(modes)) == alone.follow(Schedule(modes))
        rolled.costs(rows if bound == math.inf else rows[1::2], bound)
        rolled.record()
        for part in ("x", "u", "memory", "mode", "snapshots", "stage", "terminal"):
            assert torch.equal(getattr(rolled.trunk, part), getattr(alone.trunk, part)), part


def test_a_trace_of_a_diverging_schedule_ends_there():
    whole = evaluator(toy_task(6, [Push(0.0), Push(50.0)], blow_up=1.5)).trace(Schedule((1,) * 6))
    assert whole.cost == math.inf
    assert len(whole.x) == len(whole.stage) + 1 < 7
    assert not whole.x[-1].isfinite().all()
    assert whole.x[:-1].isfinite().all()
