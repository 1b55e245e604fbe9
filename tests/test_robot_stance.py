"""The stand-in is a robot that the project's policies can hold upright, through its own messages."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from deploy.codec import encode_command
from hmc.go2 import model as go2
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import policy_path
from tools.robot.motors import hold
from tools.robot.standin import PERIOD, Settings, StandIn, ideal


@pytest.mark.parametrize("settings", [ideal(start="footstand"), Settings(seed=3, start="footstand")])
def test_foot_stand_policy_holds_it(settings: Settings) -> None:
    """Two seconds on the hind legs, the policy told the truth, the robot as kind or unkind as it is."""
    robot, policy = StandIn(settings), Policy(policy_path("footstand"))
    u, memory = FOOTSTAND.pose[None].double(), torch.zeros(1, 4, dtype=torch.float64)
    for k in range(100):
        truth = robot.truth()
        x = torch.tensor(np.concatenate([truth.qpos, truth.qvel]))[None]
        assert FOOTSTAND.held(x).all(), f"fell after {robot.time:.2f} s"
        if k == 0:
            memory = policy.reset(x, u, torch.tensor([k]))
        u, memory = policy.act(x, u, memory, torch.tensor([k]))
        frame = encode_command(hold(u[0].numpy(), go2.KP, go2.KD))
        for _ in range(round(go2.DT / PERIOD)):
            robot.step([frame])
    assert robot.accepted == 1000 - (settings.command_delay > 0)  # one may still be on its way
