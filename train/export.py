"""Write a trained policy as one ONNX file with its contract: `python train/export.py CHECKPOINT OUT`."""

from __future__ import annotations

import io
import json
import logging
import os
import shlex
import sys
import warnings
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import onnx  # noqa: E402
import torch  # noqa: E402
from rsl_rl.models import MLPModel  # noqa: E402
from tensordict import TensorDict  # noqa: E402
from torch import Tensor, nn  # noqa: E402

from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.facts import COMMANDS, OBS_SIZE, contract  # noqa: E402
from hmc.go2.network import Network  # noqa: E402
from hmc.go2.stances import HOLDS  # noqa: E402
from hmc.go2.value import VALUE_EXTRA, Value  # noqa: E402
from train.config import config_hash, portable  # noqa: E402
from train.runner import read_checkpoint  # noqa: E402
from train.unified import TOWARDS  # noqa: E402


def actor_of(checkpoint: dict[str, Any]) -> MLPModel:
    """The actor network of a checkpoint, in evaluation mode."""
    noise = dict(class_name="GaussianDistribution", init_std=1.0, std_type="log")
    return _network(checkpoint["actor_state_dict"], "policy", 12, distribution_cfg=noise)


def critic_of(checkpoint: dict[str, Any]) -> MLPModel:
    """The critic network of a checkpoint, in evaluation mode."""
    return _network(checkpoint["critic_state_dict"], "critic", 1)


def _network(state: dict[str, Tensor], sees: str, outputs: int, **settings: Any) -> MLPModel:
    layers = [
        value.shape[0] for key, value in state.items() if key.startswith("mlp") and key.endswith("weight")
    ]
    obs = TensorDict({sees: torch.zeros(1, state["mlp.0.weight"].shape[1])}, batch_size=[1])
    network = MLPModel(
        obs,
        {"network": [sees]},
        "network",
        outputs,
        hidden_dims=layers[:-1],
        activation="swish",
        obs_normalization=True,
        **settings,
    )
    network.load_state_dict(state)
    return network.eval()


class _Deterministic(nn.Module):
    """The mean action, or the value, of an observation batch.

    Args:
        network: the actor or the critic.
        shift: what the command adds to an action, (c, 12); None for nothing.
    """

    def __init__(self, network: MLPModel, shift: Tensor | None = None):
        super().__init__()
        self.net = network.as_onnx(verbose=False).eval()
        self.shift: nn.Linear | None = None
        if shift is not None:  # of the whole observation, most of it times 0: one operation, on a GPU too
            self.shift = nn.Linear(OBS_SIZE + len(shift), shift.shape[1])
            nn.init.zeros_(self.shift.weight)
            nn.init.zeros_(self.shift.bias)
            self.shift.weight.data[:, OBS_SIZE:] = shift.T

    def forward(self, obs: Tensor) -> Tensor:
        output = self.net(obs)
        return output if self.shift is None else output + self.shift(obs)


def export(checkpoint: Path, out: Path, *, value: bool = False) -> None:
    """Write the policy of a checkpoint, or its value, to `out`; it appears only when complete and checked.

    Raises:
        ValueError: the checkpoint cannot be read, or a value is asked for where a command decides it too.
    """
    data = read_checkpoint(checkpoint)
    meta = data["infos"]["meta"]
    config = portable(json.loads(meta["config"]))
    mode = config["env"]["mode"]
    command = COMMANDS.get(mode, ())
    if value and command:
        raise ValueError(
            f"checkpoint {checkpoint}: the critic of mode {mode} judges a state and a command "
            f"({', '.join(command)}): --value wants a mode without one"
        )
    shift = TOWARDS[None] / config["env"]["action_scale"] if mode == "unified" else None
    module = _Deterministic(critic_of(data) if value else actor_of(data), shift).eval()
    size = OBS_SIZE + len(command) + (VALUE_EXTRA if value else 0)
    partial = out.with_suffix(".partial.onnx")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision
    try:
        with redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # torch about itself
            torch.onnx.export(
                module,
                (torch.zeros(2, size),),
                str(partial),
                input_names=["obs"],
                output_names=["value" if value else "actions"],
                dynamic_shapes=({0: torch.export.Dim("batch")},),
                external_data=False,
                dynamo=True,
                verbose=False,
            )
        model = onnx.load(str(partial))
        fields = {
            **contract(),
            "mode": mode,
            "value": value,
            "command": list(command),
            "default_pose": [round(float(v), 6) for v in HOLDS[mode].pose],
            "action_scale": config["env"]["action_scale"],
            "training_command": shlex.join(portable(shlex.split(meta["command"]))),
            "training_seed": int(meta["seed"]),
            "training_config": config,
            "training_config_sha256": config_hash(config),
            "environment_steps": int(data["infos"]["steps"]),
        }
        del model.metadata_props[:]
        for part in (*model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
            del part.metadata_props[:]  # stack traces, with the folders of this machine
        for key, entry in fields.items():
            model.metadata_props.add(key=key, value=json.dumps(entry))
        onnx.save(model, str(partial))
        (Value if value else Network)(partial)  # refuses what it would refuse later
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)


def main(checkpoint: Path, out: Path, /, value: bool = False) -> None:
    """Export CHECKPOINT (written by train/ppo.py) to OUT: the policy, or its critic with --value."""
    with one_line_errors():
        out.parent.mkdir(parents=True, exist_ok=True)
        export(checkpoint, out, value=value)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    command_line(main)
