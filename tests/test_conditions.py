"""Robots that are not the model: variants, mirror images, noise that lasts, zeros and pushes in training."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.conditions import Conditions, NoiseCfg, Robots, pushed
from hmc.go2.mirror import mirror_joints, mirror_observation
from hmc.go2.observe import anchor_of, observe
from hmc.go2.policy import Policy
from hmc.go2.stances import HANDSTAND
from hmc.go2.variants import Variant, VariantsCfg, draw
from hmc.sim.mujoco import MujocoSim
from tests.tiny import CFG, make_env, make_runner
from tools.random_policy import write_random_policy
from train import evaluate
from train.env import both_sides
from train.starts import Starts, StartsCfg

WIDE = VariantsCfg(
    friction=(0.4, 1.2),
    payload=(-1.0, 2.0),
    com=0.03,
    strength=(0.9, 1.1),
    stiffness=(0.8, 1.2),
    damping=(0.5, 1.5),
    latency=(0.0, 0.02),
    zeros=0.01,
)


def mirrored(x: torch.Tensor) -> torch.Tensor:
    """States (n, 37) reflected in the plane y = 0."""
    flip = x.new_tensor([1.0, -1.0, 1.0])
    quat = x[:, 3:7] * x.new_tensor([1.0, -1.0, 1.0, -1.0])
    return torch.cat(
        [
            x[:, :3] * flip,
            quat,
            mirror_joints(x[:, 7:19]),
            x[:, 19:22] * flip,
            -x[:, 22:25] * flip,
            mirror_joints(x[:, 25:37]),
        ],
        1,
    )


def test_the_mirror_image_of_a_motion_is_the_motion_of_the_mirror_image():
    """Of a robot whose trunk weighs the same on both sides, in flight and on its feet."""
    model = Variant().model()
    model.body_ipos[1, 1], model.body_iquat[1] = 0.0, (1, 0, 0, 0)
    for left, right in (("FL", "FR"), ("RL", "RR")):
        for part in ("hip", "thigh", "calf"):
            a, b = model.body(f"{left}_{part}").id, model.body(f"{right}_{part}").id
            model.body_inertia[[a, b]] = model.body_inertia[a].mean()
            model.body_iquat[[a, b]] = (1, 0, 0, 0)
            model.body_ipos[b] = model.body_ipos[a] * (1, -1, 1)
    torch.manual_seed(0)
    x = HANDSTAND.state().repeat(4, 1)
    x[:, 7:19] += 0.2 * torch.randn(4, 12)
    x[:, 2] += torch.tensor([0.0, 0.01, 0.3, 0.3])
    x[:, 19:] = 0.5 * torch.randn(4, 18)
    u = x[:, 7:19] + 0.3 * torch.randn(4, 12)
    sim, other = (MujocoSim(model, 4, threads=1) for _ in range(2))
    sim.reset(x, u)
    other.reset(mirrored(x), mirror_joints(u))
    for _ in range(5):
        sim.step(u)
        other.step(mirror_joints(u))
    torch.testing.assert_close(mirrored(sim.x()), other.x(), atol=1e-5, rtol=1e-5)
    seen = observe(sim.x(), u, anchor_of(x))
    image = observe(other.x(), mirror_joints(u), anchor_of(mirrored(x)))
    torch.testing.assert_close(mirror_observation(seen), image, atol=1e-5, rtol=1e-5)


def test_a_mirror_image_twice_is_the_thing_itself():
    obs = torch.randn(5, 48)
    assert torch.equal(mirror_observation(mirror_observation(obs)), obs)
    assert not torch.equal(mirror_observation(obs), obs)


def test_both_sides_of_what_the_networks_see():
    env = make_env()
    obs, actions = env.get_observations(), torch.randn(8, 12)
    seen, done = both_sides(env, obs, actions)
    assert seen is not None
    assert done is not None
    assert torch.equal(seen["policy"][8:], mirror_observation(obs["policy"]))
    torque = go2.motor_torque(*(mirror_joints(each) for each in (env._x[:, 7:19], env._x[:, 25:37], env._u)))
    torch.testing.assert_close(seen["critic"][8:, 48:60], 0.1 * torque)
    assert torch.equal(seen["critic"][8:, 60], env._x[:, 2])
    assert torch.equal(seen["critic"][:8], obs["critic"])
    assert torch.equal(done[:8], actions)
    assert torch.equal(done[8:], mirror_joints(actions))


def test_training_with_a_mirror(tmp_path):
    """What the weight adds to the loss makes the actor more alike to its mirror image."""
    gap = []
    for mirror in (0.0, 100.0):
        torch.manual_seed(1)
        runner = make_runner(tmp_path, replace(CFG, ppo=replace(CFG.ppo, mirror=mirror, learning_rate=3e-3)))
        runner.last_iteration = 20
        runner.learn(20)
        obs, _ = both_sides(runner.env, runner.env.get_observations(), None)
        assert obs is not None
        with torch.no_grad():
            actions = runner.alg.actor(obs)
        gap.append((mirror_joints(actions[:8]) - actions[8:]).square().mean())
    assert gap[1] < 0.2 * gap[0]


def test_variants_are_drawn_within_their_ranges_and_alike_for_a_seed():
    robots = draw(WIDE, 200, torch.Generator().manual_seed(3))
    assert robots == draw(WIDE, 200, torch.Generator().manual_seed(3))
    for name in ("friction", "payload", "strength", "stiffness", "damping", "latency"):
        low, high = getattr(WIDE, name)
        values = torch.tensor([getattr(robot, name) for robot in robots])
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    for name, size in (("com", 3), ("zeros", 12)):
        values = torch.tensor([getattr(robot, name) for robot in robots])
        assert values.shape == (200, size)
        assert 0.9 * getattr(WIDE, name) < values.abs().max() <= getattr(WIDE, name)
    assert {robot.late() for robot in robots} == {0, 1, 2, 3, 4}
    (nominal,) = draw(VariantsCfg(), 1, torch.Generator())
    assert nominal == Variant()
    one = replace(WIDE, friction=(0.8, 0.8))
    others = draw(one, 200, torch.Generator().manual_seed(3))
    assert [robot.zeros for robot in others] == [robot.zeros for robot in robots], (
        "a range touches only its own"
    )


@pytest.mark.parametrize("stiffness", [0.8, 1.2])
def test_gains_of_the_servo(stiffness):
    sim = MujocoSim(Variant(stiffness=stiffness).model(), 1, substeps=1, threads=1)
    x = HANDSTAND.state()[None]
    x[:, 2] += 1.0
    sim.reset(x, x[:, 7:19])
    sim.step(x[:, 7:19] + 0.1)
    assert sim.actuator_force()[0, 0] == pytest.approx(0.1 * go2.KP * stiffness, rel=1e-6)


def test_a_robot_obeys_its_own_zeros():
    """With all that it measures and obeys shifted alike, it moves as another one does and sees the shift."""
    zeros = torch.linspace(-0.01, 0.01, 12)
    cfg = replace(CFG.env, conditions=Conditions(noise=NoiseCfg(0, 0, 0, 0, 0, 0)))
    envs = []
    for shift in (torch.zeros(12), zeros):
        torch.manual_seed(5)
        env = make_env(cfg)
        env._zeros[:] = shift
        env._u = env._u + shift
        envs.append(env)
    for _ in range(3):
        actions = torch.zeros(8, 12)
        for env, shift in zip(envs, (torch.zeros(12), zeros), strict=True):
            torch.manual_seed(6)
            env.step(actions + shift / env.cfg.action_scale)
    plain, shifted = (env.get_observations() for env in envs)
    torch.testing.assert_close(envs[1]._x, envs[0]._x, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(
        shifted["policy"][:, 12:24] - plain["policy"][:, 12:24], zeros.expand(8, 12), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(shifted["critic"][:, 12:24], plain["critic"][:, 12:24], atol=1e-5, rtol=1e-5)


def test_noise_that_lasts_stays_for_an_episode():
    cfg = replace(CFG.env, episode_steps=3, conditions=Conditions(noise=NoiseCfg(lasting=1.0)))
    env = make_env(cfg)
    env.episode_length_buf[:] = 0

    def noise() -> torch.Tensor:
        return env.get_observations()["policy"] - observe(env._x, env._u, env._anchor)

    first = noise()
    assert first[:, :36].abs().max() > 0
    torch.testing.assert_close(noise(), first)
    for _ in range(3):
        env.step(torch.zeros(8, 12))
    assert not torch.isclose(noise()[:, :36], first[:, :36]).all(1).any(), "all episodes have ended"


def test_pushes_come_as_often_and_as_hard_as_asked():
    cfg = replace(
        CFG.env,
        worlds=64,
        episode_steps=1000,
        conditions=Conditions(push=0.5, push_every=0.1),
        starts=replace(CFG.env.starts, stance=1.0, way=0.0, home=0.0, tilt=0.0, speed=0.0, joints=0.0),
    )
    env, still = make_env(cfg), make_env(replace(cfg, conditions=Conditions()))
    x = HANDSTAND.state().repeat(64, 1)
    for each in (env, still):
        each.sim.reset(x, x[:, 7:19])
        each._x = x.float()
        each.step(torch.zeros(64, 12))
    kick = (env._x - still._x)[:, 19:22]
    hit = kick.norm(dim=1) > 0
    assert 64 * 0.2 * 0.3 < hit.sum() < 64 * 0.2 * 2.5
    assert 0.2 < kick[hit].norm(dim=1).max() <= 0.5 + 1e-6
    assert not kick[:, 2].any()
    assert torch.equal(env.sim.x().float()[:, 19:22], env._x[:, 19:22]), "the engine is pushed as well"


def test_robots_obey_and_measure_with_their_own_zeros():
    """Told their state as they measure it, and asked to stay there, they stay where they are."""
    zeros, x = VariantsCfg(zeros=0.01), HANDSTAND.state().repeat(6, 1)
    x[:, 2] += 1.0
    shifted = Robots(Conditions(zeros, NoiseCfg.none()), x, x[:, 7:19], seed=1)
    plain = Robots(Conditions(noise=NoiseCfg.none()), x, x[:, 7:19], seed=1)
    assert torch.equal(plain.estimate(), x)
    shift = shifted.estimate() - x
    assert torch.equal(shift[:, :7], torch.zeros(6, 7).double())
    assert 0.005 < shift[:, 7:19].abs().max() <= 0.01
    for _ in range(5):
        plain.step(x[:, 7:19] + 0.2)
        shifted.step(x[:, 7:19] + 0.2 + shift[:, 7:19])
    torch.testing.assert_close(shifted.x, plain.x, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(shifted.u, x[:, 7:19] + 0.2 + shift[:, 7:19])


def test_estimates_are_off_by_no_more_than_the_noise():
    noise = NoiseCfg(0.02, 0.03, 0.1, 0.05, 0.004, 0.2, lasting=0.5)
    x = HANDSTAND.state().repeat(300, 1)
    robots = Robots(Conditions(noise=noise), x, x[:, 7:19], seed=2)
    first, second = robots.estimate(), robots.estimate()
    widths = [0.03] * 3 + [0.004] * 12 + [0.1] * 3 + [0.05] * 3 + [0.2] * 12
    for found in (first, second):
        error = (found - x)[:, [*range(3), *range(7, 37)]].abs().amax(0)
        assert (error <= torch.tensor(widths) + 1e-12).all()
        assert (error > 0.8 * torch.tensor(widths)).all()
        tilt = (found[:, 3:7] * x[:, 3:7]).sum(1).clamp(max=1).acos() * 2
        assert 0.02 < tilt.max() < 0.02 * 3**0.5
        torch.testing.assert_close(found[:, 3:7].norm(dim=1), torch.ones(300).double())
    assert (second - first)[:, 0].abs().max() < 0.03, "half of it lasts"
    again = Robots(Conditions(noise=noise), x, x[:, 7:19], seed=2)
    assert torch.equal(again.estimate(), first)


def test_a_policy_is_measured_under_its_conditions(tmp_path, monkeypatch):
    """Episodes are alike until the push, and not after it."""
    policy = Policy(write_random_policy(tmp_path / "random.onnx", hidden=(4,)))
    starts = Starts(HANDSTAND, StartsCfg(stance=1.0, home=0.0), torch.device("cpu"), unlocked=True)
    monkeypatch.setattr(evaluate, "SETTLE", 0.1)
    monkeypatch.setitem(evaluate.PROTOCOLS, "push", (0.06, 0.1))
    seen: dict[float, list[torch.Tensor]] = {0.0: [], 0.4: []}
    for speed, states in seen.items():
        torch.manual_seed(3)
        step = Robots.step

        def watched(self, u, step=step, states=states):
            step(self, u)
            states.append(self.x)

        monkeypatch.setattr(Robots, "step", watched)
        conditions = Conditions(noise=NoiseCfg.none(), push=speed)
        good, found = evaluate.measured(policy, starts, "push", 5, conditions, 1)
        monkeypatch.setattr(Robots, "step", step)
        assert good.shape == (5,)
        assert found.held.shape == (5 + 3 + 5, 5)
    gap = [(a - b).norm(dim=1) for a, b in zip(*seen.values(), strict=True)]
    assert not torch.stack(gap[:5]).any()
    assert (gap[5] > 0.2).all()


def test_a_push():
    x = torch.zeros(2, 37)
    after = pushed(x, torch.tensor([0.5, 1.0]), torch.tensor([0.0, torch.pi / 2]))
    torch.testing.assert_close(
        after[:, 19:22], torch.tensor([[0.5, 0.0, 0.0], [0.0, 1.0, 0.0]]), atol=1e-6, rtol=0
    )
    assert not x.any()


def test_bad_values():
    with pytest.raises(ValueError, match=r"noise\.lasting is a share, 0 to 1, got 1\.5"):
        NoiseCfg(lasting=1.5)
    with pytest.raises(ValueError, match=r"push must be >= 0 m/s and push_every > 0 s, got -1 and 3\.0"):
        Conditions(push=-1)
