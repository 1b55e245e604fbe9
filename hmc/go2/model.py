"""The Unitree Go2: joint order, poses, limits, motor law and forward kinematics, with their sources.

Frames: the base frame has x forward, y left, z up, its origin at the trunk's centre. Joint order is
(FL, FR, RL, RR) x (hip, thigh, calf) everywhere. Lengths in m, angles in rad, torques in N m.

Sources: masses, inertias, offsets and joint limits are Unitree's, as published in MuJoCo Menagerie's
unitree_go2 (BSD-3-Clause); the motor's torque-speed curve is the one Unitree publishes for its Go2
actuators in unitree_rl_lab: 20.2 N m up to 13.5 rad/s, then linearly down to zero at 30 rad/s, on the
hip and the thigh; the calf is geared by a further 1.917.
"""

from __future__ import annotations

from importlib import resources

import mujoco
import torch
from torch import Tensor

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf"))
FRONT, REAR = (0, 1), (2, 3)

Q_LOWER = torch.tensor([-1.0472, -1.5708, -2.7227] * 2 + [-1.0472, -0.5236, -2.7227] * 2)
Q_UPPER = torch.tensor([1.0472, 3.4907, -0.83776] * 2 + [1.0472, 4.5379, -0.83776] * 2)

KP, KD = 35.0, 0.5  # N m/rad, N m s/rad
GEAR = torch.tensor([1.0, 1.0, 1.917] * 4)  # calf linkage relative to the hip and thigh motors
STALL = 20.2 * 30.0 / (30.0 - 13.5)  # the driving line extended to zero speed [N m]
NO_LOAD = 30.0  # rad/s, before GEAR
PEAK = 20.2  # N m, before GEAR

# Balanced poses: the centre of mass is within 1 mm of the middle of the supporting feet.
HOME = torch.tensor([0.0, 0.9, -1.8] * 4)
HANDSTAND = torch.tensor([0.0, -0.966, -1.16] * 2 + [0.0, 1.7, -1.853] * 2)
FOOTSTAND = torch.tensor([0.0, 0.82, -1.6] * 2 + [0.0, 2.12, -1.16] * 2)
HOME_HEIGHT = 0.29
STANCE_HEIGHT = 0.573

HIP_X, HIP_Y, HIP_LENGTH, LINK = 0.1934, 0.0465, 0.0955, 0.213
FOOT_RADIUS = 0.022


def load_model() -> mujoco.MjModel:
    """The compiled model (nq 19, nv 18, nu 12), 5 ms a physics step."""
    return mujoco.MjModel.from_xml_path(str(resources.files("hmc.go2") / "go2.xml"))


def motor_torque(q: Tensor, qd: Tensor, target: Tensor) -> Tensor:
    r"""Joint torque of the position servo within its torque-speed curve [N m], (..., 12).

    .. math:: \tau = \mathrm{clip}(k_p (u - q) - k_d \dot q)

    A motor that drives is held under the line through (13.5 rad/s, 20.2 N m) and (30 rad/s, 0), and
    never exceeds 20.2 N m in either direction; both axes scaled by GEAR for the calf. The engine
    computes the same law as a DC motor whose voltage saturates.
    """
    gear = GEAR.to(q)
    torque = KP * (target - q) - KD * qd
    slope = STALL / NO_LOAD * gear**2
    top = (STALL * gear - slope * qd).clamp(max=PEAK * gear).clamp(min=-PEAK * gear)
    bottom = (-STALL * gear - slope * qd).clamp(min=-PEAK * gear).clamp(max=PEAK * gear)
    return torque.clamp(min=bottom, max=top)


def rotation(quat: Tensor) -> Tensor:
    """Rotation matrices (n, 3, 3), body to world, of unit quaternions (w, x, y, z) (n, 4)."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def leg_points(q: Tensor) -> Tensor:
    """Hip, knee and foot centres of each leg in the base frame [m], (n, 4 legs, 3 points, 3).

    The hip point is where the thigh begins; the knee where the calf does.
    """
    joint = q.reshape(-1, 4, 3)
    hip, thigh, knee = joint.unbind(-1)
    side = q.new_tensor([1.0, -1.0, 1.0, -1.0])
    end = q.new_tensor([1.0, 1.0, -1.0, -1.0])
    ch, sh = hip.cos(), hip.sin()

    def place(forward: Tensor, down: Tensor) -> Tensor:
        """A point of the leg's plane, at lateral offset HIP_LENGTH, turned about the hip's x axis."""
        y, z = side * HIP_LENGTH, -down
        return torch.stack([end * HIP_X + forward, side * HIP_Y + ch * y - sh * z, sh * y + ch * z], -1)

    zero = torch.zeros_like(hip)
    knee_x, knee_z = -LINK * thigh.sin(), LINK * thigh.cos()
    shank = thigh + knee
    foot_x = knee_x - LINK * shank.sin() - 0.002 * shank.cos()
    foot_z = knee_z + LINK * shank.cos() - 0.002 * shank.sin()
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
    turn = rotation(x[:, 3:7])[:, 2]  # world z of each body axis
    height = x[:, 2]
    points = leg_points(x[:, 7:19]) @ turn[:, None, :, None]
    hip, knee, foot = (points.squeeze(-1) + height[:, None, None]).unbind(2)
    calf_end = knee + 0.8 * (foot - knee)  # the shin's capsule ends above the foot
    trunk = TRUNK_POINTS.to(x)
    return {
        "foot": foot - FOOT_RADIUS,
        "thigh": torch.minimum(hip, knee) - 0.017,
        "calf": torch.minimum(knee, calf_end) - 0.012,
        "hip": hip - 0.046,
        "trunk": (height[:, None] + turn @ trunk[:, :3].T - trunk[:, 3]).amin(1),
    }
