"""Policy files on onnxruntime and numpy alone: what planning and deployment share, without torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from hmc.go2 import facts

Array = NDArray[np.floating[Any]]

LOWER, UPPER = np.array(facts.Q_LOWER), np.array(facts.Q_UPPER)

# Entries of the rotation matrix, row by row: constant + factor (q_a q_b + sign q_c q_d), q = (w, x, y, z).
_PAIRS = np.array(
    [
        [[2, 1, 1, 1, 1, 2, 1, 2, 1], [3, 0, 0, 0, 3, 0, 0, 0, 2]],
        [[2, 2, 3, 2, 1, 3, 3, 3, 1], [3, 3, 2, 3, 3, 1, 2, 1, 2]],
    ]
)  # (a and c, b and d)
_LAW = np.array(
    [[1, -1, 1, 1, 1, -1, -1, 1, 1], [-2, 2, 2, 2, -2, 2, 2, 2, -2], [1, 0, 0, 0, 1, 0, 0, 0, 1]], float
)[:, :, None]  # sign, factor, constant
_LEFT = slice(1, 5, 3)  # x and y of the body's y axis


def observe(x: Array, u: Array, anchor: Array) -> Array:
    """Observation of policies, (n, 48): the numbers of `hmc.go2.observe.observe`, by the same operations.

    Args:
        x: states (n, 37): qpos (position, quaternion w x y z, joints), qvel (linear velocity in the world
            frame, angular velocity in the body frame, joints).
        u: previous action: joint targets [rad], (n, 12).
        anchor: where the mode was entered, (n, 4): x, y [m], cos and sin of the heading.
    """
    turn = rotation(x, slice(None)).reshape(3, 3, -1)
    across = turn * x.T[19:22, None]
    (px, py), (ax, ay, c, s) = x.T[:2], anchor.T
    dx, dy = px - ax, py - ay
    out = np.empty((len(x), facts.OBS_SIZE), x.dtype)
    columns = out.T
    np.negative(turn[2], out=columns[:3])
    columns[3] = c * dx + s * dy
    columns[4] = c * dy - s * dx
    columns[5] = x.T[2]
    columns[6:9] = across[0] + across[1] + across[2]
    out[:, 9:12] = x[:, 22:25]
    out[:, 12:24] = x[:, 7:19]
    out[:, 24:36] = x[:, 25:37]
    out[:, 36:48] = u
    return out


def anchor_of(x: Array) -> Array:
    """Anchor at states x (n, 37), (n, 4): that of `hmc.go2.observe.anchor_of`, by the same operations."""
    left = rotation(x, _LEFT)
    across, ahead = left / np.maximum(np.sqrt(left[0] * left[0] + left[1] * left[1]), 1e-6)
    out = np.empty((len(x), 4), x.dtype)
    out[:, :2], out[:, 2] = x[:, :2], ahead
    np.negative(across, out=out[:, 3])
    return out


def follow(x: Array, anchor: Array) -> Array:
    """Anchors (n, 4) drawn along as by `hmc.go2.observe.follow`, by the same operations."""
    dx, dy = x[:, 0] - anchor[:, 0], x[:, 1] - anchor[:, 1]
    distance = np.sqrt(dx * dx + dy * dy)
    far = distance > facts.LEASH
    if not far.any():
        return anchor
    share = facts.LEASH / np.maximum(distance, facts.LEASH)
    at = np.stack([x[:, 0] - share * dx, x[:, 1] - share * dy], 1)
    return np.concatenate([np.where(far[:, None], at, anchor[:, :2]), anchor[:, 2:]], 1)


def rotation(x: Array, which: slice) -> Array:
    """Some of the 9 entries, row by row, of the rotations body to world at states x (n, 37), (entries, n)."""
    factors = x.T[3:7].take(_PAIRS[..., which], 0)
    product, (sign, factor, constant) = factors[0] * factors[1], _LAW[:, which]
    entries: Array = constant + factor * (product[0] + sign * product[1])
    return entries


class Network:
    """Target = default_pose + action_scale x network(observation), inside the joint limits.

    Attributes:
        path: of the file.
        metadata: its contract, see `hmc.go2.facts.contract`, and how it was made.
        mode: its name there.
        pose: joint positions that its targets are about [rad], (12,).
        scale: of its output [rad].
        command: names and units of the numbers that it is commanded by, after the observation; mostly none.

    Args:
        path: ONNX file with its contract in the metadata.
        threads: of onnxruntime; 0 for all cores. Targets do not depend on it.

    Raises:
        ValueError: the file cannot be read, or a field of its contract does not match; names it.
    """

    def __init__(self, path: str | Path, threads: int = 1):
        self.path = Path(path)
        self._session, self.metadata = opened(self.path, threads)
        if self.metadata.get("value"):
            raise ValueError(f"policy {self.path}: it is the value of one: export it without --value")
        self.mode = str(self.metadata["mode"])
        self.command = tuple(self.metadata.get("command", ()))
        self.pose = np.array(self.metadata["default_pose"], dtype=np.float64)
        self.scale = float(self.metadata["action_scale"])

    def expect(self, mode: str) -> None:
        """See that it is a policy of this mode that obeys no command.

        Raises:
            ValueError: it is not; names the field of its metadata.
        """
        remedy = f"give one that python train/ppo.py --mode {mode} has trained"
        if self.command:
            raise ValueError(
                f"policy {self.path}: command is {', '.join(self.command)}, expected none, as nothing "
                f"commands it here: {remedy}"
            )
        if self.mode != mode:
            raise ValueError(f"policy {self.path}: mode is {self.mode!r}, expected {mode!r}: {remedy}")

    def act(self, x: Array, u: Array, anchor: Array, command: Array | None = None) -> NDArray[np.float64]:
        """Joint targets [rad], (n, 12); arguments as of `observe`, and the command (n, c) if it obeys one."""
        obs = observe(x, u, anchor)
        if command is not None:
            obs[:, 3:5] = 0.0
            obs = np.concatenate([obs, command], 1)
        with np.errstate(over="ignore"):  # of a world that diverges
            given = obs.astype(np.float32)
        target = self.pose + self.scale * self.run(given).astype(np.float64)
        np.maximum(target, LOWER, out=target)
        np.minimum(target, UPPER, out=target)
        return target

    def run(self, obs: NDArray[np.float32]) -> NDArray[np.float32]:
        """The network's output, (n, 12), for observations with their commands (n, 48 + c)."""
        (output,) = self._session.run(None, {"obs": obs})
        return np.asarray(output)


def opened(path: Path, threads: int) -> tuple[onnxruntime.InferenceSession, dict[str, Any]]:
    """A file that train/export.py wrote, and its metadata.

    Raises:
        ValueError: the file cannot be read, or a field of its contract does not match; names it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # idle threads of the network must not spin on the cores that step worlds
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if not path.is_file():
        raise ValueError(f"policy {path}: no such file")
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"policy {path}: not a readable ONNX file ({error})") from error
    metadata = {key: _decoded(text) for key, text in session.get_modelmeta().custom_metadata_map.items()}
    if wrong := facts.disagreement(metadata):
        raise ValueError(f"policy {path}: {wrong}")
    return session, metadata


def _decoded(text: str) -> Any:
    """A metadata value: JSON as we write it, else the text that another program wrote."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
