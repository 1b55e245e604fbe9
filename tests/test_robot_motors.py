"""The stand-in's motors: the servo law by hand, the torque-speed curve, weakness, warmth."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from deploy.codec import (
    POSITION_STOP,
    VELOCITY_STOP,
    MotorCommand,
)
from hmc.go2 import model as go2
from tools.robot.motors import LIMP, Motors, hold, limit, servo


def test_servo_law_by_hand() -> None:
    command = MotorCommand(
        q=np.full(12, 0.5),
        dq=np.full(12, -1.0),
        tau=np.full(12, 2.0),
        kp=np.full(12, 20.0),
        kd=np.full(12, 0.5),
        mode=np.ones(12, np.int64),
    )
    q, dq = np.full(12, 0.2), np.full(12, 3.0)
    # 2 + 20 (0.5 - 0.2) + 0.5 (-1 - 3) = 6
    assert servo(command, q, dq) == pytest.approx(np.full(12, 6.0))
    free = command._replace(q=np.full(12, POSITION_STOP))
    assert servo(free, q, dq) == pytest.approx(np.zeros(12))  # 2 - 2
    free = command._replace(dq=np.full(12, VELOCITY_STOP))
    assert servo(free, q, dq) == pytest.approx(np.full(12, 8.0))  # 2 + 6
    assert (servo(command._replace(mode=np.zeros(12, np.int64)), q, dq) == 0).all()


@pytest.mark.parametrize(
    ("asked", "speed", "hip", "calf"),
    [
        (100.0, 0.0, 20.2, 20.2 * 1.917),  # at rest: the peak
        (-100.0, 0.0, -20.2, -20.2 * 1.917),
        (100.0, 21.75, 10.1, None),  # hip: halfway down the line from 13.5 to 30 rad/s
        (100.0, 30.0, 0.0, None),  # no torque left to drive at the no-load speed
        (-100.0, 21.75, -20.2, None),  # a motor that brakes has its peak
        (100.0, 21.75 / 1.917, 20.2, 10.1 * 1.917),  # the calf's gear: less speed, more torque
        (5.0, 10.0, 5.0, 5.0),  # inside the curve nothing changes
    ],
)
def test_torque_speed_curve(asked: float, speed: float, hip: float, calf: float | None) -> None:
    given = limit(np.full(12, asked), np.full(12, speed))
    assert given[0] == pytest.approx(hip)
    if calf is not None:
        assert given[2] == pytest.approx(calf)


def test_motors_are_the_planners() -> None:
    rng = np.random.default_rng(0)
    q, target = rng.uniform(-2, 2, (2, 200, 12))
    dq = rng.uniform(-40, 40, (200, 12))
    theirs = go2.motor_torque(torch.tensor(q), torch.tensor(dq), torch.tensor(target)).numpy()
    for i in range(200):
        ours = limit(servo(hold(target[i], go2.KP, go2.KD), q[i], dq[i]), dq[i])
        assert ours == pytest.approx(theirs[i], abs=1e-5)  # GEAR is single precision


def test_weak_and_lost_motors() -> None:
    motors = Motors()
    motors.weaken({"*": 0.5, "RR_*": 0.25, "FL_calf": 0})
    torque = motors.drive(LIMP._replace(tau=np.full(12, 8.0)), np.zeros(12), np.zeros(12))
    assert torque.tolist() == [4, 4, 0, 4, 4, 4, 4, 4, 4, 2, 2, 2]
    motors.weaken({})
    assert (motors.strength == 1).all()
    with pytest.raises(ValueError, match="no joint is like 'LF_\\*': there are FL_hip"):
        motors.weaken({"LF_*": 0})
    with pytest.raises(ValueError, match="0 to 1, got 2"):
        motors.weaken({"*": 2})


def test_motors_warm_up() -> None:
    motors = Motors()
    motors.drive(LIMP._replace(tau=np.full(12, 10.0)), np.zeros(12), np.zeros(12))
    for _ in range(600):
        motors.warm(0.1)
    assert motors.temperature[0] == pytest.approx(30 + 0.17 * 600 * (1 - math.exp(-0.1)), abs=0.01)
