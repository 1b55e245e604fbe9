"""The Unitree Go2 for simulators and networks: compiled model, motor law and forward kinematics.

Its figures, with their sources, are in `hmc.go2.facts`; frames and units as there.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Literal

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.go2 import facts
from hmc.go2.facts import CALF_END as CALF_END
from hmc.go2.facts import DT as DT
from hmc.go2.facts import FOOT_BACK as FOOT_BACK
from hmc.go2.facts import FOOT_RADIUS as FOOT_RADIUS
from hmc.go2.facts import FRONT as FRONT
from hmc.go2.facts import HIP_CENTRE as HIP_CENTRE
from hmc.go2.facts import HIP_LENGTH as HIP_LENGTH
from hmc.go2.facts import HIP_X as HIP_X
from hmc.go2.facts import HIP_Y as HIP_Y
from hmc.go2.facts import HOME_HEIGHT as HOME_HEIGHT
from hmc.go2.facts import JOINTS as JOINTS
from hmc.go2.facts import KD as KD
from hmc.go2.facts import KP as KP
from hmc.go2.facts import LEGS as LEGS
from hmc.go2.facts import LINK as LINK
from hmc.go2.facts import NO_LOAD as NO_LOAD
from hmc.go2.facts import PEAK as PEAK
from hmc.go2.facts import REAR as REAR
from hmc.go2.facts import STALL as STALL
from hmc.go2.facts import STANCE_HEIGHT as STANCE_HEIGHT
from hmc.go2.facts import SUBSTEPS as SUBSTEPS
from hmc.sim.device import constant

Floats = NDArray[np.float64]

Q_LOWER, Q_UPPER = torch.tensor(facts.Q_LOWER), torch.tensor(facts.Q_UPPER)
GEAR = torch.tensor(facts.GEAR)
HOME = torch.tensor(facts.HOME)
HANDSTAND, FOOTSTAND = torch.tensor(facts.HANDSTAND), torch.tensor(facts.FOOTSTAND)
Contacts = Literal["all", "body", "feet"]


def load_model(
    substeps: int = SUBSTEPS, iterations: int | None = None, contacts: Contacts = "all"
) -> mujoco.MjModel:
    """The compiled model (nq 19, nv 18, nu 12), with so many physics steps a control step of 20 ms.

    Args:
        substeps: physics steps a control step; fewer make a coarser model.
        iterations: of the contact solver, at most; None for the model file's.
        contacts: what the floor holds up: all of the robot; "body": feet, trunk and head, but no hip, thigh
            or shin; "feet": these alone. The rest goes through the floor.
    """
    model = mujoco.MjModel.from_xml_path(str(resources.files("hmc.go2") / "go2.xml"))
    model.opt.timestep = DT / substeps
    if iterations is not None:
        model.opt.iterations = iterations
    if contacts != "all":
        base = model.body("base").id
        for geom in range(model.ngeom):
            foot, trunk = model.geom_priority[geom] == 1, model.geom_bodyid[geom] == base
            if not foot and not (contacts == "body" and trunk):
                model.geom_conaffinity[geom] = 0
    return model


def motor_torque(q: Tensor, qd: Tensor, target: Tensor) -> Tensor:
    r"""Joint torque of the position servo within its torque-speed curve [N m], (..., 12).

    .. math:: \tau = \mathrm{clip}(k_p (u - q) - k_d \dot q)

    A motor that drives is held under the line through (13.5 rad/s, 20.2 N m) and (30 rad/s, 0), and
    never exceeds 20.2 N m in either direction; both axes scaled by GEAR for the calf. The engine
    computes the same law as a DC motor whose voltage saturates.
    """
    stall, peak, negative, slope = motor_curve(q.dtype, q.device)
    torque, back = KP * (target - q) - KD * qd, slope * qd
    top = (stall - back).clamp(negative, peak)
    bottom = (-stall - back).clamp(negative, peak)
    return torque.clamp(min=bottom, max=top)


def motor_torque_in_numpy(q: Floats, qd: Floats, target: Floats) -> Floats:
    """`motor_torque` by the same operations: for few states one of torch's takes several times as long."""
    stall, peak, negative, slope = _motor_curve_in_numpy()
    torque, back = KP * (target - q) - KD * qd, slope * qd
    top = np.minimum(np.maximum(stall - back, negative), peak)
    bottom = np.minimum(np.maximum(-stall - back, negative), peak)
    limited: Floats = np.minimum(np.maximum(torque, bottom), top)
    return limited


@cache
def _motor_curve_in_numpy() -> tuple[Floats, ...]:
    return tuple(each.numpy() for each in motor_curve(torch.float64, torch.device("cpu")))


@cache
def motor_curve(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Stall torque, peak torque and its negative, slope of the driving line, of each joint, (12,)."""
    with torch.inference_mode(False):
        gear = GEAR.to(device, dtype, copy=True)
        return STALL * gear, PEAK * gear, -PEAK * gear, STALL / NO_LOAD * gear**2


# Entries of the rotation matrix, row by row: constant + factor (q_a q_b + sign q_c q_d), q = (w, x, y, z).
_FACTORS = torch.tensor(
    [
        [2, 1, 1, 1, 1, 2, 1, 2, 1],
        [2, 2, 3, 2, 1, 3, 3, 3, 1],
        [3, 0, 0, 0, 3, 0, 0, 0, 2],
        [3, 3, 2, 3, 3, 1, 2, 1, 2],
    ]
)
_SIGNS = torch.tensor(
    [[1, -1, 1, 1, 1, -1, -1, 1, 1], [-2, 2, 2, 2, -2, 2, 2, 2, -2], [1, 0, 0, 0, 1, 0, 0, 0, 1]]
)


@cache
def _quadratic(dtype: torch.dtype, device: torch.device, first: int) -> tuple[Tensor, ...]:
    """Indices (4 entries) and sign, factor, constant (entries,) of the matrix from entry `first` on."""
    with torch.inference_mode(False):
        return (
            _FACTORS[:, first:].reshape(-1).to(device),
            *_SIGNS[:, first:].to(device, dtype, copy=True).unbind(),
        )


def _entries(quat: Tensor, first: int) -> Tensor:
    """Entries of the rotation matrix from `first` on, (n, 9 - first)."""
    index, sign, factor, constant = _quadratic(quat.dtype, quat.device, first)
    a, b, c, d = quat.index_select(1, index).reshape(len(quat), 4, 9 - first).unbind(1)
    return constant + factor * (a * b + sign * (c * d))


def rotation(quat: Tensor) -> Tensor:
    """Rotation matrices (n, 3, 3), body to world, of unit quaternions (w, x, y, z) (n, 4)."""
    return _entries(quat, 0).reshape(-1, 3, 3)


def vertical(quat: Tensor) -> Tensor:
    """World z of each body axis, (n, 3): the last row of `rotation`. Gravity in the body frame is -this."""
    return _entries(quat, 6)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product of quaternions (w, x, y, z), (n, 4): turn by b, then by a."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], 1)


@cache
def _sides(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """+1 for left, -1 for right legs; +1 for front, -1 for rear legs, (4,) each."""
    with torch.inference_mode(False):
        table = torch.tensor([[1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, -1.0]], dtype=dtype, device=device)
        return table[0], table[1]


@cache
def _hips(dtype: torch.dtype, device: torch.device) -> Tensor:
    """x and y of the hip joints in the base frame [m], (2, 4)."""
    side, end = _sides(dtype, device)
    with torch.inference_mode(False):
        return torch.stack([HIP_X * end, HIP_Y * side])


def leg_points(q: Tensor) -> Tensor:
    """Hip, knee and foot centres of each leg in the base frame [m], (n, 4 legs, 3 points, 3).

    The hip point is where the thigh begins; the knee where the calf does.
    """
    joint = q.reshape(-1, 4, 3)
    hip, thigh, knee = joint.unbind(-1)
    side, end = _sides(q.dtype, q.device)
    ch, sh = hip.cos(), hip.sin()

    def place(forward: Tensor, down: Tensor) -> Tensor:
        """A point of the leg's plane, at lateral offset HIP_LENGTH, turned about the hip's x axis."""
        y, z = side * HIP_LENGTH, -down
        return torch.stack([end * HIP_X + forward, side * HIP_Y + ch * y - sh * z, sh * y + ch * z], -1)

    zero = torch.zeros_like(hip)
    knee_x, knee_z = -LINK * thigh.sin(), LINK * thigh.cos()
    shank = thigh + knee
    foot_x = knee_x - LINK * shank.sin() - FOOT_BACK * shank.cos()
    foot_z = knee_z + LINK * shank.cos() - FOOT_BACK * shank.sin()
    return torch.stack([place(zero, zero), place(knee_x, knee_z), place(foot_x, foot_z)], 2)


# Points of the trunk that can touch the ground first: (x, y, z, radius of the sphere around them).
TRUNK_POINTS = torch.tensor(
    [[sx * 0.1881, sy * 0.04675, sz * 0.057, 0.0] for sx in (1, -1) for sy in (1, -1) for sz in (1, -1)]
    + [[0.285, 0.0, 0.01, 0.05], [0.293, 0.0, -0.06, 0.047]]
)


def clearances(x: Tensor) -> dict[str, Tensor]:
    """Height above the floor of each link's lowest point [m]: <= 0 means that it touches.

    Args:
        x: state (n, 37): qpos then qvel.

    Returns:
        foot, thigh, calf, hip: (n, 4) in leg order; trunk (with the head): (n,).
    """
    turn, height = vertical(x[:, 3:7]), x[:, 2]
    # heights of the points of `leg_points`: a leg's plane leans with the hip, its x axis with the body
    angle = x[:, 7:19].reshape(-1, 4, 3).clone()
    angle[..., 2] += angle[..., 1]
    cos, sin = angle.cos(), angle.sin()
    tx, ty, tz = turn[:, :, None].unbind(1)
    ch, sh = cos[..., 0], sin[..., 0]
    # entry by entry: a matrix product may round differently in a batch of another size
    forward, sideways = _hips(x.dtype, x.device)
    root, out = tx * forward + ty * sideways, HIP_LENGTH * _sides(x.dtype, x.device)[0]
    lean = ty * ch + tz * sh
    hip = height[:, None] + root + out * lean
    down = ty * sh - tz * ch
    drop = LINK * (down[..., None] * cos[..., 1:] - tx[..., None] * sin[..., 1:])
    knee = hip + drop[..., 0]
    ahead = tx * cos[..., 2] + down * sin[..., 2]
    foot = knee + drop[..., 1] - FOOT_BACK * ahead
    calf_end = knee + CALF_END[1] / LINK * drop[..., 1] + CALF_END[0] * ahead
    px, py, pz, radius = constant(TRUNK_POINTS, x).unbind(1)
    return {
        "foot": foot - FOOT_RADIUS,
        "thigh": torch.minimum(hip, knee) - 0.017,
        "calf": torch.minimum(knee, calf_end) - 0.012,
        "hip": height[:, None] + root + HIP_CENTRE / HIP_LENGTH * out * lean - 0.046,
        "trunk": (height[:, None] + tx * px + ty * py + tz * pz - radius).amin(1),
    }


def lowest(x: Tensor) -> Tensor:
    """Height of the lowest point of the robot [m], (n,), at states x (n, 37)."""
    gap = clearances(x)
    return torch.cat([gap["foot"], gap["thigh"], gap["calf"], gap["hip"], gap["trunk"][:, None]], 1).amin(1)
