"""The stance environment: observations, terminations, starts and their curriculum."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.conditions import NoiseCfg
from hmc.go2.facts import OBS_SIZE
from hmc.go2.observe import observe, pitch
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STANCES
from tests.tiny import CFG, make_env
from tools.random_policy import write_random_policy
from train import evaluate
from train.starts import HOME, KINDS, RECORDED, STANCE, WAY, Starts, StartsCfg

CPU = torch.device("cpu")
ONLY_STANCE = replace(CFG.env, starts=StartsCfg(stance=1.0, home=0.0), episode_steps=100)


def put(env, world: int, x: torch.Tensor, kind: int = STANCE) -> None:
    """Move one world to a state, its joints held there."""
    ids = torch.tensor([world])
    env.sim.reset(x[None], x[None, 7:19], ids)
    env._x, env._u = env._x.clone(), env._u.clone()
    env._x[world], env._u[world], env._kind[world] = x.float(), x[7:19].float(), kind
    env._anchor[world, :2] = 0.0


def holding(env, x: torch.Tensor) -> torch.Tensor:
    """Actions (worlds, 12) that hold the joints of x."""
    action = (x[7:19].float() - env._pose) / env.cfg.action_scale
    return action.expand(env.num_envs, 12)


def test_shapes():
    env = make_env()
    obs = env.get_observations()
    assert {name: tuple(group.shape) for name, group in obs.items()} == {"policy": (8, 48), "critic": (8, 61)}
    obs, reward, done, extras = env.step(torch.zeros(8, 12))
    assert (obs["policy"].shape, obs["critic"].shape) == ((8, OBS_SIZE), (8, OBS_SIZE + 13))
    assert obs["policy"].dtype == obs["critic"].dtype == torch.float32
    assert (reward.shape, done.shape, extras["time_outs"].shape) == ((8,), (8,), (8,))
    assert done.dtype == extras["time_outs"].dtype == torch.bool
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (8, 12, 20)
    terms = [name for name in extras["log"] if name.startswith("/reward/")]
    assert len(terms) == 12
    assert {name for name in extras["log"] if name.startswith("/success/")} == {
        "/success/stance", "/success/way", "/success/home", "/success/frontier",
    }  # fmt: skip


def test_noise_is_the_actors_alone():
    env = make_env()
    obs = env.get_observations()
    clean = observe(env._x, env._u, env._anchor)
    assert torch.equal(obs["critic"][:, :OBS_SIZE], clean)
    assert torch.equal(obs["critic"][:, -1], env._x[:, 2])
    torque = go2.motor_torque(env._x[:, 7:19], env._x[:, 25:37], env._u)
    assert torch.equal(obs["critic"][:, OBS_SIZE:-1], 0.1 * torque)
    noise, width = obs["policy"] - clean, NoiseCfg()
    widths = [width.gravity] * 3 + [width.position] * 3 + [width.velocity] * 3 + [width.gyro] * 3
    widths += [width.joint] * 12 + [width.joint_speed] * 12
    assert (noise[:, :36].abs() <= torch.tensor(widths) * 1.001 + 1e-6).all()
    assert (noise[:, :36] != 0).float().mean() > 0.99
    assert not noise[:, 36:].any(), "the robot knows its own last action"


def test_observations_are_those_after_the_reset_and_stay_as_they_are():
    env = make_env(replace(CFG.env, episode_steps=3))
    obs = env.get_observations()
    for _ in range(3):
        kept, copy = obs, obs.clone()
        obs, _, done, _ = env.step(0.1 * torch.randn(8, 12))
        assert torch.equal(kept["policy"], copy["policy"])
        assert torch.equal(kept["critic"], copy["critic"])
    assert done.all()
    assert not env.episode_length_buf.any()
    torch.testing.assert_close(obs["critic"][:, -1], env.sim.x()[:, 2].float())
    torch.testing.assert_close(obs["critic"][:, 36:48], env.sim.u().float())
    assert not torch.equal(obs["critic"], copy["critic"])


def test_targets_stay_inside_the_joint_limits():
    env = make_env()
    assert torch.equal(env.targets(torch.zeros(8, 12)), HANDSTAND.pose.expand(8, 12))
    assert torch.allclose(env.targets(torch.full((8, 12), 0.1)), HANDSTAND.pose + 0.05)
    for sign in (-1, 1):
        targets = env.targets(torch.full((8, 12), 100.0 * sign))
        assert torch.equal(targets, (go2.Q_UPPER if sign > 0 else go2.Q_LOWER).expand(8, 12))


def tilted(degrees: float, height: float = 0.8) -> torch.Tensor:
    """A handstand off the vertical, in the air."""
    x = HANDSTAND.state()
    half = math.pi / 4 + math.radians(degrees) / 2
    x[2], x[3], x[5] = height, math.cos(half), math.sin(half)
    return x


def test_terminations():
    env = make_env(ONLY_STANCE)
    lying = torch.zeros(37, dtype=torch.float64)
    lying[2], lying[3], lying[7:19] = 0.05, 1.0, go2.HOME
    four_legs = torch.zeros(37, dtype=torch.float64)
    four_legs[2], four_legs[3], four_legs[7:19] = 0.29, 1.0, go2.HOME
    put(env, 0, HANDSTAND.state())
    put(env, 1, lying, HOME)
    put(env, 2, four_legs, HOME)
    put(env, 3, four_legs, STANCE)
    put(env, 4, tilted(60), STANCE)
    put(env, 5, tilted(60), WAY)
    put(env, 6, tilted(45), STANCE)
    put(env, 7, four_legs, HOME)
    env.episode_length_buf[:] = 0
    env.episode_length_buf[7] = 75  # 1.5 s
    actions = holding(env, HANDSTAND.state()).clone()
    for world in (1, 2, 3, 7):
        actions[world] = holding(env, four_legs)[0]
    _, reward, done, extras = env.step(actions)
    assert done.tolist() == [
        False,  # stands
        True,  # its trunk is on the ground
        False,  # has time to get up
        True,  # began in the stance: no longer is
        True,  # tilted by more than 53 degrees, where it should stand
        False,  # on its way there
        False,  # tilted by less
        True,  # its time to get up is over
    ]
    assert not extras["time_outs"].any()
    assert (reward[[1, 3, 4, 7]] < -0.9).all(), "a fall costs 1, once"
    assert (reward[[0, 2, 5, 6]] >= 0).all()
    assert reward[0] > reward[6] > reward[2], "standing, tilted, on four legs"
    assert (env.episode_length_buf == 0).tolist() == done.tolist()


def test_a_time_out_is_no_fall():
    env = make_env(ONLY_STANCE)
    for world in range(8):
        put(env, world, HANDSTAND.state())
    env.episode_length_buf[:4] = ONLY_STANCE.episode_steps - 1
    env.starts.rates.zero_()
    _, reward, done, extras = env.step(holding(env, HANDSTAND.state()))
    assert done.tolist() == extras["time_outs"].tolist() == [True] * 4 + [False] * 4
    assert (reward > 0).all()
    assert env.starts.rates[STANCE] == pytest.approx(1 - 0.995**4, rel=1e-4), "four successes"
    assert extras["log"]["/episode/length"] == ONLY_STANCE.episode_steps


@pytest.mark.parametrize("where", ["state", "action"])
def test_a_broken_world_is_left_alone(where):
    """It ends with no reward; the others see nothing of it."""
    envs = []
    for broken in (False, True):
        torch.manual_seed(5)
        env = make_env(ONLY_STANCE)
        actions = 0.1 * torch.randn(8, 12)
        if broken and where == "state":
            row = env.sim.x()[3:4]
            row[0, 20] = math.nan
            env.sim.reset(row, env.sim.u()[3:4], torch.tensor([3]))
        elif broken:
            actions[3] = math.nan
        envs.append((env, env.step(actions)))
    (_, (obs, reward, done, _)), (env, (obs_, reward_, done_, extras)) = envs
    others = [i for i in range(8) if i != 3]
    assert torch.equal(reward_[others], reward[others])
    assert torch.equal(done_[others], done[others])
    assert torch.equal(obs_["critic"][others], obs["critic"][others])
    assert done_[3]
    assert reward_[3] == 0
    assert not extras["time_outs"][3]
    assert extras["log"]["/diverged"] == 1
    assert obs_["policy"].isfinite().all()
    assert all(torch.as_tensor(value).isfinite().all() for value in extras["log"].values())
    assert env.sim.x().isfinite().all(), "it was reset"
    _, reward, _, extras = env.step(torch.zeros(8, 12))
    assert reward.isfinite().all()
    assert extras["log"]["/diverged"] == 0


@pytest.mark.parametrize("kind", ["stance", "way", "home"])
@pytest.mark.parametrize("mode", STANCES)
def test_kinds_of_starts(mode, kind):
    shares = {"stance": 0.0, "way": 0.0, "home": 0.0, kind: 1.0}
    stance = STANCES[mode]
    starts = Starts(stance, StartsCfg(**shares, furthest=-1.0), CPU, unlocked=True)
    start = starts.sample(300)
    assert (start.x.shape, start.u.shape) == ((300, 37), (300, 12))
    assert (start.kind == KINDS.index(kind)).all()
    torch.testing.assert_close(start.x[:, 3:7].norm(dim=1), torch.ones(300))
    for joints in (start.x[:, 7:19], start.u):
        assert ((joints >= go2.Q_LOWER) & (joints <= go2.Q_UPPER)).all()
    gap = go2.clearances(start.x)
    lowest = torch.cat([gap["foot"], gap["thigh"], gap["calf"], gap["trunk"][:, None]], 1).amin(1)
    assert (lowest > 0).all(), "nothing begins inside the floor"
    assert (lowest < 0.0011).float().mean() > (0.3 if kind == "way" else 0.99)
    angle = stance.sign * pitch(start.x)
    if kind == "stance":
        assert (angle - math.pi / 2).abs().max() < 0.5
        assert stance.held(start.x).float().mean() > 0.5
    elif kind == "home":
        assert angle.abs().max() < 0.5
        torch.testing.assert_close(start.x[:, 7:19], go2.HOME.expand(300, 12), atol=0.11, rtol=0)


def test_states_on_the_way_turn_towards_the_stance():
    for stance in STANCES.values():
        starts = Starts(stance, StartsCfg(stance=0, way=1, home=0, furthest=-1.0), CPU, unlocked=True)
        starts.success.fill_(0.5)  # every cell is open
        x = starts.sample(2000).x
        assert (stance.sign * x[:, 23]).mean() > 0.5
        angle = stance.sign * pitch(x)
        assert angle.min() < -1.0
        assert angle.max() > 1.0


def test_recorded_starts(tmp_path):
    x, u = torch.randn(3, 37), torch.randn(3, 12)
    torch.save({"x": x, "u": u}, tmp_path / "flips.pt")
    cfg = StartsCfg(stance=0.5, home=0.0, recorded=0.5, records=str(tmp_path / "flips.pt"))
    start = Starts(HANDSTAND, cfg, CPU, unlocked=True).sample(200)
    mine = start.kind == RECORDED
    assert 60 < mine.sum() < 140
    pairs = torch.cat([x, u], 1)
    for row in torch.cat([start.x, start.u], 1)[mine]:
        assert (row == pairs).all(1).any(), "a state with its own input"


def test_a_measurement_takes_each_recorded_state_once(tmp_path):
    policy = write_random_policy(tmp_path / "random.onnx", hidden=(8,))
    x = torch.randn(5, 37)
    torch.save({"x": x, "u": torch.randn(5, 12)}, tmp_path / "flips.pt")
    args = evaluate.Args(policy, starts="recorded", records=tmp_path / "flips.pt", episodes=5)
    starts = evaluate.set_up(args)[1]
    torch.testing.assert_close(starts.sample(5).x.float(), x)
    with pytest.raises(ValueError, match=r"flips\.pt has 5 states, too few for 6 episodes"):
        evaluate.set_up(replace(args, episodes=6))


def test_successes_by_moment():
    good = torch.tensor([True, False, True, True])
    found = evaluate.by_moment(good, torch.tensor([13, 20, 20, 13, 7]))  # the last one is of no episode
    assert {moment: (part.success, part.episodes) for moment, part in found.items()} == {
        13: (2, 2),
        20: (1, 2),
    }


def test_recorded_starts_need_their_file(tmp_path):
    with pytest.raises(ValueError, match=r"starts\.recorded > 0 needs starts\.records"):
        Starts(HANDSTAND, StartsCfg(recorded=0.5), CPU)
    with pytest.raises(ValueError, match=r"no such file .*gone\.pt: make one with"):
        Starts(HANDSTAND, StartsCfg(recorded=0.5, records=str(tmp_path / "gone.pt")), CPU)


def test_four_legs_wait_until_the_stance_is_held():
    starts = Starts(FOOTSTAND, StartsCfg(stance=0.5, way=0.0, home=0.5), CPU)
    assert (starts.sample(200).kind == STANCE).all()
    starts.rates[STANCE] = 0.9
    assert 60 < (starts.sample(200).kind == HOME).sum() < 140


def test_four_legs_wait_until_the_way_is_open_to_nearly_horizontal():
    starts = Starts(FOOTSTAND, StartsCfg(stance=0.4, way=0.3, home=0.3), CPU)
    starts.rates[STANCE] = 0.9
    starts.success[6] = 0.9
    assert not (starts.sample(200).kind == HOME).any()
    starts.success[7, 2] = 0.9
    assert 20 < (starts.sample(200).kind == HOME).sum() < 100


def test_a_place_that_is_not_on_the_grid_is_named():
    with pytest.raises(ValueError, match=r"starts\.furthest must be .*got 0\.55"):
        Starts(HANDSTAND, StartsCfg(furthest=0.55), CPU)


def test_cells_open_next_to_mastered_ones():
    starts = Starts(HANDSTAND, StartsCfg(way=1.0), CPU)
    places, energies = starts.places, starts.ENERGIES
    first = torch.zeros(places, energies, dtype=torch.bool)
    first[:2] = True
    assert torch.equal(starts.weights() > 0, first), "in the beginning, those next to the stance"
    starts.success[6, 3] = 0.8
    near = first.clone()
    near[5:8, 2:5] = True
    assert torch.equal(starts.weights() > 0, near)
    starts.success[6, 3] = 0.3
    assert torch.equal(starts.weights() > 0, first), "not mastered"
    starts.success[0] = torch.linspace(0, 1, energies)
    weights = starts.weights()[0]
    assert weights.argmax() == energies // 2, "half mastered ones are drawn most"
    assert weights.min() > 0


def test_reports_move_the_right_entries():
    starts = Starts(HANDSTAND, StartsCfg(way=0.5), CPU)
    cell = torch.tensor([5, 5, 12, 5, 3, 12, 9999])
    kind = torch.tensor([WAY, WAY, WAY, STANCE, STANCE, WAY, WAY])
    ended = torch.tensor([True] * 5 + [False] * 2)
    starts.report(kind, cell, torch.tensor([True, False, True, True, True, True, True]), ended)
    expected = torch.zeros(starts.places * starts.ENERGIES)
    expected[5] = (1 - 0.95**2) * 0.5
    expected[12] = 1 - 0.95
    torch.testing.assert_close(starts.success.flatten(), expected)
    rates = [1 - 0.995**2, (1 - 0.995**3) * 2 / 3, 0, 0]
    torch.testing.assert_close(starts.rates, torch.tensor(rates))


def test_frontier():
    starts = Starts(HANDSTAND, StartsCfg(way=1.0, furthest=-1.0), CPU)
    assert starts.frontier() == 1.0
    starts.success[4, 2] = 0.9
    assert starts.frontier() == pytest.approx(1.0 - 5 * starts.WIDTH)
    starts.success[-1, 0] = 0.9
    assert starts.frontier() == pytest.approx(-1.0)


def test_starts_drawn_in_advance_come_once_and_in_order():
    starts = Starts(HANDSTAND, StartsCfg(stance=0.5, way=0.5, home=0.0), CPU)
    torch.manual_seed(3)
    parts = [starts.draw(n) for n in (1, 5, 100, 150, 3)]
    torch.manual_seed(3)
    whole = starts.sample(starts.AHEAD)
    torch.testing.assert_close(torch.cat([part.x for part in parts[:4]]), whole.x)
    assert torch.equal(torch.cat([part.kind for part in parts[:4]]), whole.kind)
    assert len(parts[4].x) == 3
    assert len(starts.draw(1000).x) == 1000


def test_a_resumed_curriculum_draws_its_own_starts():
    starts = Starts(HANDSTAND, StartsCfg(stance=0.5, way=0.5, home=0.0), CPU)
    starts.draw(1)
    far = starts.state_dict()
    starts.load_state_dict({**far, "success": torch.ones_like(far["success"])})
    assert starts.draw(200).cell.max() >= 2 * starts.ENERGIES, "cells that were closed before"
