"""The policy without modes: what it is asked for, when it is told to flip, and how it is judged."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from hmc.go2 import model as go2
from hmc.go2.facts import OBS_SIZE
from hmc.go2.network import Network
from hmc.go2.observe import pitch
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from tests.tiny import STARTS, make_runner
from train import evaluate, make, play
from train.config import PpoCfg, UnifiedTraining
from train.export import actor_of, export
from train.rewards import stage_rewards
from train.runner import read_checkpoint
from train.starts import KINDS, RECORDED, STANCE, WAY, StartsCfg
from train.unified import FLIP, GoalPpo, UnifiedCfg, UnifiedEnv, UnifiedStarts

CPU = torch.device("cpu")
STANCES = StartsCfg(stance=1.0, home=0.0)
HAND = len(KINDS)  # the first kind of start of the handstand
CFG = UnifiedCfg("unified", worlds=8, footstand=STANCES, handstand=STANCES, told=(0.2, 0.2))


def make_env(cfg: UnifiedCfg = CFG) -> UnifiedEnv:
    env = make.make_env(cfg, "mujoco", threads=1)
    assert isinstance(env, UnifiedEnv)
    return env


def opened(starts: UnifiedStarts) -> UnifiedStarts:
    """The same, its foot stand held, its handstand reached from everywhere."""
    starts.stances[0].rates[STANCE] = 0.9
    starts.stances[1].success[:] = 1.0
    return starts


def test_what_is_asked_for_is_where_it_begins_or_the_other_one():
    torch.manual_seed(0)
    env = make_env(UnifiedCfg("unified", worlds=50, footstand=STANCES, handstand=STANCES))
    env.starts.stances[0].rates[STANCE] = 0.9
    env._reset(torch.arange(50))
    foot = env._kind == STANCE
    assert foot.tolist() == [True] * 20 + [False] * 30
    assert torch.equal(env.command[:, 0], torch.where(foot, -1.0, 1.0))
    assert torch.equal(pitch(env._x) > 0, ~foot)
    for group in env.get_observations().values():
        assert torch.equal(group[:, OBS_SIZE], env.command[:, 0])


def test_what_cannot_be_learned_yet_is_not_asked_for():
    torch.manual_seed(1)
    starts = UnifiedStarts(CFG, CPU)
    starts.goals = torch.arange(300) % 3
    assert starts.draw(300).kind.tolist() == [STANCE] * 300
    starts.stances[0].rates[STANCE] = 0.51
    assert starts.draw(300).kind.tolist() == [STANCE, HAND + STANCE, HAND + STANCE] * 100
    start = opened(starts).draw(300)
    assert start.kind.tolist() == [STANCE, HAND + STANCE, FLIP] * 100
    assert (pitch(start.x[::3]) < -1).all()
    assert (pitch(start.x[1::3]) > 1).all()
    assert (pitch(start.x[2::3]) < -1).all()
    assert float(starts.shares.sum()) == pytest.approx(1.0)
    assert len(starts.shares) == len(starts.rates) == len(starts.kinds) == FLIP + 1


def test_each_stance_learns_from_its_own_episodes():
    cfg = UnifiedCfg("unified", footstand=STARTS, handstand=STARTS)
    starts = UnifiedStarts(cfg, CPU)
    kinds = torch.tensor([WAY, HAND + WAY, HAND + STANCE, FLIP])
    starts.report(
        kinds, torch.tensor([3, 5, 0, 0]), torch.tensor([True, False, True, True]), torch.ones(4).bool()
    )
    foot, hand = starts.stances
    assert foot.success.flatten()[3] == pytest.approx(0.05)
    assert not hand.success.any()
    moved = {kind: float(starts.rates[kind]) for kind in kinds.tolist()}
    once = pytest.approx(0.005, rel=1e-3)
    assert moved == {WAY: once, HAND + WAY: 0.0, HAND + STANCE: once, FLIP: once}
    again = UnifiedStarts(cfg, CPU)
    again.load_state_dict(starts.state_dict())
    assert torch.equal(again.rates, starts.rates)
    assert torch.equal(again.stances[0].success, foot.success)


def test_rewards_are_those_of_the_stance_that_is_asked_for():
    env = make_env()
    x = torch.stack([HANDSTAND.state()] * 4 + [FOOTSTAND.state()] * 4).float()
    env.command = torch.tensor([[1.0], [-1.0]] * 4)
    u = x[:, 7:19]
    gap = go2.clearances(x)
    found = env.rewards(x, x, u, u, gap)
    for world, goal in enumerate((HANDSTAND, FOOTSTAND) * 4):
        expected = stage_rewards(env.cfg.rewards, goal, x, x, u, u, env._anchor, env.sim.dt, gap)
        for name, term in found.items():
            assert term[world] == expected[name][world], name
    held = [True, False, True, False, False, True, False, True]
    env.command = torch.tensor([[1.0], [-1.0]] * 4)
    assert env.good(x, gap).tolist() == held


def test_a_flip_is_told_once_and_has_its_own_grace_time():
    env = make_env()
    env._kind[:], env._kind[4:] = FLIP, STANCE
    env.command[:], env._told[:] = -1.0, 10
    x = FOOTSTAND.state().float().repeat(8, 1)
    low = x.clone()
    low[:, 2] -= 0.2
    gap = {name: each.abs() + 0.1 for name, each in go2.clearances(x).items()}
    flips = [True] * 4 + [False] * 4
    for step in range(1, 120):
        env.episode_length_buf[:] = step
        env.rewards(x, x, x[:, 7:19], x[:, 7:19], gap)
        told = step >= 10
        assert env.command[:, 0].tolist() == [1.0 if told and flip else -1.0 for flip in flips]
        late = (step - 10) * env.sim.dt > env.cfg.grace
        assert env.fallen(x, gap).tolist() == [told and late and flip for flip in flips], step
        # one that began in the stance that it is to hold falls at once
        assert env.fallen(low, gap).tolist() == [not told or late or not flip for flip in flips]


def test_advantages_of_each_goal_have_its_own_scale(tmp_path):
    ppo = PpoCfg(hidden=(16, 8), steps=6, epochs=1, minibatches=2, algorithm="train.unified:GoalPpo")
    runner = make_runner(tmp_path, UnifiedTraining(CFG, ppo))
    storage = runner.alg.storage
    assert isinstance(runner.alg, GoalPpo)
    command = torch.tensor([1.0, -1.0] * 4).expand(6, 8)
    storage.observations["policy"][..., OBS_SIZE] = command
    storage.rewards[:] = torch.randn(6, 8, 1) * torch.where(command > 0, 50.0, 0.1)[..., None]
    storage.dones[:], storage.values[:] = 0, 0.0
    runner.alg.compute_returns(runner.env.get_observations())
    for goal in (-1.0, 1.0):
        own = storage.advantages[..., 0][command == goal]
        assert float(own.mean()) == pytest.approx(0.0, abs=1e-5)
        assert float(own.std(unbiased=False)) == pytest.approx(1.0, abs=1e-4)
        returns = storage.returns[..., 0][command == goal]
        assert torch.equal(own.argsort(), returns.argsort()), "what is better stays better"
    command = torch.full((6, 8), 1.0)
    command[2, 3] = -1.0
    storage.observations["policy"][..., OBS_SIZE] = command
    runner.alg.compute_returns(runner.env.get_observations())
    assert storage.advantages.isfinite().all(), "a goal of one sample has no scale"
    assert storage.advantages[2, 3] == 0


def test_it_is_trained_exported_and_played(tmp_path):
    ppo = PpoCfg(hidden=(16, 8), steps=6, epochs=1, minibatches=2, mirror=0.5)
    cfg = UnifiedTraining(CFG, ppo)
    runner = make_runner(tmp_path, cfg)
    before = [parameter.clone() for parameter in runner.alg.actor.parameters()]
    runner.learn(2)
    assert any(not torch.equal(*pair) for pair in zip(before, runner.alg.actor.parameters(), strict=True))
    checkpoint = tmp_path / "model_0.pt"
    runner.save(str(checkpoint))
    with pytest.raises(ValueError, match="of mode unified judges a state and a command"):
        export(checkpoint, tmp_path / "value.onnx", value=True)
    assert not list(tmp_path.glob("*.onnx"))
    export(checkpoint, tmp_path / "unified.onnx")
    assert [path.name for path in tmp_path.glob("*.onnx")] == ["unified.onnx"]
    env = runner.env
    obs = env.get_observations()["policy"]
    with torch.no_grad():
        expected = env.targets(actor_of(read_checkpoint(checkpoint))(TensorDict({"policy": obs}, [len(obs)])))
    network = Network(tmp_path / "unified.onnx")
    output = torch.from_numpy(network.run(obs.numpy()))
    found = (torch.from_numpy(network.pose) + network.scale * output).clamp(go2.Q_LOWER, go2.Q_UPPER)
    torch.testing.assert_close(found.float(), expected, atol=1e-5, rtol=0)
    line = play.play(checkpoint, "unified", tmp_path, seconds=0.3, threads=1)
    assert line.startswith("unified: held for")
    with pytest.raises(ValueError, match=r"unified\.onnx is of unified, which .* tools/table2\.py"):
        evaluate.set_up(evaluate.Args(tmp_path / "unified.onnx"))


def test_targets_are_about_the_pose_of_the_stance_that_is_asked_for():
    env = make_env()
    env.command = torch.tensor([[1.0], [-1.0]] * 4)
    for world, target in enumerate(env.targets(torch.zeros(8, 12))):
        torch.testing.assert_close(target, (FOOTSTAND if world % 2 else HANDSTAND).pose.float())


def test_kinds_have_names():
    assert UnifiedStarts.kinds[HAND + RECORDED] == "handstand_recorded"
    assert UnifiedStarts.kinds[FLIP] == "flip"
