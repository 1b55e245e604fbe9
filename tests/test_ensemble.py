"""Robust planning: risks by hand, members as if each were alone, what ends together, plans that differ."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Budget, Cost, Ensemble, Evaluator, Receding, Rules, Schedule, Start, Task, make_start, plan
from hmc.rollout import Rolled, roll
from hmc.sim.mixed import Mixed
from hmc.trace import SITUATION, roots
from hmc.worlds import Worlds
from tests.test_evaluate import next_step
from tests.toy import COST, Bad, Push, ToySim, all_schedules, slow_cost, toy_task

HIDDEN = (0.0, 0.4, -0.3)
X = [0.4, -0.2]
RUNNING = {"u": [0.7], "mode": 2, "memory": [2.0, 0.3, -0.5, 3.0], "k": 5}
STEPS = st.lists(st.integers(0, 2), min_size=5, max_size=5)
HOSTS = st.sampled_from(["batch", "mixed"])


def shifted(x, u):
    """The last member begins elsewhere."""
    off = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.3, -0.1]], dtype=x.dtype)
    return x + off, u.expand(3, -1)


def toys(tail: float, host: str = "batch") -> Ensemble:
    """Three toys with different hidden dynamics, in one simulator or in one of each."""
    if host == "mixed":
        return Ensemble(
            3, partial(Mixed, [partial(ToySim, hidden=h) for h in HIDDEN]), disturb=shifted, tail=tail
        )
    return Ensemble(
        3, lambda which: ToySim(len(which), [HIDDEN[e] for e in which]), disturb=shifted, tail=tail
    )


def robust(tail: float = 1.0, horizon: int = 4, host: str = "batch", **changed) -> Task:
    return replace(toy_task(horizon), ensemble=toys(tail, host), **changed)


def evaluator(task: Task, num_worlds=81, x=X, **start) -> Evaluator:
    sim = task.make_sim(num_worlds)
    return Evaluator(task, sim, make_start(task, sim, x, **start))


def alone(task: Task, start: Start, num_worlds=64) -> list[Evaluator]:
    """Each member by itself, in a simulator of its own."""
    assert task.ensemble is not None
    return [
        Evaluator(replace(task, ensemble=None), ToySim(num_worlds, hidden=h), begin)
        for h, begin in zip(HIDDEN, task.ensemble.starts(start), strict=True)
    ]


def by_hand(modes) -> list[float]:
    """J of one schedule on each member."""
    starts = [X, X, [X[0] + 0.3, X[1] - 0.1]]
    tasks = [toy_task(4, hidden=h) for h in HIDDEN]
    return [slow_cost(task, modes, x) for task, x in zip(tasks, starts, strict=True)]


def rolled_out(
    task: Task, rows: torch.Tensor, bound: float = math.inf, recorded=None, **start
) -> tuple[Rolled, Worlds]:
    """Schedules (n, T) rolled out from nothing known."""
    assert task.ensemble is not None
    worlds = Worlds(task, task.ensemble.sim(len(rows) + 1))
    begin = task.ensemble.starts(make_start(task, worlds.sim, X, **start))
    with torch.no_grad():
        rolled = roll(worlds, roots(worlds, begin), rows, bound, recorded=recorded)
    assert rolled is not None
    return rolled, worlds


@pytest.mark.parametrize(
    ("tail", "risk"),
    [(1.0, 2.5), (0.0, 4.0), (0.25, 4.0), (0.5, 3.5), (0.375, (4 + 0.5 * 3) / 1.5), (0.75, 3.0)],
)
def test_risk_by_hand(tail, risk):
    ensemble = Ensemble(4, ToySim, tail=tail)
    costs = torch.tensor([[1.0, 4.0, 2.0, 3.0], [8.0, 4.0, 6.0, 2.0]], dtype=torch.float64)
    assert ensemble.risk(costs).tolist() == pytest.approx([risk, 2 * risk])
    halves = torch.stack([0.25 * costs, 0.75 * costs], 2)
    terms = ensemble.terms(halves)
    assert terms.flatten().tolist() == pytest.approx([risk / 4, 3 * risk / 4, risk / 2, 3 * risk / 2])


@given(
    costs=st.lists(st.floats(0, 1e9), min_size=5, max_size=5),
    more=st.lists(st.floats(0, 1e3), min_size=5, max_size=5),
    tail=st.floats(0, 1),
)
@settings(max_examples=300)
def test_a_risk_never_falls_when_a_cost_rises(costs, more, tail):
    """To the last bit: else what is pruned by a partial risk might have come out below the bound."""
    before = torch.tensor([costs], dtype=torch.float64)
    after = before + torch.tensor([more], dtype=torch.float64)
    ensemble = Ensemble(5, ToySim, tail=tail)
    assert float(ensemble.risk(before)[0]) <= float(ensemble.risk(after)[0])
    assert float(ensemble.risk(before.flip(1))[0]) == float(ensemble.risk(before)[0])


def test_one_world_that_breaks_is_an_infinite_risk_however_many_do_not():
    costs = torch.tensor([[1.0, math.inf], [1.0, 2.0]], dtype=torch.float64)
    for tail in (0.0, 0.7, 1.0):
        assert Ensemble(2, ToySim, tail=tail).risk(costs).isinf().tolist() == [True, False]


@pytest.mark.parametrize("host", ["batch", "mixed"])
@pytest.mark.parametrize("tail", [0.0, 0.5, 1.0])
def test_costs_are_risks_of_the_members_costs(tail, host):
    rows = all_schedules(3, 4)[::5]
    task = robust(tail, host=host)
    ours = evaluator(task)
    costs = ours.costs(rows)
    expected = torch.tensor([by_hand(row) for row in rows.tolist()], dtype=torch.float64)
    assert task.ensemble is not None
    assert torch.equal(costs, task.ensemble.risk(expected))
    assert ours.rollouts == len(rows)
    for row in rows[:3]:
        schedule = Schedule(tuple(row.tolist()))
        cost = evaluator(task).follow(schedule)
        assert cost == float(ours.costs(row[None])[0])
        assert sum(ours.terms(schedule).values()) == pytest.approx(cost, rel=1e-12)
    assert torch.equal(evaluator(task, num_worlds=7).costs(rows), costs)


@given(
    rows=st.lists(STEPS, min_size=1, max_size=20),
    trunk=STEPS,
    after=STEPS,
    num_worlds=st.sampled_from([1, 2, 5, 64]),
    tail=st.sampled_from([0.0, 0.5, 1.0]),
    bounded=st.booleans(),
    host=HOSTS,
)
@settings(max_examples=60)
def test_members_are_as_if_each_were_alone(rows, trunk, after, num_worlds, tail, bounded, host):
    """Bit for bit, whatever was followed before, with memory, and in parts that fit into the simulator."""
    task = robust(tail, 5, host)
    ours = evaluator(task, num_worlds, **RUNNING)
    each = alone(task, ours.start)
    assert task.ensemble is not None
    risk = task.ensemble.risk

    def expected(some):
        return risk(torch.stack([member.costs(some) for member in each], 1))

    rows = torch.tensor(rows)
    for schedule in (trunk, after):
        assert ours.follow(Schedule(tuple(schedule))) == float(expected(torch.tensor([schedule]))[0])
        plain = expected(rows)
        bound = float(plain.median()) if bounded else math.inf
        costs = ours.costs(rows, bound)
        assert torch.equal(costs[plain <= bound], plain[plain <= bound])
        assert bool((costs[plain > bound] > bound).all())
    assert ours.trunk.x.shape[1:] == (2,)


@given(rows=st.lists(STEPS, min_size=1, max_size=9, unique_by=tuple), host=HOSTS)
def test_what_is_recorded_of_each_member_is_its_own_trajectory(rows, host):
    task = robust(horizon=5, host=host)
    rolled, worlds = rolled_out(task, torch.tensor(rows), **RUNNING)
    each = alone(task, make_start(task, worlds.sim, X, **RUNNING))
    assert rolled.traces is not None
    for i, row in enumerate(rows):
        for trace, member in zip(rolled.traces(i), each, strict=True):
            own = member.trace(Schedule(tuple(row)))
            assert trace.cost == own.cost == member.cost(Schedule(tuple(row)))
            for part in (*SITUATION, "stage", "terminal"):
                assert torch.equal(getattr(trace, part), getattr(own, part)), part


def test_of_many_schedules_one_is_recorded_on_each_member():
    task, one = robust(horizon=5), (0, 2, 2, 1, 2)
    rows = all_schedules(3, 5)
    rolled, worlds = rolled_out(task, rows, bound=0.1, recorded=one, **RUNNING)
    assert rolled.traces is None
    assert rolled.trace is not None
    assert int(rolled.pruned.sum()) > 200, "what is recorded goes on whatever the bound"
    for trace, member in zip(
        rolled.trace, alone(task, make_start(task, worlds.sim, X, **RUNNING)), strict=True
    ):
        own = member.trace(Schedule(one))
        for part in (*SITUATION, "stage", "terminal"):
            assert torch.equal(getattr(trace, part), getattr(own, part)), part


@given(
    tail=st.floats(0, 1), rank=st.integers(0, 80), num_worlds=st.integers(1, 90), looks_ahead=st.booleans()
)
@settings(max_examples=40)
def test_pruning_is_exact_up_to_the_bound(tail, rank, num_worlds, looks_ahead):
    rows = all_schedules(3, 4)
    plain = evaluator(robust(tail)).costs(rows)
    bound = float(plain.sort().values[rank])
    pruning = evaluator(robust(tail, lower_bound=next_step if looks_ahead else None), num_worlds)
    costs = pruning.costs(rows, bound)
    assert torch.equal(costs[plain <= bound], plain[plain <= bound])
    assert bool((costs[plain > bound] > bound).all())
    assert torch.equal(pruning.costs(rows), plain), "asked again without a bound, all is exact"


@given(row=STEPS, tail=st.floats(0, 1), share=st.floats(0, 1.1))
def test_all_members_end_where_the_partial_risk_exceeds_the_bound(row, tail, share):
    """Not one control step later, on none of them: counted for a schedule by itself."""
    task = robust(tail, 5, lower_bound=lambda x, k, steps: torch.zeros(len(x), dtype=x.dtype))
    assert task.ensemble is not None
    each = alone(task, make_start(task, ToySim(1), X))
    sums = torch.stack([member.trace(Schedule(tuple(row))).sums.sum(1) for member in each], 1)
    partial_risks = task.ensemble.risk(sums)  # on arrival at each step
    bound = share * float(partial_risks[-1])
    rolled, worlds = rolled_out(task, torch.tensor([row]), bound)
    beyond = (partial_risks > bound * (1 + 1e-12)).nonzero()
    assert bool(rolled.pruned[0]) == (len(beyond) > 0) or share > 0.99
    if len(beyond) > 0:
        # what the step costs is known before it is made
        assert worlds.own_steps == 3 * (int(beyond[0]) - 1)


@given(
    rows=st.lists(STEPS, min_size=1, max_size=30),
    known=STEPS,
    after=STEPS,
    num_worlds=st.sampled_from([1, 2, 5, 64]),
)
def test_what_a_batch_needs_is_known_before(rows, known, after, num_worlds):
    ours, rows = evaluator(robust(horizon=5), num_worlds), torch.tensor(rows)
    ours.follow(Schedule(tuple(known)))
    ours.costs(torch.tensor([after]))
    ours.follow(Schedule(tuple(after)))
    before, needs = ours.control_steps, ours.needs(rows)
    assert (np.diff(needs) >= 0).all()
    assert needs[-1] <= ours.most(len(rows))
    ours.costs(rows)
    taken = ours.control_steps - before
    assert taken == needs[-1] if num_worlds == 64 and taken > 0 else taken <= needs[-1]


@pytest.mark.parametrize("host", ["batch", "mixed"])
def test_a_member_that_breaks_ends_the_others(host):
    """The second toy leaves its safe range with the first step of the bold mode: nobody makes another."""
    edges = (math.inf, 1.0)
    ensemble = Ensemble(2, lambda which: ToySim(len(which), blow_up=[edges[e] for e in which]))
    if host == "mixed":
        ensemble = Ensemble(2, partial(Mixed, [partial(ToySim, blow_up=edge) for edge in edges]))
    task = replace(toy_task(6, [Push(0.0), Push(5.0)]), ensemble=ensemble)
    ours = evaluator(task)
    costs = ours.costs(torch.tensor([[0] * 6, [0, 1, 1, 1, 1, 1], [0, 1, 0, 0, 0, 0]]))
    assert costs.isinf().tolist() == [False, True, True]
    assert (ours.diverged, ours.rollouts) == (2, 3)
    assert ours.control_steps == 2 * (6 + 1), "the two are one until they have ended"
    assert all(math.isnan(value) for value in ours.terms(Schedule((0, 1, 1, 1, 1, 1))).values())
    bold = evaluator(task)
    assert bold.follow(Schedule((0, 1, 1, 1, 1, 1))) == math.inf
    assert len(bold.trunk) == 2, "no trace goes on where another ended"
    assert torch.equal(bold.costs(torch.tensor([[0] * 6, [0, 1, 0, 0, 0, 0]])), costs[[0, 2]])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["stage", "terminal"])
@pytest.mark.parametrize("tail", [0.0, 1.0])
def test_a_cost_that_is_no_number_on_one_member_is_infinite(value, where, tail):
    def spoilt(x, *rest):  # where the third member begins and ends, and no other one
        return torch.where((x[:, 0] > 0.64) & (x[:, 0] < 0.75), value, 0.0).to(x)

    cost = Cost(
        {"a": lambda x, u, u_prev, k: x[:, 0] ** 2, **({"s": spoilt} if where == "stage" else {})},
        {"b": lambda x, k: x[:, 1] ** 2, **({"t": spoilt} if where == "terminal" else {})},
    )
    ours = evaluator(replace(toy_task(1, [Push(2.0)], cost), ensemble=toys(tail)), 4)
    assert ours.costs(torch.tensor([[0]])).tolist() == [math.inf]
    assert ours.diverged == 1


def test_an_input_that_is_no_number_on_one_member_ends_them_all():
    class Fussy(Push):
        name = "fussy"

        def act(self, x, u, memory, k):
            return torch.where(x[:, :1] > 0.65, math.nan, 0.5), memory

    ours = evaluator(replace(toy_task(6, [Push(1.0), Fussy(0.5)]), ensemble=toys(1.0)))
    costs = ours.costs(torch.tensor([[0] * 6, [1] * 6]))
    assert costs.isinf().tolist() == [False, True]
    assert (ours.diverged, ours.control_steps) == (1, 3 * 6)


def test_a_guard_of_one_member_bars_them_all():
    """The third one begins right of 0.5, where damp may not be entered."""
    task = robust(horizon=6, rules=Rules(guards={"damp": lambda x, k: (x[:, 0] < 0.5) | (k > 5)}))
    ours, free = evaluator(task), evaluator(robust(horizon=6))
    rows = torch.tensor([[1] * 6, [0] * 6, [2] * 6])
    assert ours.costs(rows).tolist() == [math.inf, *free.costs(rows[1:]).tolist()]
    assert (ours.ruled_out, ours.diverged, ours.control_steps) == (1, 0, 3 * 12)
    fresh = evaluator(task)
    assert fresh.follow(Schedule((1,) * 6)) == math.inf
    assert (fresh.ruled_out, fresh.diverged) == (1, 0)
    assert evaluator(task, mode="damp").cost(Schedule((1,) * 6)) < math.inf, "it is running already"


def test_stopping_leaves_unknown_what_is_not_finished():
    ours = evaluator(robust(horizon=6), num_worlds=2)
    asked = iter(range(100))
    rows = torch.tensor([[0] * 6, [1] * 6, [2] * 6, [0, 1, 0, 1, 0, 1]])
    costs = ours.costs(rows, stop=lambda: next(asked) >= 8)
    assert costs.isnan().sum() == 2
    whole = ours.costs(rows)
    assert torch.equal(whole[~costs.isnan()], costs[~costs.isnan()])


@pytest.mark.parametrize("host", ["batch", "mixed"])
@pytest.mark.parametrize("tail", [0.0, 1.0])
def test_a_plan_is_the_best_of_all_for_the_ensemble(tail, host):
    task = robust(tail, host=host)
    found = plan(task, X, solver="exhaustive")
    assert task.ensemble is not None
    expected = torch.tensor([by_hand(found.schedule.modes)], dtype=torch.float64)
    assert found.cost == float(task.ensemble.risk(expected)[0])
    assert found.cost <= found.incumbent_cost
    assert plan(task, X, solver="exhaustive", sim=task.make_sim(5)) == found


@pytest.mark.parametrize("steps", [1, 20, 30, 60, 120, 200])
def test_a_draw_takes_a_rollout_of_each_member_out_of_the_budget(steps):
    found = plan(robust(), X, samples=8, pairs=4, budget=Budget(control_steps=steps))
    assert found.control_steps <= max(steps, 3 * 4), "the incumbent is always rolled out"


@pytest.mark.parametrize("exact", [True, False])
def test_a_loop_plans_as_if_each_tick_were_the_first(exact):
    """Members begin where the estimate says: nothing of the last tick is taken over."""
    task = robust(horizon=6)
    loop, sim = Receding(task, samples=4, iterations=1), ToySim(1)
    sim.reset(torch.tensor([X], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64))
    for _ in range(4):
        x, before = sim.x()[0], loop.running
        start = make_start(task, sim, x, sim.u()[0], before.mode, before.memory, loop.k, ran=before.ran)
        tick = loop.tick(x, snapshot=sim.save()[0] if exact else None)
        fresh = Evaluator(task, task.make_sim(8), start)
        assert tick.plan.incumbent_cost == fresh.cost(tick.plan.incumbent)
        assert tick.plan.cost == fresh.cost(tick.plan.schedule)
        sim.step(tick.u[None])


def test_an_ensemble_of_the_nominal_model_changes_nothing():
    task = toy_task(5)
    alone = plan(task, X)
    for size in (1, 2, 4):  # whose mean is a sum of halves or quarters, hence exact
        same = plan(replace(task, ensemble=Ensemble(size, lambda which: ToySim(len(which)))), X)
        assert (same.schedule, same.costs, same.switches) == (alone.schedule, alone.costs, alone.switches)


def test_what_breaks_on_one_member_is_avoided():
    """The bold mode is best on the nominal model and leaves the second one's safe range."""
    modes = [Push(0.1), Push(2.0)]
    cost = replace(COST, stage={"far": lambda x, u, u_prev, k: (x[:, 0] - 9.0) ** 2}, terminal={})
    task = toy_task(5, modes, cost)
    assert 1 in plan(task, X).schedule.modes
    edges = (math.inf, 1.0)
    careful = plan(
        replace(task, ensemble=Ensemble(2, lambda which: ToySim(len(which), 0.0, [edges[e] for e in which]))),
        X,
    )
    assert math.isfinite(careful.cost)
    assert careful.diverged > 0


def test_a_bad_mode_is_avoided_on_every_member():
    task = toy_task(4, [Push(1.0), Bad(1)])
    found = plan(replace(task, ensemble=Ensemble(2, lambda which: ToySim(len(which)))), X)
    assert set(found.schedule.modes) <= {0, 1}
    assert math.isfinite(found.cost)


def test_bad_ensembles():
    with pytest.raises(ValueError, match="at least one member, got 0"):
        Ensemble(0, ToySim)
    with pytest.raises(ValueError, match=r"tail is a share of the outcomes, 0 to 1, got 1\.5"):
        Ensemble(1, ToySim, tail=1.5)
    with pytest.raises(ValueError, match="make_sim was asked for 12 worlds and made 3"):
        Ensemble(3, lambda which: ToySim(3)).sim(4)
    short = Ensemble(3, lambda which: ToySim(len(which)), disturb=lambda x, u: (x[None], u[None]))
    with pytest.raises(ValueError, match=r"disturb gave x \(1, 2\) and u \(1, 1\), .* \(3, 2\) and \(3, 1\)"):
        evaluator(replace(toy_task(4), ensemble=short))
