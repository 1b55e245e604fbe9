"""Rules: what they allow, by brute force, and that no solver and no loop ever breaks one."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Budget, Evaluator, ModeSet, Receding, Rules, Schedule, Task, make_start, plan
from tests.toy import COST, Damp, Push, Ramp, ToySim, all_schedules, toy_task

FAR = [1.5, 1.0]
NAMES = ("push1", "damp", "ramp")


def ruled(rules: Rules, horizon: int = 6) -> Task:
    return Task("toy", ModeSet([Push(1.0), Damp(), Ramp()]), COST, horizon, ToySim, rules)


def allowed(rules: Rules, row: tuple[int, ...], mode: int | None, ran: int | None) -> bool:
    """By the definition, one step at a time."""
    changes, count = 0, ran if ran is not None else math.inf
    for i, chosen in enumerate(row):
        if i == 0 and mode is None:
            count = 0
        elif mode is not None and chosen != mode:
            if count < rules.dwell.get(NAMES[mode], 1) or (NAMES[mode], NAMES[chosen]) in rules.forbidden:
                return False
            changes, count = changes + 1, 0
        mode, count = chosen, count + 1
    return rules.max_changes is None or changes <= rules.max_changes


@st.composite
def some_rules(draw):
    pairs = st.sampled_from(list(itertools.permutations(NAMES, 2)))
    return Rules(
        dwell=draw(st.dictionaries(st.sampled_from(NAMES), st.integers(1, 4))),
        forbidden=draw(st.frozensets(pairs, max_size=3)),
        max_changes=draw(st.none() | st.integers(0, 3)),
    )


@given(rules=some_rules(), mode=st.none() | st.integers(0, 2), ran=st.none() | st.integers(0, 5))
def test_rules_against_their_definition(rules, mode, ran):
    rows = all_schedules(3, 5)
    broken = rules.broken(ModeSet([Push(1.0), Damp(), Ramp()]), rows, mode, ran)
    assert [not bad for bad in broken.tolist()] == [
        allowed(rules, tuple(row), mode, ran) for row in rows.tolist()
    ]
    if mode is not None:
        assert not broken[(rows == mode).all(1)].any(), "to stay breaks no rule"


@settings(max_examples=40)
@given(rules=some_rules(), solver=st.sampled_from(["sample", "exhaustive"]), seed=st.integers(0, 9))
def test_no_plan_breaks_a_rule(rules, solver, seed):
    found = plan(ruled(rules), FAR, mode="damp", ran=1, solver=solver, samples=8, seed=seed)
    assert math.isfinite(found.cost)
    assert allowed(rules, found.schedule.modes, 1, 1)
    schedule = found.incumbent
    for switch in found.switches:
        schedule = schedule.stitch(switch)
        assert allowed(rules, schedule.modes, 1, 1)


def test_without_rules_in_the_way_the_plan_is_the_same():
    free, loose = plan(toy_task(), FAR), plan(ruled(Rules(dwell={"damp": 1}, max_changes=9)), FAR)
    assert (free.schedule, free.costs) == (loose.schedule, loose.costs)
    assert loose.ruled_out == 0


@settings(max_examples=20)
@given(rules=some_rules())
def test_a_loop_never_breaks_a_rule(rules):
    loop, sim, ran = Receding(ruled(rules), samples=6, budget=Budget(draws=12)), ToySim(1), []
    sim.reset(torch.tensor([FAR]), torch.zeros(1, 1))
    for _ in range(15):
        tick = loop.tick(sim.x()[0], snapshot=sim.save()[0])
        sim.step(tick.u[None])
        ran.append(tick.mode)
    runs = [(mode, len(list(steps))) for mode, steps in itertools.groupby(ran)]
    for mode, steps in runs[:-1]:
        assert steps >= rules.dwell.get(NAMES[mode], 1)
    for (one, _), (other, _) in itertools.pairwise(runs):
        assert (NAMES[one], NAMES[other]) not in rules.forbidden


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
        (Rules(dwell={"damp": 0}), "dwell of mode 'damp' must be at least 1 control step, got 0"),
        (Rules(forbidden=[("damp", "damp")]), "is no change"),
        (Rules(forbidden=[("damp", "walk")]), "unknown mode 'walk'"),
        (Rules(max_changes=-1), "max_changes must be >= 0, got -1"),
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
