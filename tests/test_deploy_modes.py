"""The real-time side's observation, policies and plan execution: as the library's, and as promised."""

from __future__ import annotations

import math

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from deploy import observe as ours
from deploy.modes import FOOT, HAND, JUMP, NONE, Performer, Plan, due
from deploy.settings import PlanCfg
from deploy.slots import PLAN
from hmc.go2 import facts
from hmc.go2 import model as go2
from hmc.go2 import observe as theirs
from hmc.go2.network import LOWER, UPPER, Network, follow
from hmc.go2.network import anchor_of as anchor_in_numpy
from hmc.go2.network import observe as observe_in_numpy
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.go2.task import policy_path

# of the policies that deploy/ runs
FILES = [policy_path(name) for name in ("footstand", "handstand")]
RULES = PlanCfg(expires=10, jump=8)


def states(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (n, 37), last targets (n, 12), anchors (n, 4)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 37))
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    heading = rng.uniform(-math.pi, math.pi, n)
    anchor = np.column_stack([rng.normal(size=(n, 2)), np.cos(heading), np.sin(heading)])
    return x, rng.normal(size=(n, 12)), anchor


def test_observation_is_that_of_training_and_planning():
    x, u, anchor = states(500)
    tx, tu, ta = (torch.from_numpy(part) for part in (x, u, anchor))
    expected = theirs.observe(tx, tu, ta).numpy()
    anchors, angles = theirs.anchor_of(tx).numpy(), theirs.pitch(tx).numpy()
    up = go2.vertical(tx[:, 3:7]).numpy()
    assert np.array_equal(observe_in_numpy(x, u, anchor), expected)  # to the bit
    assert np.array_equal(anchor_in_numpy(x), theirs.anchor_of(tx).numpy())
    for i in range(len(x)):
        np.testing.assert_allclose(ours.anchor_of(x[i]), anchors[i], atol=1e-12, rtol=0)
        np.testing.assert_allclose(ours.vertical(x[i, 3:7]), up[i], atol=1e-12, rtol=0)
        assert ours.pitch(up[i]) == pytest.approx(angles[i], abs=1e-12)


def test_an_anchor_follows_a_robot_that_is_far_from_it():
    x, _, anchor = states(500)
    followed = follow(x, anchor)
    assert np.array_equal(followed, theirs.follow(*map(torch.from_numpy, (x, anchor))).numpy())
    distance = np.linalg.norm(x[:, :2] - anchor[:, :2], axis=1)
    near = distance <= facts.LEASH
    assert 0 < near.sum() < len(x)
    assert np.array_equal(followed[near], anchor[near])
    np.testing.assert_allclose(np.linalg.norm(x[:, :2] - followed[:, :2], axis=1)[~near], facts.LEASH)
    away, origin = np.zeros((1, 37)), np.array([[0.0, 0.0, 0.6, 0.8]])
    away[0, :2] = 3.0, 4.0  # 5 m off: all but 1 m of it is followed
    np.testing.assert_allclose(follow(away, origin), [[2.4, 3.2, 0.6, 0.8]])


def test_pitch_and_lean_by_hand():
    assert ours.pitch(np.array([1.0, 0.0, 0.0])) == pytest.approx(-math.pi / 2)  # x up: on the hind legs
    assert ours.pitch(np.array([0.0, 0.0, 1.0])) == 0.0
    assert ours.lean(np.array([1.0, 0.0, 0.0])) == 0.0
    assert ours.lean(np.array([0.0, 0.5, math.sqrt(0.75)])) == pytest.approx(math.radians(30))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_policy_is_the_planners(path):
    x, u, anchor = states(200, 1)
    stance = (FOOTSTAND if "foot" in path.stem else HANDSTAND).state().numpy()
    x[:100] = stance + 0.05 * x[:100]
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    here, there = Network(path), Policy(path)
    tx, tu, ta = (torch.from_numpy(part) for part in (x, u, anchor))
    expected, memory = there.act(tx, tu, ta, torch.zeros(len(x), dtype=torch.long))
    for i in range(len(x)):
        at = follow(x[i : i + 1], anchor[i : i + 1])
        (target,) = here.act(x[i : i + 1], u[i : i + 1], at)
        np.testing.assert_allclose(target, expected[i].numpy(), atol=0, rtol=0)
        assert np.array_equal(at[0], memory[i].numpy())
        assert (target >= LOWER).all()
        assert (target <= UPPER).all()


def test_a_policy_of_another_interface_is_refused(tmp_path):
    model = onnx.load(str(FILES[0]))
    (field,) = (prop for prop in model.metadata_props if prop.key == "kp")
    field.value = "20.0"
    onnx.save(model, str(tmp_path / "other.onnx"))
    with pytest.raises(ValueError, match=r"other.onnx: kp is 20.0, expected 35.0"):
        Network(tmp_path / "other.onnx")
    with pytest.raises(ValueError, match="no such file"):
        Network(tmp_path / "none.onnx")


class Counting(Network):
    """A policy that returns how it was called."""

    def __init__(self, value: float):  # no file
        self.value = value
        self.anchors: list[np.ndarray] = []

    def act(self, x, u, anchor, command=None):
        self.anchors.append(anchor[0])
        return np.full((1, 12), self.value)


def performer() -> Performer:
    return Performer(RULES, {FOOT: Counting(0.0), HAND: Counting(2.0)})


def made(number: int, begin: int, modes: str, running: int = FOOT, base: int = 0) -> Plan:
    """A plan; its targets are 100 plus the step."""
    kinds = {"f": FOOT, "j": JUMP, "h": HAND}
    u = np.repeat(100.0 + np.arange(len(modes))[:, None], 12, 1)
    return Plan(number, base, begin, running, tuple(kinds[mode] for mode in modes), u)


def play(it: Performer, first: int, last: int) -> tuple[str, list[float]]:
    """Modes and targets of ticks first .. last - 1."""
    modes, targets = "", []
    for k in range(first, last):
        it.take_over(k)
        x = np.zeros(37)
        x[0], x[3] = 0.1 * k, 1.0  # m
        targets.append(float(it.act(k, x, np.zeros(12))[0]))
        modes += "fjh"[it.mode]
    return modes, targets


def test_before_the_first_plan_it_stands():
    it = performer()
    assert play(it, 5, 8)[0] == "fff"
    assert it.entered == 5


def test_a_plan_runs_from_its_begin_on_and_its_jump_as_planned():
    it = performer()
    play(it, 0, 3)
    it.offer(made(1, 5, "ffjjhhhh"))
    modes, targets = play(it, 3, 13)
    assert modes == "ff" + "ffjjhhhh"
    assert targets[4:6] == [102.0, 103.0]
    assert it.plan is not None
    assert it.plan.number == 1
    assert it.anchor[0] == 0.1 * 9  # where the handstand's mode was entered
    foot = it._policies[FOOT]
    assert isinstance(foot, Counting)
    assert {anchor[0] for anchor in foot.anchors} == {0}  # kept while the mode runs on


def test_a_late_plan_counts_only_if_it_says_what_ran():
    it = performer()
    play(it, 0, 6)
    it.offer(made(1, 3, "fffjjhh"))
    assert play(it, 6, 8)[0] == "jj"[:1] + "j"
    other = performer()
    play(other, 0, 6)
    other.offer(made(1, 3, "fjjjjhh"))  # two steps of its jump are missed
    assert play(other, 6, 9)[0] == "fff"
    assert other.counts["stale"] == 1


def test_a_plan_from_another_mode_than_the_one_that_runs_is_stale():
    it = performer()
    play(it, 0, 4)
    it.offer(made(1, 4, "jjhh", running=JUMP))
    assert play(it, 4, 6)[0] == "ff"
    assert it.counts["stale"] == 1


def test_plans_that_come_faster_than_they_begin_all_run():
    it = performer()
    for k in range(12):
        it.offer(made(k, k + 4, "f" * 8))
        play(it, k, k + 1)
        assert it.plan is None or it.plan.begin == k
    assert it.counts == {"taken": 8}


def test_a_newer_plan_takes_the_place_of_those_that_begin_with_it_or_later():
    it = performer()
    play(it, 0, 1)
    it.offer(made(1, 3, "fffff"))
    it.offer(made(2, 5, "jjjhh"))
    it.offer(made(3, 5, "ffjhh"))
    it.offer(made(4, 4, "fjhhh"))
    assert play(it, 1, 8)[0] == "ff" + "f" + "fjhh"
    assert it.counts == {"taken": 2}


def test_an_old_plan_starts_nothing_and_a_stance_goes_on():
    it = performer()
    it.offer(made(1, 0, "f" * 12 + "jjhh", running=NONE))
    assert play(it, 0, 40)[0] == "f" * 40  # at step 10 it has expired


def test_a_plan_of_long_ago_takes_no_time():
    """What ran since its begin would be millions of ticks to look through."""
    it, looked = performer(), list[int]()

    class Ran(dict[int, int]):
        def get(self, key, default=None):
            looked.append(key)
            return super().get(key, default)

    it._ran = Ran()
    play(it, 0, 1)
    it.offer(made(1, 0, "fff", running=NONE))
    it.take_over(10_000)
    assert it.counts["late"] == 1
    assert len(looked) <= RULES.expires


def test_a_jump_is_finished_whatever_happens_to_the_planner():
    it = performer()
    it.offer(made(1, 0, "f" * 8 + "j" * 5 + "h" * 3, running=NONE))
    modes, targets = play(it, 0, 30)
    assert modes == "f" * 8 + "j" * 5 + "h" * 17
    assert targets[8:13] == [108.0, 109.0, 110.0, 111.0, 112.0]


def test_a_jump_whose_targets_run_out_or_that_lasts_too_long_ends_in_the_handstand():
    it = performer()
    it.offer(made(1, 0, "fjj", running=NONE))
    assert play(it, 0, 6)[0] == "fjjhhh"
    long = performer()
    long.offer(made(1, 0, "j" * 9 + "f" * 9, running=NONE))
    assert play(long, 0, 12)[0] == "j" * RULES.jump + "h" * 4


def test_a_jump_of_an_old_plan_does_not_end_on_the_hind_legs():
    assert due(RULES, 0, [FOOT] * 6 + [JUMP] * 5 + [FOOT] * 5, 11, JUMP, 6) == HAND


@given(st.lists(st.sampled_from([FOOT, JUMP, HAND]), max_size=20), st.integers(0, 40), st.integers(0, 20))
def test_what_is_due_has_targets(modes, k, begin):
    """Whatever the plan: a jump is due only where the plan has one."""
    for mode in (NONE, FOOT, JUMP, HAND):
        wanted = due(RULES, begin, modes, max(k, begin), mode, k)
        if wanted == JUMP:
            assert modes[max(k, begin) - begin] == JUMP


def test_a_plan_that_is_none_is_refused():
    record = np.zeros((), PLAN)
    with pytest.raises(ValueError, match="0 steps"):
        Plan.read(record)
    record["steps"], record["modes"][:2] = 2, (0, 9)
    with pytest.raises(ValueError, match="modes"):
        Plan.read(record)
    record["modes"][:2], record["u"][1, 3] = (0, 1), np.nan
    with pytest.raises(ValueError, match="not numbers"):
        Plan.read(record)
    record["u"][1, 3] = 0.0
    assert Plan.read(record).modes == (0, 1)
    for name, value in (("steps", -5), ("steps", 129), ("begin", -(2**62)), ("base", -(2**63)), ("base", 1)):
        wrong = record.copy()
        wrong[name] = value
        with pytest.raises(ValueError, match="steps from tick"):
            Plan.read(wrong)
