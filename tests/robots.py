"""Stand-in robots for tests, and a command that they can stand under."""

from __future__ import annotations

import numpy as np

from deploy.codec import RobotState, decode_state, encode_command
from hmc.go2 import model as go2
from tools.robot.motors import hold
from tools.robot.standin import Settings, StandIn, ideal

HOME = go2.HOME.numpy().astype(np.float64)
STAND = encode_command(hold(HOME, 60.0, 5.0))


def last(robot: StandIn, frames: list[bytes], steps: int = 1) -> RobotState:
    """The state after so many steps with these frames before each."""
    sent: list[bytes] = []
    for _ in range(steps):
        sent = robot.step(frames) or sent
    return decode_state(sent[-1])


def ready(settings: Settings | None = None) -> StandIn:
    """A released robot that stands."""
    robot = StandIn(settings or ideal())
    robot.release(True)
    return robot
