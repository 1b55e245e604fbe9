"""Ctrl-C at any moment of a search: a plan comes back, no worse than the incumbent, at the cost it says."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmc import Cost, Evaluator, ModeSet, Plan, PlanInterrupted, Rules, Task, make_start, plan
from hmc.budget import Meter
from hmc.modes import Mode
from hmc.table import Table
from tests.naive import naive_cost
from tests.toy import COST, Damp, Push, Ramp, ToySim

X = [1.5, 1.0]
CORE = str(Path(sys.modules[Evaluator.__module__].__file__ or "").parent)
GUARDED = Rules(dwell={"ramp": 2}, guards={"damp": lambda x, k: x[:, 0] < 1.3}, max_changes=3)


class Bell:
    """Raises KeyboardInterrupt at the call `at`, and counts."""

    def __init__(self, at: float = math.inf):
        self.at, self.calls = at, 0

    def __call__(self, *_: Any) -> None:
        self.calls += 1
        if self.calls == self.at:
            raise KeyboardInterrupt

    def before(self, f: Callable[..., Any]) -> Callable[..., Any]:
        def rung(*args: Any, **named: Any) -> Any:
            self()
            return f(*args, **named)

        return rung


def rigged(bell: Bell, rules: Rules | None, cheap: bool) -> Task:
    """A task whose simulator, modes and cost ring."""

    def make_sim(n: int) -> ToySim:
        sim: Any = ToySim(n, cheap=cheap)
        sim.step = bell.before(sim.step)
        return sim

    modes: list[Any] = [Push(1.0), Damp(), Ramp()]
    for mode in modes:
        mode.act = bell.before(mode.act)
    stage = {name: bell.before(term) for name, term in COST.stage.items()}
    terminal = {name: bell.before(term) for name, term in COST.terminal.items()}
    return Task("rigged", ModeSet(list[Mode](modes)), Cost(stage, terminal, True), 6, make_sim, rules)


searches = st.fixed_dictionaries(
    {
        "solver": st.sampled_from(["sample", "exhaustive"]),
        "order": st.sampled_from(["uniform", "tails"]),
        "samples": st.sampled_from([3, 10, 100]),
        "pairs": st.sampled_from([0, 3]),
        "moves": st.sampled_from([0, 2]),
        "mode": st.none() | st.integers(0, 2),
        "schedule": st.lists(st.integers(0, 2), min_size=6, max_size=6),
    }
)


def check(found: Plan, options: dict[str, Any], rules: Rules | None) -> None:
    """That it is a plan, by rollouts one by one."""
    task = rigged(Bell(), rules, False)
    start = make_start(task, task.make_sim(1), X, mode=options["mode"])
    assert found.cost == naive_cost(task, found.schedule.modes, start)
    assert found.incumbent_cost == naive_cost(task, found.incumbent.modes, start)
    assert found.cost <= min(found.incumbent_cost, naive_cost(task, options["schedule"], start))
    schedule = found.incumbent
    for switch in found.switches:
        schedule = schedule.stitch(switch)
    assert schedule == found.schedule
    assert sum(found.terms.values()) == pytest.approx(found.cost) or found.cost == math.inf
    assert len(found.costs) == 1 or found.cost < found.incumbent_cost


def agrees(cut: Plan, whole: Plan) -> None:
    """That a plan is the beginning of another one; of the last switch's batch it may not have seen all."""
    number = len(cut.costs) - 1
    assert cut.costs[:number] == whole.costs[:number]
    assert cut.stopped_by in ("interrupt", whole.stopped_by)


@given(options=searches, rules=st.sampled_from([None, GUARDED]), cheap=st.booleans(), when=st.floats(0, 1))
@settings(max_examples=25)
def test_in_any_call(options, rules, cheap, when):
    """Of the simulator, a mode, a cost term or the table."""

    def run(bell: Bell) -> Plan:
        task = rigged(bell, rules, cheap)
        with mock.patch.object(Table, "rows", bell.before(Table.rows)):
            return plan(task, X, **options)

    bell = Bell()
    whole = run(bell)
    check(whole, options, rules)
    with pytest.raises(PlanInterrupted) as caught:
        run(Bell(1 + round(when * (bell.calls - 1))))
    check(caught.value.plan, options, rules)
    agrees(caught.value.plan, whole)


@given(options=searches, rules=st.sampled_from([None, GUARDED]), when=st.floats(0, 1))
@settings(max_examples=12)
def test_between_any_two_lines(options, rules, when):
    """Of the planner's own code, from the first rollout on; `sys.settrace` stands in for a signal."""

    def run(bell: Bell) -> Plan:
        task, begun = rigged(Bell(), rules, False), False

        def trace(frame: Any, event: str, _: Any) -> Any:
            nonlocal begun
            code = frame.f_code
            if not code.co_filename.startswith(CORE) or code.co_name == "_one_thread":
                return None
            begun = begun or code.co_name in ("follow", "aim")
            if begun and event == "line":
                bell()
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            return plan(task, X, **options)
        finally:
            sys.settrace(before)

    bell = Bell()
    whole = run(bell)
    with pytest.raises(PlanInterrupted) as caught:
        run(Bell(1 + round(when * (bell.calls - 1))))
    check(caught.value.plan, options, rules)
    agrees(caught.value.plan, whole)


def test_a_finished_plan_is_not_lost_while_it_is_recorded():
    task = rigged(Bell(), None, False)
    whole = plan(task, X)
    with (
        mock.patch.object(Meter, "settle", side_effect=KeyboardInterrupt),
        pytest.raises(PlanInterrupted) as caught,
    ):
        plan(task, X)
    assert caught.value.plan == whole
    assert whole.stopped_by == "converged"
