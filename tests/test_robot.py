"""The stand-in robot: repeatable to the byte, the planner's physics, what it obeys and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from deploy.codec import decode_state, encode_command, seal
from hmc.go2 import model as go2
from hmc.sim.mujoco import MujocoSim
from tests.robots import HOME, STAND, last, ready
from tools.robot.body import EXACT, Body, build
from tools.robot.motors import LIMP, damp, hold
from tools.robot.sensors import CLEAN
from tools.robot.standin import DAMPING, LYING, PERIOD, Settings, StandIn, ideal


def test_same_seed_same_bytes() -> None:
    def run(seed: int) -> list[bytes]:
        robot = ready(Settings(seed=seed))
        robot.feet.stuck = {1: 7}
        return [frame for _ in range(100) for frame in robot.step([STAND])]

    assert run(3) == run(3)
    assert all(a != b for a, b in zip(run(3), run(4), strict=True))


def test_agrees_with_the_planners_simulator() -> None:
    """Without unkindness, as long as nothing differs but the order in which damping is integrated."""
    ours = ready()
    theirs = MujocoSim(go2.load_model(substeps=20), 1, substeps=2)  # 1 ms physics, 2 ms steps
    truth = ours.truth()
    x = torch.tensor(np.concatenate([truth.qpos, truth.qvel]))[None]
    theirs.reset(x, go2.HOME[None].double())
    worst = np.zeros(2)
    for step in range(300):
        target = HOME + 0.15 * np.sin(2 * math.pi * 2 * step * PERIOD) * np.array([0, 1, -1] * 4)
        ours.step([encode_command(hold(target.astype(np.float32).astype(np.float64), go2.KP, go2.KD))])
        theirs.step(torch.tensor(target)[None])
        truth = ours.truth()
        error = np.abs(truth.qpos - theirs.x()[0, :19].numpy())
        worst = np.maximum(worst, [error[:7].max(), error[7:].max()])
    assert worst[0] < 0.002  # m, and quaternion
    assert worst[1] < 0.005  # rad
    assert np.abs(truth.qvel).max() > 0.3  # it moved


def test_bodies_differ_within_bounds() -> None:
    body = Body(mass=0.1, length=0.002, zero=0.01, friction=(0.3, 0.4))
    reference, _ = build(EXACT, np.random.default_rng(0))
    one, zeros = build(body, np.random.default_rng(1))
    other, _ = build(body, np.random.default_rng(2))
    ratio = one.body_mass[1:] / reference.body_mass[1:]
    assert 0.01 < np.abs(ratio - 1).max() <= 0.1
    assert one.body_inertia[1:] == pytest.approx(reference.body_inertia[1:] * ratio[:, None])
    moved = np.abs(one.body_pos - reference.body_pos)
    assert 0.0005 < moved.max() <= 0.002
    assert (np.abs(one.site_pos - reference.site_pos) <= 0.002).all()
    assert 0.002 < np.abs(zeros).max() <= 0.01
    feet = [one.geom(f"{leg}_foot").friction[0] for leg in go2.LEGS]
    assert 0.3 <= feet[0] <= 0.4
    assert len(set(feet)) == 1
    assert not np.array_equal(one.body_mass, other.body_mass)
    planner = go2.load_model()
    assert np.array_equal(reference.body_mass, planner.body_mass)
    assert np.array_equal(reference.body_pos, planner.body_pos)


def test_joint_zeros_reach_the_servo() -> None:
    """Told to go where its encoders read HOME, the robot goes elsewhere by their zeros."""
    robot = ready(replace(ideal(), body=replace(EXACT, zero=math.radians(2.0))))
    state = last(robot, [STAND], 300)
    off = state.q - robot.truth().qpos[7:]
    assert 0.01 < np.abs(off).max() <= math.radians(2.0)
    assert np.abs(off - (last(robot, [STAND], 50).q - robot.truth().qpos[7:])).max() < 1e-6


def test_a_push_moves_it() -> None:
    robot, still = ready(), ready()
    robot.push([60.0, 0.0, 0.0], 0.1)
    for _ in range(50):
        robot.step([STAND])
        still.step([STAND])
    # 60 N for 0.1 s on 15.2 kg that the legs hold back
    assert 0.05 < robot.truth().qvel[0] - still.truth().qvel[0] < 60 * 0.1 / 15.2
    with pytest.raises(ValueError, match="three finite forces"):
        robot.push([1.0, math.nan, 0.0], 1.0)


def test_divergence_is_an_error() -> None:
    robot = ready()
    robot._data.qvel[0] = math.nan
    with pytest.raises(RuntimeError, match="diverged at 0"):
        robot.step([STAND])


def test_commands_wait_for_release() -> None:
    robot = StandIn(ideal())
    limp = encode_command(LIMP)
    last(robot, [limp], 200)
    assert robot.refused == {"not released": 200}
    assert robot.truth().qpos[2] > 0.25  # its own controller holds it
    robot.release(True)
    last(robot, [limp], 300)
    assert robot.accepted == 300
    assert robot.truth().qpos[2] < 0.15


def test_released_and_told_nothing_it_sinks_slowly() -> None:
    robot = ready()
    last(robot, [], 100)
    assert np.abs(robot.truth().torque).max() > 0.5
    assert robot.truth().torque == pytest.approx(-DAMPING * robot.truth().qvel[6:], abs=0.3)


BROKEN = {
    "checksum": STAND[:400] + bytes([STAND[400] ^ 1]) + STAND[401:],
    "head": seal(bytearray(STAND[:4] + b"\0\0" + STAND[6:])),
    "level flag": encode_command(hold(HOME, 60.0, 5.0), level_flag=0),
    "motor mode": encode_command(hold(HOME, 60.0, 5.0)._replace(mode=np.full(12, 10))),
    "not a number": encode_command(hold(np.where(np.arange(12) == 7, math.nan, HOME), 60.0, 5.0)),
    "no LowCmd frame": STAND[:-4],
}


@pytest.mark.parametrize("reason", BROKEN)
def test_broken_commands_are_refused(reason: str) -> None:
    robot = ready()
    robot.step([BROKEN[reason], STAND])
    assert (robot.refused, robot.accepted) == ({reason: 1}, 1)


def test_lenient_robot_takes_commands_without_header() -> None:
    robot = ready(replace(ideal(), strict=False))
    robot.step([BROKEN["head"], BROKEN["level flag"], BROKEN["checksum"]])
    assert (robot.refused, robot.accepted) == ({"checksum": 1}, 2)


@pytest.mark.parametrize("loss", ["hold", "damp", "limp"])
def test_commands_stop(loss: str) -> None:
    robot = ready(replace(ideal(), loss=loss, loss_after=0.1))
    last(robot, [STAND], 400)
    before = robot.truth()
    last(robot, [], 49)
    assert robot.truth().qpos[2] == pytest.approx(before.qpos[2], abs=1e-3)  # not yet
    last(robot, [], 100)
    truth = robot.truth()
    if loss == "hold":
        assert truth.qpos[2] == pytest.approx(before.qpos[2], abs=2e-3)
    else:
        assert truth.qpos[2] < before.qpos[2] - 0.02
        assert (np.abs(truth.torque).max() == 0) == (loss == "limp")
    last(robot, [STAND], 200)
    assert robot.truth().qpos[2] == pytest.approx(before.qpos[2], abs=0.01)  # and it gets up again


def test_delays() -> None:
    """States leave 6 ms late with the tick of their measurement; commands act 4 ms late."""
    robot = ready(replace(ideal(), state_delay=0.006, command_delay=0.004))
    sent, accepted = [], []
    for _ in range(6):
        sent.append([decode_state(frame).tick for frame in robot.step([STAND])])
        accepted.append(robot.accepted)
    assert sent == [[], [], [], [2], [4], [6]]
    assert accepted == [0, 0, 1, 2, 3, 4]


def test_sensors_do_not_change_the_body() -> None:
    """Each part draws from a stream of its own, so that one can be switched off alone."""
    noisy, clean = ready(Settings(seed=2)), ready(Settings(seed=2, sensors=CLEAN))
    for robot in (noisy, clean):
        last(robot, [encode_command(damp(2.0))], 50)
    assert np.array_equal(noisy._model.body_mass, clean._model.body_mass)
    assert noisy.truth().qpos == pytest.approx(clean.truth().qpos, abs=1e-3)


def test_foot_stand_is_held_until_the_first_command() -> None:
    robot = StandIn(ideal(start="footstand"))
    start = robot.truth().qpos
    state = last(robot, [], 300)
    assert robot.truth().qpos == pytest.approx(start, abs=0.02)
    assert state.acc == pytest.approx([9.81, 0, 0], abs=0.2)  # nose up: what is up is the body's x
    last(robot, [encode_command(damp(0.0))], 200)
    assert robot.truth().qpos[2] < 0.4


def test_lying_robot_lies() -> None:
    robot = StandIn(ideal(start="lying"))
    last(robot, [], 250)
    truth = robot.truth()
    assert truth.qpos[2] < 0.12
    assert truth.qpos[7:] == pytest.approx(LYING, abs=0.3)
