"""The course: what it asks for when, where the walk is sent, and a run that begins anew."""

from __future__ import annotations

import math

import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.course import CourseCfg, GoalCfg, course_cost, towards
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STAND
from tools.showreel import ARRIVED, DOWN, HOLD, Course, laid_down

GOALS = (
    GoalCfg("stand", 1.0),
    GoalCfg("stand", 2.0, (1.0, 2.0)),
    GoalCfg("footstand", 1.0),
    GoalCfg("handstand", 2.0),
)
CFG = CourseCfg(goals=GOALS)
STEPS = {"up": 0, "there": 50, "foot": 150, "hand": 200}  # a first step of each goal


def at(x: torch.Tensor, *place: float, yaw: float = 0.0) -> torch.Tensor:
    """A state (37,) moved to a place and turned about the vertical, (1, 37)."""
    x = x[None].clone()
    x[0, :2] = torch.tensor(place)
    turn = torch.tensor([[math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]]).double()
    x[:, 3:7] = go2.product(turn, x[:, 3:7])
    return x


def stage(x: torch.Tensor, k: int) -> dict[str, float]:
    """Stage cost of a state (1, 37) held at control step k, by term."""
    cost, u = course_cost(CFG), x[:, 7:19]
    return dict(zip(cost.stage, cost.stage_terms(x, u, u, torch.tensor([k]))[0].tolist(), strict=True))


@pytest.mark.parametrize(
    ("goal", "holds"), [("up", STAND), ("there", STAND), ("foot", FOOTSTAND), ("hand", HANDSTAND)]
)
def test_what_is_asked_for_costs_nothing_and_all_else_does(goal, holds):
    k = STEPS[goal]
    mine = sum(stage(at(holds.state(), 1.0, 2.0), k).values())
    assert mine < 1e-3
    for other in (STAND, FOOTSTAND, HANDSTAND):
        if other is not holds:
            assert sum(stage(at(other.state(), 1.0, 2.0), k).values()) > mine + 1.0


def test_the_last_goal_stays():
    assert stage(at(HANDSTAND.state(), 0, 0), 10**6) == stage(at(HANDSTAND.state(), 0, 0), STEPS["hand"])


def test_on_its_back_is_not_on_its_feet():
    back = at(STAND.state(), 0.0, 0.0)
    back[:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0]).double()
    found = stage(back, 0)
    assert found["orientation"] == pytest.approx(0.0, abs=1e-12), "Table I alone sees no difference"
    assert found["level"] == pytest.approx(4 * CFG.level)
    assert stage(at(FOOTSTAND.state(), 0.0, 0.0), STEPS["foot"])["level"] == 0.0


def test_the_way_to_a_place_costs_where_there_is_one():
    x = at(STAND.state(), 1.0, 5.0)
    assert [stage(x, k)["place"] for k in STEPS.values()] == pytest.approx([0.0, 3.0 * CFG.place, 0.0, 0.0])
    tail = course_cost(CFG).terminal_terms(x, torch.tensor([STEPS["there"]]))[0].sum()
    assert float(tail) == pytest.approx(3.0 * CFG.place * CFG.cost.tail, abs=1e-3)


def test_commands_lead_to_the_place():
    command, k = towards(CFG), torch.tensor([STEPS["there"]])
    told = {
        "ahead": command(at(STAND.state(), 0.0, 2.0), k)[0],
        "behind": command(at(STAND.state(), 3.0, 2.01), k)[0],
        "left": command(at(STAND.state(), 1.0, 0.0), k)[0],
        "turned": command(at(STAND.state(), 1.0, 0.0, yaw=math.pi / 2), k)[0],
        "near": command(at(STAND.state(), 1.1, 1.9), k)[0],
        "there": command(at(STAND.state(), 1.0, 2.0), k)[0],
    }
    assert told["ahead"].tolist() == pytest.approx([0.8, 0.0, 0.0])
    assert told["behind"][0] == 0.0, "it turns first"
    assert abs(told["behind"][2]) == 1.0
    assert told["left"].tolist() == pytest.approx([0.0, 0.3, 1.0])
    assert told["turned"].tolist() == pytest.approx([0.8, 0.0, 0.0], abs=1e-6)
    assert told["near"].tolist() == pytest.approx([-0.15, 0.15, 0.0])
    assert told["there"].tolist() == pytest.approx([0.0] * 3)
    assert not command(at(STAND.state(), 5.0, 5.0), torch.tensor([0])).any(), "no place, no way"


def test_each_row_is_commanded_alone():
    x = torch.cat([at(STAND.state(), float(i), 0.5 * i, yaw=0.3 * i) for i in range(5)])
    k = torch.tensor([0, 60, 70, 149, 150])
    command = towards(CFG)
    rows = [command(x[i : i + 1], k[i : i + 1]) for i in range(5)]
    assert torch.equal(command(x, k), torch.cat(rows))


def follow(course: Course, holds, seconds: float, *place: float) -> list[int]:
    """Hold a posture at a place; control steps at which the course began anew."""
    x = at(holds.state(), *(place or (0.0, 0.0)))[0]
    return [step for step in range(round(seconds / go2.DT)) if course.advance(x)]


def test_a_course_that_is_done():
    course = Course(CFG)
    assert not follow(course, STAND, 1.0)
    assert (course.done, course.goal.at) == (1, (1.0, 2.0))
    assert not follow(course, STAND, 2.0, 1.0, 2.0 + 0.9 * ARRIVED)
    assert not follow(course, FOOTSTAND, 1.0)
    assert not course.finished
    assert not follow(course, HANDSTAND, 2.0)
    assert course.finished
    assert (course.tries, course.k) == (1, 300)


def test_a_goal_that_is_missed_and_the_course_begins_anew():
    course = Course(CFG)
    follow(course, STAND, 1.0)
    assert follow(course, STAND, 2.0, 1.0, 2.0 + 1.1 * ARRIVED) == [99]
    assert (course.k, course.done, course.tries, course.furthest) == (0, 0, 2, 1)
    assert follow(Course(CFG), FOOTSTAND, 1.0) == [49]


def test_what_comes_next_may_begin_early():
    course = Course(CFG)
    follow(course, STAND, HOLD)
    assert not follow(course, FOOTSTAND, 1.0 - HOLD)
    assert course.done == 1, "it stood for long enough"
    follow(course, STAND, 2.0, 1.0, 2.0)
    follow(course, FOOTSTAND, 1.0)
    follow(course, HANDSTAND, 1.5)
    assert follow(course, FOOTSTAND, 0.5) == [24], "the last goal is there to stay"
    short = Course(CFG)
    follow(short, STAND, HOLD - 0.02)
    assert follow(short, FOOTSTAND, 1.0 - HOLD + 0.02), "it did not"


def test_a_fall_and_the_course_begins_anew():
    course = Course(CFG)
    lying = at(STAND.state(), 0.0, 0.0)[0]
    lying[2] -= 0.3
    assert not [step for step in range(25) if course.advance(lying)], "before the first goal it may lie"
    follow(course, STAND, HOLD)
    assert course.done == 1
    began = [step for step in range(60) if course.advance(lying)]
    assert began == [round(DOWN / go2.DT) - 1]
    assert (course.k, course.tries) == (60 - began[0] - 1, 2)


def test_the_start_lies_on_a_side():
    sides = []
    for seed in (0, 1, 5):
        x, u = laid_down(seed)
        up = go2.vertical(x[None, 3:7])[0]
        assert x[2] < 0.2
        assert abs(float(up[1])) > 0.9
        assert x[19:22].norm() < 0.3
        assert torch.equal(laid_down(seed)[0], x)
        assert u.shape == (12,)
        sides.append(float(up[1]) > 0)
    assert any(sides)
    assert not all(sides)


@pytest.mark.parametrize(("seconds", "place"), [(0.0, ()), (1.0, (1.0,))])
def test_bad_goals(seconds, place):
    with pytest.raises(ValueError, match=r"a goal lasts some seconds, at a place \[x, y\] or none"):
        GoalCfg("stand", seconds, place)
    with pytest.raises(ValueError, match="at least one goal"):
        CourseCfg(goals=())
