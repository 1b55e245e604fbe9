"""The critic as a cost at the end of the horizon."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from hmc.go2 import model as go2
from hmc.go2.network import Network
from hmc.go2.observe import anchor_of, observe
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STANCES, STAND
from hmc.go2.task import CostCfg, FlipCfg, JumpCfg, flip_task, policy_path, stance_cost, timeline, with_values
from hmc.go2.value import Value, seen
from tests.tiny import make_env, make_runner
from train.export import critic_of, export
from train.runner import read_checkpoint

COMMAND = 10


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A checkpoint of an untrained critic whose normaliser has seen something."""
    torch.manual_seed(2)
    folder = tmp_path_factory.mktemp("run")
    runner = make_runner(folder)
    groups = {"policy": torch.randn(500, 48), "critic": 3 * torch.randn(500, 61) + 1}
    runner.alg.critic.update_normalization(TensorDict(groups, batch_size=[500]))
    runner.save(str(folder / "model_0.pt"))
    export(folder / "model_0.pt", folder / "value.onnx", value=True)
    return folder / "model_0.pt"


@torch.no_grad()
def test_the_file_is_the_critic(checkpoint):
    value = Value(checkpoint.with_name("value.onnx"))
    x = HANDSTAND.state().repeat(50, 1) + 0.1 * torch.randn(50, 37).double()
    x[:, 3:7] /= x[:, 3:7].norm(dim=1, keepdim=True)
    q = x[:, 7:19]
    obs = torch.cat([observe(x, q, anchor_of(x)), 0.1 * go2.motor_torque(q, x[:, 25:], q), x[:, 2:3]], 1)
    critic = critic_of(read_checkpoint(checkpoint))
    expected = critic(TensorDict({"critic": obs.float()}, batch_size=[50]))[:, 0].double()
    torch.testing.assert_close(value(x) * value.rest, expected, atol=1e-5, rtol=1e-5)
    assert float(value(HANDSTAND.state()[None])) == pytest.approx(1.0)
    whole = value(x)
    for n in range(1, 50):
        assert torch.equal(value(x[:n]), whole[:n]), "the same bits in a batch of any size"


@torch.no_grad()
@pytest.mark.parametrize("name", STANCES)
def test_on_a_device_it_is_worth_as_much(name):
    """By torch, as on a GPU: what onnxruntime makes of the file within 1e-5, near the stance and far off."""
    value, x = Value(policy_path(f"{name}_value")), STANCES[name].state().repeat(200, 1)
    x[:100] += 0.05 * torch.randn(100, 37).double()
    x[100:] += torch.randn(100, 37).double()
    x[:, 3:7] /= x[:, 3:7].norm(dim=1, keepdim=True)
    q = x[:, 7:19]
    obs = seen(observe(x, q, anchor_of(x)), go2.motor_torque(q, x[:, 25:], q), x[:, 2]).float()
    expected, found = value(x), value.on_device(obs)[:, 0].double() / value.rest
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert not torch.equal(found, expected), "another way to the same"


def test_what_training_shows_the_critic_is_what_the_value_sees():
    env = make_env()
    torque = go2.motor_torque(env._x[:, 7:19], env._x[:, 25:37], env._u)
    expected = seen(observe(env._x, env._u, env._anchor), torque, env._x[:, 2])
    assert torch.equal(env.get_observations()["critic"], expected)


def test_values_and_policies_are_told_apart(checkpoint):
    with pytest.raises(ValueError, match=r"value\.onnx: it is the value of one: export it without --value"):
        Network(checkpoint.with_name("value.onnx"))
    with pytest.raises(ValueError, match=r"handstand\.onnx: it is a policy: export its value"):
        Value(policy_path("handstand"))
    with pytest.raises(ValueError, match="no such file"):
        Value("gone.onnx")


@pytest.mark.parametrize("name", STANCES)
def test_committed_values_belong_to_the_committed_policies(name):
    value, policy = Value(policy_path(f"{name}_value")), Policy(policy_path(name))
    assert value.mode == name
    for key in ("training_command", "training_seed", "training_config_sha256", "environment_steps"):
        assert value.metadata[key] == policy.network.metadata[key], key
    lying = STAND.state()[None]  # on its back, its legs folded
    lying[:, 2], lying[:, 3:7] = 0.08, torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=lying.dtype)
    lying[:, 7:19] = torch.tensor([0.0, 1.3, -2.7] * 4, dtype=lying.dtype)
    stance, other = STANCES[name], FOOTSTAND if name == "handstand" else HANDSTAND
    tilted = stance.state()[None]
    tilted[:, 23] = 3.0 * stance.sign  # falling over at 3 rad/s
    found = [float(value(x)) for x in (stance.state()[None], tilted, other.state()[None], lying)]
    assert found[0] > found[1] > max(found[2:])
    assert max(found[2:]) < 0.3


def test_the_cost_of_lacking_value():
    plain = stance_cost(CostCfg(), timeline(COMMAND))
    cost = with_values(plain, 4.0, timeline(COMMAND))
    x = torch.stack([FOOTSTAND.state(), HANDSTAND.state(), FOOTSTAND.state(), HANDSTAND.state()])
    k = torch.tensor([COMMAND - 1, COMMAND, COMMAND, COMMAND - 1])
    found = cost.terminal_terms(x, k)
    assert torch.equal(found[:, :1], plain.terminal_terms(x, k))
    foot, hand = (Value(policy_path(f"{name}_value")) for name in ("footstand", "handstand"))
    assert found[:2, 1].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    assert float(found[2, 1]) == pytest.approx(4.0 * (1.0 - float(hand(x[2:3]))))
    assert float(found[3, 1]) == pytest.approx(4.0 * (1.0 - float(foot(x[3:4]))))
    alone = [cost.terminal_terms(x[i : i + 1], k[i : i + 1])[0] for i in range(4)]
    assert torch.equal(found, torch.stack(alone)), "a target for all takes another way to the same bits"
    assert cost.names == (*plain.names, "value")


def test_the_flip_has_it_on_request():
    jump = JumpCfg(guess=((0.0,) * 4,) * 2, mpc=False)
    assert "value" not in flip_task(FlipCfg(jump=jump), threads=1).cost.terminal
    task = flip_task(FlipCfg(jump=jump, cost=CostCfg(value=1.0)), threads=1)
    assert "value" in task.cost.terminal
    assert task.cost.nonnegative
