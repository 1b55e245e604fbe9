"""The stand-in's body: the planner's model with other masses, lengths, friction and joint zeros."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources

import mujoco
import numpy as np

from deploy.codec import Floats
from hmc.go2.model import JOINTS, LEGS

STEP = 0.001  # s, of the physics and of the motors' servo loops


@dataclass(frozen=True)
class Body:
    """How far the body may be from the planner's model; each robot is drawn uniformly within.

    Attributes:
        mass: relative, of each link's mass and inertia.
        length: of each leg's hip, thigh and shank, and of the IMU's place [m].
        zero: of each joint's encoder [rad].
        friction: range of the feet's sliding friction; None for the model's.
        sticks: whether its feet `stick`, or have the model's contacts.
    """

    mass: float = 0.05
    length: float = 0.002
    zero: float = math.radians(0.5)
    friction: tuple[float, float] | None = (0.5, 1.0)
    sticks: bool = True

    def __post_init__(self) -> None:
        for name, most in (("mass", 0.9), ("length", 0.05), ("zero", math.pi)):
            if not 0 <= (value := getattr(self, name)) <= most:
                raise ValueError(f"{name} of the body must be off by 0 to {most:g}, got {value}")
        if self.friction is not None and not 0 <= self.friction[0] <= self.friction[1] < math.inf:
            raise ValueError(
                f"friction of the body must be a least and a most of 0 or more, got {self.friction}"
            )


EXACT = Body(mass=0.0, length=0.0, zero=0.0, friction=None, sticks=False)


def stick(spec: mujoco.MjSpec) -> None:
    """Feet that stick to the ground: friction 100 times as stiff as what bears the weight.

    The planner's pyramids are quicker, but let feet creep by 1 mm/s a newton, which no floor does; MuJoCo
    Menagerie's Go2 sticks the same way. With the model's iterations the solver stops early, and feet skate.
    """
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 100.0
    spec.option.iterations = spec.option.ls_iterations = 100


def build(body: Body, rng: np.random.Generator) -> tuple[mujoco.MjModel, Floats]:
    """A robot's model without actuators, with an IMU, a force sensor in each foot and a grip on the trunk.

    Returns:
        model: its sensor data are angular velocity and specific force at the IMU, in its frame, then
            the normal forces under the feet. Its one equality constraint can hold the base in a pose.
        zeros: what each encoder reads when the joint is at zero [rad], (12,).
    """
    spec = mujoco.MjSpec.from_file(str(resources.files("hmc.go2") / "go2.xml"))
    spec.option.timestep = STEP
    if body.sticks:
        stick(spec)
    for actuator in list(spec.actuators):  # the stand-in's motors are `tools.robot.motors`
        spec.delete(actuator)
    for link in spec.bodies[1:]:
        scale = 1 + rng.uniform(-body.mass, body.mass)
        link.mass *= scale
        link.inertia = link.inertia * scale
    friction = rng.uniform(*body.friction) if body.friction else None
    for leg in LEGS:
        foot = spec.geom(f"{leg}_foot")
        for part in (spec.body(f"{leg}_thigh"), spec.body(f"{leg}_calf"), foot):
            along = np.abs(part.pos) == np.abs(part.pos).max()
            part.pos = part.pos + np.sign(part.pos) * along * rng.uniform(-body.length, body.length)
        if friction is not None:
            foot.friction[0] = friction
        spec.body(f"{leg}_calf").add_site(name=f"{leg}_foot", pos=foot.pos, size=[0.03, 0.0, 0.0])
    spec.site("imu").pos = spec.site("imu").pos + rng.uniform(-body.length, body.length, 3)
    for kind, name in (("GYRO", "gyro"), ("ACCELEROMETER", "acc")):
        _sense(spec, kind, "imu", name)
    for leg in LEGS:
        _sense(spec, "TOUCH", f"{leg}_foot", f"{leg}_force")
    grip = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    grip.name1, grip.name2, grip.active = "world", "base", False
    return spec.compile(), rng.uniform(-body.zero, body.zero, len(JOINTS))


def _sense(spec: mujoco.MjSpec, kind: str, site: str, name: str) -> None:
    kind = getattr(mujoco.mjtSensor, f"mjSENS_{kind}")
    spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site, name=name)
