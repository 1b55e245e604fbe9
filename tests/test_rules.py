"""Rules: what they allow, by brute force, and that no solver and no loop ever breaks one."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Budget, Ensemble, Evaluator, ModeSet, Receding, Rules, Schedule, Task, make_start, plan
from tests.naive import allowed, naive_cost
from tests.toy import COST, Damp, Push, Ramp, ToySim, all_schedules, toy_task

FAR = [1.5, 1.0]
NAMES = ("push1", "damp", "ramp")


def ruled(rules: Rules, horizon: int = 6) -> Task:
    return Task("toy", ModeSet([Push(1.0), Damp(), Ramp()]), COST, horizon, ToySim, rules)


def low(x, k):
    """A guard on the state."""
    return x[:, 0] < 1.3


def late(x, k):
    """And one on the control step."""
    return k >= 2


@st.composite
def some_rules(draw, guards=False):
    pairs = st.sampled_from(list(itertools.permutations(NAMES, 2)))
    some = st.dictionaries(st.sampled_from(NAMES), st.sampled_from([low, late]), max_size=2)
    return Rules(
        dwell=draw(st.dictionaries(st.sampled_from(NAMES), st.integers(1, 4))),
        forbidden=draw(st.frozensets(pairs, max_size=3)),
        max_changes=draw(st.none() | st.integers(0, 3)),
        guards=draw(some) if guards else {},
    )


def toys(which):
    """Members of an ensemble: one gives way where the other does not."""
    return ToySim(len(which), hidden=[0.3 * each for each in which])


searches = st.fixed_dictionaries(
    {
        "solver": st.sampled_from(["sample", "exhaustive"]),
        "order": st.sampled_from(["uniform", "tails"]),
        "samples": st.sampled_from([4, 8, 40]),
        "max_samples": st.sampled_from([0, 32]),
        "pairs": st.sampled_from([0, 4]),
        "moves": st.sampled_from([0, 3]),
    }
)


@given(rules=some_rules(), mode=st.none() | st.integers(0, 2), ran=st.none() | st.integers(0, 5))
def test_rules_against_their_definition(rules, mode, ran):
    rows = all_schedules(3, 5)
    broken = rules.broken(ModeSet([Push(1.0), Damp(), Ramp()]), rows, mode, ran)
    assert [not bad for bad in broken.tolist()] == [
        allowed(rules, NAMES, row, mode, ran) for row in rows.tolist()
    ]
    if mode is not None:
        assert not broken[(rows == mode).all(1)].any(), "to stay breaks no rule"


@settings(max_examples=40)
@given(
    rules=some_rules(guards=True),
    options=searches,
    seed=st.integers(0, 9),
    mode=st.integers(0, 2),
    members=st.sampled_from([0, 2]),
    ran=st.none() | st.integers(0, 3),
)
def test_no_plan_breaks_a_rule(rules, options, seed, mode, members, ran):
    """Nor does any schedule on the way there, whatever the search; ramp may run, its memory not given."""
    task = replace(ruled(rules), ensemble=Ensemble(2, toys) if members else None)
    found = plan(task, FAR, mode=mode, ran=ran, seed=seed, **options)
    start = make_start(task, task.make_sim(1), FAR, mode=mode, ran=ran)
    assert math.isfinite(found.cost)
    assert allowed(rules, NAMES, found.schedule.modes, mode, ran)
    assert found.cost == naive_cost(task, found.schedule.modes, start), "which asks the guards too"
    assert found.ruled_out == sum(found.why_not.values())
    schedule, switches, costs = found.incumbent, list(found.switches), list(found.costs)
    while switches:
        schedule = schedule.stitch(switches.pop(0))
        assert allowed(rules, NAMES, schedule.modes, mode, ran) or options["pairs"] or options["moves"]
    assert schedule == found.schedule
    assert costs == sorted(costs, reverse=True)


def test_without_rules_in_the_way_the_plan_is_the_same():
    free, loose = plan(toy_task(), FAR), plan(ruled(Rules(dwell={"damp": 1}, max_changes=9)), FAR)
    assert (free.schedule, free.costs) == (loose.schedule, loose.costs)
    assert loose.ruled_out == 0


@settings(max_examples=20)
@given(rules=some_rules(guards=True), options=searches)
def test_a_loop_never_breaks_a_rule(rules, options):
    """What ran, and of each plan what is still to come; guards hold where a mode was truly entered."""
    rules = replace(rules, guards={name: f for name, f in rules.guards.items() if name != "push1"})
    loop, sim, ran = Receding(ruled(rules), budget=Budget(draws=12), **options), ToySim(1), []
    sim.reset(torch.tensor([FAR]), torch.zeros(1, 1))
    for k in range(15):
        x, mode, since = sim.x(), loop.running.mode, loop.running.ran
        tick = loop.tick(x[0], snapshot=sim.save()[0])
        assert math.isfinite(tick.plan.cost)
        assert allowed(rules, NAMES, tick.plan.schedule.modes, mode, since)
        guard = rules.guards.get(NAMES[tick.mode])
        assert tick.mode == mode or guard is None or bool(guard(x, torch.tensor([k]))[0])
        sim.step(tick.u[None])
        ran.append(tick.mode)
    runs = [(mode, len(list(steps))) for mode, steps in itertools.groupby(ran)]
    for mode, steps in runs[:-1]:
        assert steps >= rules.dwell.get(NAMES[mode], 1)
    for (one, _), (other, _) in itertools.pairwise(runs):
        assert (NAMES[one], NAMES[other]) not in rules.forbidden


def test_a_running_mode_with_memory_that_is_not_given_runs_on():
    """Its memory is made anew; dwell, forbidden changes and guards know all the same that it runs."""
    guards = {"ramp": lambda x, k: torch.zeros(len(x), dtype=torch.bool)}
    for rules in (Rules(dwell={"ramp": 3}), Rules(forbidden=[("ramp", "damp")]), Rules(guards=guards)):
        task = ruled(rules)
        start = make_start(task, task.make_sim(1), FAR, mode="ramp", ran=1, k=4)
        assert (start.mode, start.ran, start.memory.tolist()) == (2, 1, [0.0, 1.5, 0.0, 4.0])
        rows = all_schedules(3, 6)
        costs = Evaluator(task, task.make_sim(64), start).costs(rows)
        expected = [naive_cost(task, row, start) for row in rows.tolist()]
        assert costs.tolist() == expected
        assert 0 < sum(cost == math.inf for cost in expected) < len(rows)
        assert math.isfinite(plan(task, FAR, mode="ramp", ran=1, k=4).cost), "to stay may"
    found = plan(ruled(Rules(dwell={"ramp": 3})), FAR, mode="ramp", ran=1)
    assert found.schedule.modes[:2] == (2, 2)
    assert found.why_not == {"dwell of ramp": found.ruled_out}


def test_why_not_counts_each_schedule_at_the_first_rule_that_it_breaks():
    rules = Rules(
        dwell={"ramp": 2, "damp": 3}, forbidden=[("push1", "ramp")], max_changes=2, guards={"damp": late}
    )
    task, rows = ruled(rules, 4), all_schedules(3, 4)
    evaluator = Evaluator(task, task.make_sim(100), make_start(task, task.make_sim(1), FAR))
    evaluator.costs(rows)
    expected: Counter[str] = Counter()
    for row in rows.tolist():
        alone = {
            "max_changes 2": Rules(max_changes=2),
            "forbidden push1 to ramp": Rules(forbidden=rules.forbidden),
            "dwell of ramp": Rules(dwell={"ramp": 2}),
            "dwell of damp": Rules(dwell={"damp": 3}),
        }
        broken = [name for name, one in alone.items() if not allowed(one, NAMES, row, None, None)]
        if not broken and any(row[i] == 1 and (i == 0 or row[i - 1] != 1) for i in range(2)):
            broken = ["guard of damp"]
        expected.update(broken[:1])
    assert evaluator.why_not == expected
    assert len(expected) == 5
    assert evaluator.ruled_out == expected.total()
    one = Evaluator(task, task.make_sim(1), make_start(task, task.make_sim(1), FAR))
    for row in rows.tolist():  # one by one they are recorded
        one.follow(Schedule(tuple(row)))
    assert one.why_not == expected


def test_where_nothing_is_feasible_the_plan_says_why():
    def nowhere(x, k):
        return torch.zeros(len(x), dtype=torch.bool)

    rules = Rules(guards=dict.fromkeys(NAMES, nowhere), forbidden=[("push1", "ramp")])
    found = plan(ruled(rules), FAR, solver="exhaustive")
    assert found.cost == math.inf
    assert found.seen == found.space_size
    assert not found.locally_optimal, "there is nothing that a switch could be measured by"
    assert set(found.why_not) == {
        "guard of push1",
        "guard of damp",
        "guard of ramp",
        "forbidden push1 to ramp",
    }
    assert sum(found.why_not.values()) == found.ruled_out
    text = str(found)
    assert "no schedule tried is feasible: relax the rules" in text
    assert f"{found.why_not['guard of ramp']} by guard of ramp" in text
    assert "locally optimal" not in text


def test_a_guard_bars_the_entry_and_only_that():
    """Damp may be entered only left of 1.3; the state moves left at once and comes back later."""
    task = ruled(Rules(guards={"damp": lambda x, k: x[:, 0] < 1.3}))
    sim = task.make_sim(64)
    evaluator = Evaluator(task, sim, make_start(task, sim, FAR))
    rows = all_schedules(3, 6)
    costs = evaluator.costs(rows)
    free = Evaluator(toy_task(), sim, make_start(toy_task(), sim, FAR))
    expected = free.costs(rows)
    for row, cost, plain in zip(rows.tolist(), costs.tolist(), expected.tolist(), strict=True):
        x = free.trace(Schedule(tuple(row))).x[:, 0]
        entries = [i for i in range(6) if row[i] == 1 and (i == 0 or row[i - 1] != 1)]
        assert cost == (plain if all(x[i] < 1.3 for i in entries) else math.inf)
    assert 0 < evaluator.ruled_out < len(rows)
    assert evaluator.diverged == 0
    barred = Schedule((1,) * 6)
    assert evaluator.trace(barred).barred
    assert evaluator.follow(barred) == math.inf
    running = Evaluator(task, sim, make_start(task, sim, FAR, mode="damp"))
    assert running.cost(barred) < math.inf, "it is running already"


@pytest.mark.parametrize("exact", [True, False])
def test_a_loop_goes_on_from_an_incumbent_that_may_not_run(exact):
    """Nothing was recorded of it, so the next tick has nothing to take over."""
    rules = Rules(guards={"ramp": lambda x, k: k > 2}, forbidden=[("ramp", "damp")])
    for schedule in (["ramp"] * 6, ["ramp", "damp"] * 3):
        loop, sim = Receding(ruled(rules), schedule=schedule, iterations=0), ToySim(1)
        sim.reset(torch.tensor([FAR]), torch.zeros(1, 1))
        for _ in range(4):
            tick = loop.tick(sim.x()[0], snapshot=sim.save()[0] if exact else None)
            sim.step(tick.u[None])


def test_the_fallback_runs_where_nothing_else_may():
    def nowhere(x, k):
        return torch.zeros(len(x), dtype=torch.bool)

    rules = Rules(guards=dict.fromkeys(NAMES, nowhere), fallback="damp")
    found = plan(ruled(rules), FAR)
    assert found.fell_back
    assert found.schedule == Schedule.constant(1, 6)
    assert found.cost == math.inf
    assert "fallback" in str(found)
    assert "against the rules" in str(found)
    stay = plan(ruled(rules), FAR, mode="push1", schedule=["ramp"] * 6)
    assert not stay.fell_back
    assert stay.schedule == stay.incumbent == Schedule.constant(0, 6), "the incumbent may not; to stay may"
    loop = Receding(ruled(rules))
    assert loop.tick(FAR).mode == 1


@pytest.mark.parametrize(
    ("rules", "words"),
    [
        (Rules(dwell={"dmap": 3}), "did you mean 'damp'"),
        (
            Rules(dwell={"damp": 0}),
            "dwell of mode 'damp' must be a whole number of control steps >= 1, got 0",
        ),
        (Rules(dwell={"damp": 2.5}), "control steps >= 1, got 2.5"),
        (Rules(dwell={"damp": math.inf}), "control steps >= 1, got inf"),
        (Rules(forbidden=[("damp", "damp")]), "is no change"),
        (Rules(forbidden=("damp", "ramp")), r"has 'damp': expected pairs of modes, \(from, to\)"),
        (Rules(forbidden=[("damp", "ramp", "damp")]), "expected pairs of modes"),  # type: ignore[list-item]
        (Rules(forbidden=[("damp", "walk")]), "unknown mode 'walk'"),
        (Rules(max_changes=-1), "max_changes must be a whole number >= 0, got -1"),
        (Rules(max_changes=math.nan), "max_changes must be a whole number >= 0, got nan"),
        (Rules(fallback="lie"), "unknown mode 'lie'"),
        (Rules(guards={"fly": lambda x, k: k > 0}), "unknown mode 'fly'"),
    ],
)
def test_rules_that_mean_nothing_are_refused(rules, words):
    with pytest.raises((ValueError, KeyError), match=words):
        ruled(rules)


def test_a_negative_time_is_refused():
    with pytest.raises(ValueError, match="ran >= 0 steps, got -2"):
        plan(toy_task(), FAR, mode=0, ran=-2)


def test_changes_that_can_be_listed_only_once_are_forbidden_each_time():
    rules = Rules(forbidden=zip(["push1"], ["damp"], strict=True))
    for _ in range(2):
        assert plan(ruled(rules), [0.3, 0.0], schedule=["push1"] + ["damp"] * 5).incumbent_cost == math.inf
