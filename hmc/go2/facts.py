"""The Unitree Go2 as plain numbers: joint order, limits, motors, poses, lengths, and what policies agree on.

Frames: the base frame has x forward, y left, z up, its origin at the trunk's centre. Joint order is
(FL, FR, RL, RR) x (hip, thigh, calf) everywhere. Lengths in m, angles in rad, torques in N m.

Sources: masses, inertias, offsets and joint limits are Unitree's, as published in MuJoCo Menagerie's
unitree_go2 (BSD-3-Clause); the motor's torque-speed curve is the one Unitree publishes for its Go2
actuators in unitree_rl_lab: 20.2 N m up to 13.5 rad/s, then linearly down to zero at 30 rad/s, on the
hip and the thigh; the calf is geared by a further 1.917.
"""

from __future__ import annotations

from typing import Any

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf"))
FRONT, REAR = (0, 1), (2, 3)

Q_LOWER = (-1.0472, -1.5708, -2.7227) * 2 + (-1.0472, -0.5236, -2.7227) * 2
Q_UPPER = (1.0472, 3.4907, -0.83776) * 2 + (1.0472, 4.5379, -0.83776) * 2

KP, KD = 35.0, 0.5  # N m/rad, N m s/rad
GEAR = (1.0, 1.0, 1.917) * 4  # calf linkage relative to the hip and thigh motors
STALL = 20.2 * 30.0 / (30.0 - 13.5)  # the driving line extended to zero speed [N m]
NO_LOAD = 30.0  # rad/s, before GEAR
PEAK = 20.2  # N m, before GEAR

# Balanced poses: the centre of mass is within 1 mm of the middle of the supporting feet.
HOME = (0.0, 0.9, -1.8) * 4
HANDSTAND = (0.0, -0.966, -1.16) * 2 + (0.0, 1.7, -1.853) * 2
FOOTSTAND = (0.0, 0.82, -1.6) * 2 + (0.0, 2.12, -1.16) * 2
HOME_HEIGHT = 0.29
STANCE_HEIGHT = 0.573

HIP_X, HIP_Y, HIP_LENGTH, LINK = 0.1934, 0.0465, 0.0955, 0.213
FOOT_RADIUS = 0.022
FOOT_BACK = 0.002  # the foot's centre lies behind the shank's axis
HIP_CENTRE = 0.08  # of the hip's sphere, sideways from its joint
CALF_END = (0.01, 0.17)  # where the shin's capsule ends: forward and down from the knee
IMU = (-0.02557, 0.0, 0.04232)  # in the base frame, as in Unitree's go2_description

DT = 0.02  # s, the control step that policies are trained at
SUBSTEPS = 4  # physics steps a control step

OBS_SIZE = 48
OBS_VERSION = 1  # of `hmc.go2.observe`
LEASH = 1.0  # m: the furthest that a policy is from its anchor; in training it seldom is further
# what a learned mode is commanded by, at the end of its observation; its base position is only a height
COMMANDS = {
    "walk": ("forward [m/s]", "sideways [m/s]", "turn [rad/s]"),
    "unified": ("-1: foot stand, +1: handstand",),
}


def contract() -> dict[str, Any]:
    """What a policy file must agree with, field by field."""
    return {
        "observation_version": OBS_VERSION,
        "observation_size": OBS_SIZE,
        "joint_order": list(JOINTS),
        "kp": KP,
        "kd": KD,
        "control_dt": DT,
    }


def disagreement(metadata: dict[str, Any]) -> str:
    """In which field a policy file's metadata does not agree with `contract`, or lacks one; "" if in none."""
    for field, expected in contract().items():
        if field not in metadata:
            return f"its metadata lacks {field!r}, expected {expected!r}: export it with train/export.py"
        if metadata[field] != expected:
            return (
                f"{field} is {metadata[field]!r}, expected {expected!r}: it was trained for another version "
                "of this robot's interface; train and export it again"
            )
    for field in ("mode", "default_pose", "action_scale"):
        if field not in metadata:
            return f"its metadata lacks {field!r}: export it with train/export.py"
    return ""
