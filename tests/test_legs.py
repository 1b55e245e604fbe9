"""Modes on four legs: observations under a command, rewards, falls, successes and starts."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch
from tensordict import TensorDict

from hmc.go2 import model as go2
from hmc.go2.facts import COMMANDS, OBS_SIZE
from hmc.go2.mirror import mirror_joints
from hmc.go2.observe import observe
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STAND
from tests.tiny import make_legs, make_runner
from train import evaluate, fallen
from train.config import LegsTraining, PpoCfg
from train.env import both_sides
from train.export import actor_of, export
from train.fallen import FALLEN, STANCES, STANDING, LegsStarts, LegsStartsCfg, disturbed, dropped
from train.legs import CommandCfg, LegsCfg, drawn, heading_velocity
from train.rewards import LegsRewardCfg, legs_rewards
from train.runner import read_checkpoint

CPU = torch.device("cpu")
ONES = LegsRewardCfg(**{field.name: 1.0 for field in fields(LegsRewardCfg)})
REST = STAND.state()[None]


def lying(pitch: float = math.pi) -> torch.Tensor:
    """On its back, or turned by another angle about its y axis, trunk on the ground, (1, 37)."""
    x = STAND.state()[None]
    x[:, 3], x[:, 5] = math.cos(pitch / 2), math.sin(pitch / 2)
    x[:, 2] -= go2.clearances(x)["trunk"] + 0.002
    return x


def terms(x=REST, u=None, velocity=(0, 0, 0), command=(0, 0, 0), landed=(0, 0, 0, 0)) -> dict[str, float]:
    """Terms of one world with all weights 1."""
    u = x[:, 7:19] if u is None else u
    row = lambda values: torch.tensor([values], dtype=torch.float64)  # noqa: E731
    found = legs_rewards(
        ONES, x, x, u, u, row(velocity), row(command), row(landed), 0 * u, go2.DT, go2.clearances(x)
    )
    return {name: float(value[0]) for name, value in found.items()}


def test_standing_still_earns_all_and_costs_nothing():
    found = terms()
    earned = dict.fromkeys(("upright", "height", "posture", "stillness", "track", "turn"), 1)
    costs = {name: 0.0 for name in found if name not in earned}
    assert found == pytest.approx(earned | costs, abs=1e-9)
    assert set(found) == {field.name for field in fields(LegsRewardCfg)} - {"termination", "width"}


def test_on_its_back_nothing_is_earned():
    found = terms(lying())
    assert [found[name] for name in ("upright", "height", "posture", "stillness", "track")] == [0.0] * 5
    assert terms(lying(math.pi / 2))["upright"] == pytest.approx(0.5)
    assert found["touch"] <= -1.0


def test_posture_earns_by_the_distance_from_the_pose():
    x = REST.clone()
    x[:, 7], x[:, 12] = 0.6, go2.HOME[5] + 0.8  # 1 rad^2
    for width, worth in ((1.0, math.exp(-1.0)), (10.0, math.exp(-0.1))):
        cfg, none, u = replace(ONES, width=width), torch.zeros(1, 3), x[:, 7:19]
        found = legs_rewards(cfg, x, x, u, u, none, none, none, 0 * u, go2.DT, go2.clearances(x))
        assert float(found["posture"]) == pytest.approx(worth)


def test_walking_earns_by_what_was_commanded():
    told = (0.6, 0.0, 0.5)
    assert terms(velocity=told, command=told)["track"] == pytest.approx(1.0)
    slow = terms(velocity=(0.1, 0.0, 0.0), command=told)
    assert slow["track"] == pytest.approx(math.exp(-(0.5**2) / 0.15))
    assert slow["turn"] == pytest.approx(math.exp(-(0.5**2) / 0.25))
    assert slow["stillness"] == 0.0, "told to walk, it earns nothing by standing"


def test_targets_out_of_reach_cost_what_they_are_beyond():
    env = make_legs("getup", rewards=LegsRewardCfg(beyond=2.0))
    actions = torch.zeros(8, 12)
    actions[1, 0], actions[2, 5], actions[3, 0] = 4.0, 2.5, 2.0  # beyond: 2 - 1.0472, 1.25 - 0.96224, nothing
    _, _, _, extras = env.step(actions)
    out = (2.0 - 1.0472) ** 2 + (1.25 - (1.8 - 0.83776)) ** 2
    assert float(extras["log"]["/reward/beyond"]) == pytest.approx(-2.0 * out / 8, rel=1e-4)


@pytest.mark.parametrize(("time", "worth"), [(0.05, 0.0), (0.15, 0.05), (0.25, 0.15), (2.0, 0.25)])
def test_feet_earn_by_their_time_in_the_air(time, worth):
    told = (0.5, 0.0, 0.0)
    assert terms(command=told, landed=(time, 0, 0, 0))["air"] * go2.DT == pytest.approx(worth)
    assert terms(command=told, landed=(time, time, 0, 0))["air"] * go2.DT == pytest.approx(2 * worth)
    assert terms(landed=(time, 0, 0, 0))["air"] == 0.0, "not while it is to stand"


def test_the_time_in_the_air_is_counted():
    env = make_legs("walk")
    x = STAND.state().float().repeat(8, 1)
    env.command = torch.tensor([[0.5, 0.0, 0.0]]).repeat(8, 1)
    raised = x.clone()
    raised[:, 2] += 0.1
    for _ in range(10):
        found = env.rewards(raised, raised, x[:, 7:19], x[:, 7:19], go2.clearances(raised))
        assert not found["air"].any()
    assert torch.allclose(env._air, torch.tensor(10 * go2.DT))
    env.command = torch.tensor([[0.5, 0.0, 0.0]]).repeat(8, 1)
    found = env.rewards(x, x, x[:, 7:19], x[:, 7:19], go2.clearances(x))
    worth = env.cfg.rewards.air * 4 * (10 * go2.DT - 0.1) / go2.DT
    torch.testing.assert_close(found["air"], torch.full((8,), worth))
    assert not env._air.any()


def test_the_command_is_part_of_what_is_seen():
    env = make_legs("walk")
    obs = env.get_observations()
    assert {name: group.shape[1] for name, group in obs.items()} == {"policy": 51, "critic": 64}
    for group in obs.values():
        assert torch.equal(group[:, OBS_SIZE : OBS_SIZE + 3], env.command)
        assert not group[:, 3:5].any(), "where the mode was entered is of no use to one that walks away"
    clean = observe(env._x, env._u, env._anchor)
    kept = [column for column in range(OBS_SIZE) if column not in (3, 4)]
    assert torch.equal(obs["critic"][:, kept], clean[:, kept])
    still = make_legs("stand").get_observations()
    assert {name: group.shape[1] for name, group in still.items()} == {"policy": 48, "critic": 61}
    assert still["critic"][:, 3:5].any()


def test_the_mirror_image_of_a_walk():
    env = make_legs("walk")
    obs, actions = env.get_observations(), torch.randn(8, 12)
    both, twice = both_sides(env, obs, actions)
    assert both is not None
    assert twice is not None
    image = TensorDict({name: group[8:] for name, group in both.items()}, batch_size=[8])
    told = image["policy"][:, OBS_SIZE:]
    assert torch.equal(told, env.command * torch.tensor([1.0, -1.0, -1.0]))
    assert torch.equal(twice[8:], mirror_joints(actions))
    again, _ = both_sides(env, image, None)
    assert again is not None
    for name, group in obs.items():
        torch.testing.assert_close(again[name][8:], group)


def test_velocity_in_the_heading_frame():
    x = REST.clone()
    x[:, 3], x[:, 6] = math.cos(math.pi / 4), math.sin(math.pi / 4)  # facing along y
    x[:, 19:22], x[:, 24] = torch.tensor([0.2, 1.0, 0.5]).double(), 0.7
    assert heading_velocity(x)[0].tolist() == pytest.approx([1.0, -0.2, 0.7])


def test_falls():
    late = torch.full((8,), 60)
    for mode, grace, expected in (("walk", 0.0, True), ("stand", 1.0, True), ("getup", 1000.0, False)):
        env = make_legs(mode, grace=grace)
        x = torch.cat([lying().repeat(7, 1), REST]).float()
        env.episode_length_buf[:] = late
        assert env.fallen(x, go2.clearances(x)).tolist() == [expected] * 7 + [False], mode
        env.episode_length_buf[:] = 20
        assert bool(env.fallen(x, go2.clearances(x)).any()) == (mode == "walk"), "the grace time is not over"


def test_successes_of_standing():
    env = make_legs("stand")
    x = torch.cat([REST, lying(), FOOTSTAND.state()[None], REST, REST, REST, REST, REST]).float()
    x[3, 2] += 0.05  # in the air
    x[4, 19] = 1.0  # running
    x[5, 9] = -2.6  # one foot up
    x[6, 3:7] = torch.tensor([math.cos(0.25), math.sin(0.25), 0.0, 0.0])  # tilted by 29 degrees
    assert env.good(x, go2.clearances(x)).tolist() == [True] + [False] * 6 + [True]


def test_successes_of_walking():
    """The mean distance from the commanded velocity since the command counts."""
    env = make_legs("walk", command=CommandCfg(every=1e9))
    env.command = torch.tensor([[0.5, 0.0, 0.0]]).repeat(8, 1)
    env._since[:], env._astray[:] = 0.0, 0.0
    for step in range(4):
        x = REST.float().repeat(8, 1)
        x[:, 19] = torch.tensor([0.5, 0.5 if step % 2 else 0.0, 0.0, 0.9, 0.25, 0.5, 0.5, 0.5])
        env.rewards(x, x, x[:, 7:19], x[:, 7:19], go2.clearances(x))
    assert env.good(x, go2.clearances(x)).tolist() == [True, True, False, False, True, True, True, True]
    env._command(torch.tensor([2]))
    assert env.good(x, go2.clearances(x))[2], "a new command begins a new account"


def test_commands():
    told = drawn(CommandCfg(forward=(-0.2, 1.0), sideways=0.3, turn=0.8, halt=0.25), 4000, CPU)
    halted = (told == 0).all(1)
    assert abs(float(halted.float().mean()) - 0.25) < 0.03
    low, high = told[~halted].amin(0).tolist(), told[~halted].amax(0).tolist()
    assert low == pytest.approx([-0.2, -0.3, -0.8], abs=0.01)
    assert high == pytest.approx([1.0, 0.3, 0.8], abs=0.01)


def test_dropped_robots_lie_in_any_attitude():
    torch.manual_seed(3)
    rows = dropped(200, threads=1)
    x, u = rows[:, :37], rows[:, 37:]
    assert len(rows) > 195
    up = go2.vertical(x[:, 3:7])[:, 2]
    assert (up < -0.8).sum() > 10, "on their backs"
    assert (up.abs() < 0.5).sum() > 10, "on their sides"
    rest = x[:, 19:22].norm(dim=1) < 0.3
    assert 0.4 < rest.float().mean() < 0.8, "half of them at rest"
    assert (go2.lowest(x)[rest].abs() < 0.02).float().mean() > 0.9, "on the ground"
    assert (x[:, 22].abs() > 2.0).sum() > 20, "others roll"
    assert ((u >= go2.Q_LOWER) & (u <= go2.Q_UPPER)).all()


def test_starts(monkeypatch):
    pool = torch.arange(3 * 49, dtype=torch.float32).reshape(3, 49)
    monkeypatch.setattr(fallen, "dropped", lambda n: pool)
    torch.manual_seed(4)
    starts = LegsStarts(LegsStartsCfg(standing=0.2, fallen=0.5, stances=0.3), CPU)
    start = starts.draw(2000)
    shares = [float((start.kind == kind).float().mean()) for kind in (STANDING, FALLEN, STANCES)]
    assert shares == pytest.approx([0.2, 0.5, 0.3], abs=0.04)
    found = torch.cat([start.x, start.u], 1)[start.kind == FALLEN]
    assert (found[:, None] == pool).all(2).any(1).all(), "a state with its own input"
    legs = start.x[start.kind == STANDING]
    assert (go2.vertical(legs[:, 3:7])[:, 2] > 0.95).all()
    nose = go2.vertical(start.x[start.kind == STANCES][:, 3:7])[:, 0]
    assert (nose.abs() > 0.95).all()
    assert 0.4 < (nose > 0).float().mean() < 0.6, "as many nose up as nose down"
    good, ended = torch.tensor([True, True, False, True]), torch.tensor([True, True, True, False])
    starts.report(torch.tensor([1, 1, 0, 2]), torch.zeros(4).long(), good, ended)
    assert starts.rates[1] == pytest.approx(1 - 0.995**2, rel=1e-4)
    assert starts.rates[0] == 0.0


def test_disturbed_states_touch_the_ground():
    rest = torch.stack([STAND.state(), HANDSTAND.state()]).float().repeat(50, 1)
    x = disturbed(rest, LegsStartsCfg())
    torch.testing.assert_close(go2.lowest(x), torch.full((100,), 0.001), atol=1e-5, rtol=0)
    assert ((x[:, 7:19] - rest[:, 7:19]).abs() <= 0.15 + 1e-6).all()
    torch.testing.assert_close(x[:, 3:7].norm(dim=1), torch.ones(100))


def test_bad_settings():
    with pytest.raises(ValueError, match=r"shares of starts must be >= 0 and not all 0, got \(0\.0, 0"):
        LegsStartsCfg(standing=0.0)


@pytest.fixture(scope="module")
def walker(tmp_path_factory):
    """A checkpoint of a walk that has learned nothing yet, and its policy file."""
    folder = tmp_path_factory.mktemp("walk")
    cfg = LegsTraining(LegsCfg("walk", worlds=8), PpoCfg(hidden=(16, 8)))
    runner = make_runner(folder, cfg)
    runner.save(str(folder / "model_0.pt"))
    export(folder / "model_0.pt", folder / "walk.onnx")
    return folder / "model_0.pt", folder / "walk.onnx"


@torch.no_grad()
def test_a_policy_under_command(walker):
    checkpoint, path = walker
    told = torch.tensor([[0.4, -0.1, 0.3]], dtype=torch.float64)
    policy = Policy(path, command=lambda x, k: told.expand(len(x), 3))
    assert policy.network.command == COMMANDS["walk"]
    x, u = REST.repeat(5, 1), REST[:, 7:19].repeat(5, 1) + 0.1 * torch.randn(5, 12).double()
    x[:, :2] = torch.randn(5, 2)
    k = torch.zeros(5, dtype=torch.long)
    memory = policy.reset(x, u, k)
    x[:, :2] += 3.0
    obs = torch.cat([observe(x, u, memory), told.expand(5, 3)], 1).float()
    obs[:, 3:5] = 0.0
    network = actor_of(read_checkpoint(checkpoint))(TensorDict({"policy": obs}, batch_size=[5])).double()
    expected = (go2.HOME + 0.5 * network).clamp(go2.Q_LOWER, go2.Q_UPPER)
    torch.testing.assert_close(policy.act(x, u, memory, k)[0], expected, atol=1e-5, rtol=0)


def test_a_command_that_is_missing_or_too_much(walker, tmp_path):
    with pytest.raises(ValueError, match=r"walk\.onnx: it obeys forward .*, and none is given"):
        Policy(walker[1])
    cfg = LegsTraining(LegsCfg("stand", worlds=8), PpoCfg(hidden=(4,)))
    make_runner(tmp_path, cfg).save(str(tmp_path / "model_0.pt"))
    export(tmp_path / "model_0.pt", tmp_path / "stand.onnx")
    with pytest.raises(ValueError, match=r"stand\.onnx: it obeys no command, and one is given"):
        Policy(tmp_path / "stand.onnx", command=lambda x, k: x[:, :3])


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ("stance", "--starts walk is for walk, and for it alone"),
        ("recorded", "--starts walk is for walk, and for it alone"),
    ],
)
def test_measurements_that_do_not_fit(walker, starts, message):
    with pytest.raises(ValueError, match=message):
        evaluate.set_up(evaluate.Args(walker[1], starts=starts))


@torch.no_grad()
def test_a_walk_is_measured_against_its_commands(walker, monkeypatch):
    """A robot that stands still walks as told only if it was told next to nothing."""
    monkeypatch.setitem(evaluate.PROTOCOLS, "walk", (0.2, 1.0))
    args = evaluate.Args(walker[1], starts="walk", episodes=6)
    torch.manual_seed(1)
    policy, starts = evaluate.set_up(args)
    assert policy.command is not None
    told = policy.command(torch.zeros(6, 37), torch.zeros(6))
    told[0] = 0.0
    monkeypatch.setattr(Policy, "act", lambda self, x, u, memory, k: (REST[:, 7:19].expand(6, 12), memory))
    good, found = evaluate.measured(policy, starts, "walk", 6, evaluate.conditions_of(None), 1)
    assert good[0], "it was told to stand"
    assert found.held.all()
    astray = (found.velocity - told)[:, :2].norm(dim=1) > evaluate.ASTRAY
    assert astray.any()
    assert not good[astray].any()


def test_a_trot_is_one_diagonal_pair():
    gap = {name: value.repeat(5, *[1] * (value.ndim - 1)) for name, value in go2.clearances(REST).items()}
    up = torch.tensor([[0, 1, 1, 0], [1, 0, 0, 1], [1, 1, 0, 0], [0, 0, 0, 0], [1, 1, 1, 1]])
    gap["foot"] = 0.05 * up.double()
    x, told, none = (
        REST.repeat(5, 1),
        torch.tensor([[0.5, 0.0, 0.0]]).repeat(5, 1).double(),
        torch.zeros(5, 4),
    )
    u = x[:, 7:19]
    found = legs_rewards(ONES, x, x, u, u, told, told, none, 0 * u, go2.DT, gap)["trot"]
    assert found.tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]
    assert not legs_rewards(ONES, x, x, u, u, 0 * told, 0 * told, none, 0 * u, go2.DT, gap)["trot"].any()
