"""Policy files: what they must agree with, and that they do what the trained network does."""

from __future__ import annotations

import json
import re
from importlib import resources
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from tensordict import TensorDict

from hmc.go2 import model as go2
from hmc.go2.facts import COMMANDS, OBS_SIZE, contract
from hmc.go2.network import LOWER, UPPER, Network
from hmc.go2.observe import anchor_of, observe
from hmc.go2.policy import Policy
from hmc.go2.stances import HANDSTAND, HOLDS
from hmc.go2.torch_network import TorchNetwork
from tests.tiny import CFG, make_runner
from train.config import ROOT, config_hash, portable
from train.export import actor_of, export
from train.runner import read_checkpoint

FILES = Path(str(resources.files("hmc.go2"))) / "policies"
COMMITTED = sorted(path for path in FILES.glob("*.onnx") if not path.stem.endswith("_value"))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """A checkpoint of an untrained network whose normaliser has seen something."""
    torch.manual_seed(1)
    folder = tmp_path_factory.mktemp("run")
    argv = (
        "--mode",
        "handstand",
        "--out",
        str(folder),
        f"--checkpoint={ROOT}/out/a.pt",
        "--set",
        "ppo.lam=0.9",
    )
    runner = make_runner(folder, argv=argv)
    groups = {"policy": 3 * torch.randn(500, OBS_SIZE) + 1, "critic": torch.randn(500, OBS_SIZE + 13)}
    runner.alg.actor.update_normalization(TensorDict(groups, batch_size=[500]))
    runner.save(str(folder / "model_0.pt"))
    return folder / "model_0.pt"


@pytest.fixture(scope="module")
def exported(checkpoint) -> Path:
    path = checkpoint.with_name("policy.onnx")
    export(checkpoint, path)
    return path


def observations(n: int) -> torch.Tensor:
    return 3 * torch.randn(n, OBS_SIZE) + 1


def run(policy: Policy, obs: torch.Tensor) -> torch.Tensor:
    """The network's own output (n, 12)."""
    return torch.from_numpy(policy.network.run(obs.numpy()))


def edited(path: Path, out: Path, key: str, value: object) -> Path:
    """A copy of a policy file with one field of its metadata changed, or taken out (None)."""
    model = onnx.load(str(path))
    fields = {prop.key: prop.value for prop in model.metadata_props if prop.key != key}
    if value is not None:
        fields[key] = json.dumps(value)
    del model.metadata_props[:]
    for name, text in fields.items():
        model.metadata_props.add(key=name, value=text)
    onnx.save(model, str(out))
    return out


@torch.no_grad()
def test_the_file_does_what_the_network_does(checkpoint, exported):
    obs = observations(1000)
    torch_actions = actor_of(read_checkpoint(checkpoint))(TensorDict({"policy": obs}, batch_size=[1000]))
    torch.testing.assert_close(run(Policy(exported), obs), torch_actions, atol=1e-5, rtol=0)
    assert torch_actions.std(0).min() > 1e-3


def test_the_same_bits_in_a_batch_of_any_size(exported):
    policy, obs = Policy(exported), observations(64)
    whole = run(policy, obs)
    for n in range(1, 65):
        assert torch.equal(run(policy, obs[:n]), whole[:n])
        assert torch.equal(run(policy, obs[-n:]), whole[-n:])
    assert torch.equal(run(Policy(exported, threads=2), obs), whole)


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.name)
def test_the_file_in_torch_does_what_it_does_in_onnxruntime(path):
    """What runs on a GPU, on the CPU: the network's output, and the targets of the whole mode."""
    network = Network(path)
    obs = observations(1000)
    obs = torch.cat([obs, torch.randn(1000, len(network.command))], 1)
    found = TorchNetwork(path, torch.device("cpu"))(obs)
    torch.testing.assert_close(found, torch.from_numpy(network.run(obs.numpy())), atol=1e-5, rtol=1e-5)
    told = 0.3 * torch.randn(100, len(network.command)).double()
    policy = Policy(path, command=(lambda x, k: told) if network.command else None)
    x = HOLDS[network.mode].state().repeat(100, 1) + 0.05 * torch.randn(100, 37).double()
    x[:, 3:7] /= x[:, 3:7].norm(dim=1, keepdim=True)
    u, k = x[:, 7:19] + 0.1, torch.zeros(100, dtype=torch.long)
    memory = policy.reset(x, u, k)
    x[:, :2] += 0.2
    expected, _ = policy.act(x, u, memory, k)
    actual = policy.on_device(x, u, memory, *([told] if network.command else []))
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)


def test_an_operation_that_torch_is_not_told_of(exported, tmp_path):
    model = onnx.load(str(exported))
    next(node for node in model.graph.node if node.op_type == "Sigmoid").op_type = "Tanh"
    onnx.save(model, str(tmp_path / "odd.onnx"))
    with pytest.raises(ValueError, match=r"odd\.onnx: operation Tanh .*: run it on the CPU"):
        TorchNetwork(tmp_path / "odd.onnx", torch.device("cpu"))


def test_the_mode(exported):
    """Target = pose + scale x network(observation since the anchor), inside the joint limits."""
    policy = Policy(exported)
    assert (policy.name, policy.memory_size) == ("handstand", 4)
    assert Policy(exported, name="hand").name == "hand"
    x = HANDSTAND.state().repeat(3, 1)
    x[:, :2] = torch.randn(3, 2)
    u, k = torch.randn(3, 12).double(), torch.zeros(3, dtype=torch.long)
    memory = policy.reset(x, u, k)
    assert torch.equal(memory, anchor_of(x))
    x[:, 0] += 0.5
    action, after = policy.act(x, u, memory, k)
    network = run(policy, observe(x, u, memory).float()).double()
    expected = HANDSTAND.pose + CFG.env.action_scale * network
    torch.testing.assert_close(
        action, expected.clamp(go2.Q_LOWER.double(), go2.Q_UPPER.double()), atol=1e-6, rtol=0
    )
    assert torch.equal(after, memory)
    action, _ = policy.act(1e4 * x, u, memory, k)
    assert ((action.numpy() >= LOWER) & (action.numpy() <= UPPER)).all()


def test_a_world_that_diverges_is_no_warning(exported):
    """Its state may be too large for the network's numbers; its neighbour is not touched by that."""
    policy = Policy(exported)
    x, k = HANDSTAND.state().expand(2, 37).clone(), torch.zeros(2, dtype=torch.long)
    x[0, 25:] = 1e60
    memory = policy.reset(x, x[:, 7:19], k)
    u, _ = policy.act(x, x[:, 7:19], memory, k)
    alone, _ = policy.act(x[1:], x[1:, 7:19], memory[1:], k[1:])
    assert torch.equal(u[1:], alone)
    assert not ((u[0] < torch.from_numpy(LOWER)) | (u[0] > torch.from_numpy(UPPER))).any()


def test_metadata(exported, checkpoint):
    meta = Policy(exported).network.metadata
    assert {key: meta[key] for key in contract()} == contract()
    assert meta["mode"] == "handstand"
    assert meta["default_pose"] == pytest.approx(HANDSTAND.pose.tolist(), abs=1e-6)
    assert meta["action_scale"] == 0.5
    assert meta["training_seed"] == 7
    assert meta["training_command"].split() == [
        *("python", "train/ppo.py", "--mode", "handstand", "--out", checkpoint.parent.name),
        *("--checkpoint=out/a.pt", "--set", "ppo.lam=0.9"),
    ]
    assert meta["training_config"]["ppo"]["hidden"] == [16, 8]
    assert meta["training_config_sha256"] == config_hash(meta["training_config"])
    assert len(meta["training_config_sha256"]) == 64


def test_the_file_names_no_folder_of_the_machine(exported):
    data = exported.read_bytes()
    assert str(Path(__file__).parents[1]).encode() not in data
    assert b"stack_trace" not in data


def test_paths_in_metadata_are_portable():
    assert portable(f"{ROOT}/out/flips.pt") == "out/flips.pt"
    assert portable("env.starts.records=/somewhere/else/flips.pt") == "env.starts.records=flips.pt"
    assert portable(["--out", "/tmp/x", "out/y", 3, {"records": "/a/b.pt"}]) == [
        "--out",
        "x",
        "out/y",
        3,
        {"records": "b.pt"},
    ]
    assert portable("ppo.hidden=[64, 32]") == "ppo.hidden=[64, 32]"


WRONG = {
    "observation_version": 2,
    "observation_size": 45,
    "joint_order": [*go2.JOINTS[3:6], *go2.JOINTS[:3], *go2.JOINTS[6:]],
    "kp": 40.0,
    "kd": 1.0,
    "control_dt": 0.01,
}


def test_every_field_of_the_contract_is_tried():
    assert set(WRONG) == set(contract())


@pytest.mark.parametrize("field", WRONG)
def test_a_wrong_field_is_named(exported, tmp_path, field):
    other = edited(exported, tmp_path / "other.onnx", field, WRONG[field])
    with pytest.raises(ValueError, match="other version") as error:
        Policy(other)
    for part in (
        str(other),
        f"{field} is {WRONG[field]!r}",
        f"expected {contract()[field]!r}",
        "train and export",
    ):
        assert part in str(error.value)


@pytest.mark.parametrize("field", [*WRONG, "mode", "default_pose", "action_scale"])
def test_a_missing_field_is_named(exported, tmp_path, field):
    other = edited(exported, tmp_path / "other.onnx", field, None)
    with pytest.raises(ValueError, match=f"metadata lacks {field!r}.*train/export.py"):
        Policy(other)


def test_metadata_that_is_not_ours(exported, tmp_path):
    """Another program's file: free text in its metadata, or none."""
    model = onnx.load(str(exported))
    del model.metadata_props[:]
    onnx.save(model, str(tmp_path / "bare.onnx"))
    with pytest.raises(ValueError, match="metadata lacks 'observation_version'"):
        Policy(tmp_path / "bare.onnx")
    model.metadata_props.add(key="author", value="not JSON")
    onnx.save(model, str(tmp_path / "other.onnx"))
    with pytest.raises(ValueError, match="metadata lacks 'observation_version'"):
        Policy(tmp_path / "other.onnx")


def test_a_missing_file(tmp_path):
    with pytest.raises(ValueError, match=r"nothing\.onnx: no such file"):
        Policy(tmp_path / "nothing.onnx")


@pytest.mark.parametrize("keep", [0, 100, 0.5])
def test_a_truncated_file(exported, tmp_path, keep):
    data = exported.read_bytes()
    short = tmp_path / "short.onnx"
    short.write_bytes(data[: int(keep * len(data)) if keep < 1 else keep])
    with pytest.raises(ValueError, match=r"short\.onnx: (not a readable ONNX file|its metadata lacks)"):
        Policy(short)


def test_export_leaves_nothing_half_done(checkpoint, tmp_path):
    short = tmp_path / "short.pt"
    short.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"short\.pt: cannot be read"):
        export(short, tmp_path / "policy.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["short.pt"]


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.name)
def test_committed_policies(path):
    network = Network(path)
    meta, holds = network.metadata, HOLDS[path.stem]
    assert meta["mode"] == path.stem
    assert meta["default_pose"] == pytest.approx(holds.pose.tolist(), abs=1e-6)
    assert network.command == COMMANDS.get(path.stem, ())
    assert meta["training_command"].startswith("python train/ppo.py ")
    assert f"--mode {path.stem}" in meta["training_command"]
    assert isinstance(meta["training_seed"], int)
    assert meta["training_config_sha256"] == config_hash(meta["training_config"])
    assert not re.search(r"(^|[\s=\"'])(/|[A-Z]:\\)\w", json.dumps(meta)), "a path of somebody's machine"
    x = holds.state()[None]
    told = np.zeros((1, len(network.command))) if network.command else None
    action = network.act(x.numpy(), x[:, 7:19].numpy(), anchor_of(x).numpy(), told)
    assert np.isfinite(action).all()
