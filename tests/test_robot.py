"""The stand-in robot: repeatable to the byte, motors and sensors by hand, its gate, the planner's physics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import (
    POSITION_STOP,
    VELOCITY_STOP,
    MotorCommand,
    RobotState,
    decode_state,
    encode_command,
    seal,
)
from deploy.remote import Button, Remote, unpack
from hmc.go2 import model as go2
from hmc.sim.mujoco import MujocoSim
from tools.robot.body import EXACT, Body, build
from tools.robot.motors import LIMP, Motors, damp, hold, limit, servo
from tools.robot.sensors import CLEAN, Battery, Feet, Imu, Sensors, roll_pitch_yaw
from tools.robot.standin import DAMPING, LYING, PERIOD, Settings, StandIn, ideal

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


# ---------------------------------------------------------------------------------- repeatable


def test_same_seed_same_bytes() -> None:
    def run(seed: int) -> list[bytes]:
        robot = ready(Settings(seed=seed))
        robot.feet.stuck = {1: 7}
        return [frame for _ in range(100) for frame in robot.step([STAND])]

    assert run(3) == run(3)
    assert all(a != b for a, b in zip(run(3), run(4), strict=True))


# ---------------------------------------------------------------------------------- motors


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


# ---------------------------------------------------------------------------------- physics


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


# ---------------------------------------------------------------------------------- the gate


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


# ---------------------------------------------------------------------------------- sensors


def test_clean_state_is_the_truth() -> None:
    robot = ready()
    state, truth = last(robot, [STAND], 100), robot.truth()
    assert state.crc_ok
    assert (state.tick, truth.tick) == (200, 200)
    assert state.q == pytest.approx(truth.qpos[7:], abs=1e-6)
    assert state.dq == pytest.approx(truth.qvel[6:], abs=1e-6)
    assert state.tau == pytest.approx(truth.torque, abs=1e-5)
    assert state.quat == pytest.approx(truth.qpos[3:7], abs=1e-6)
    assert state.gyro == pytest.approx(truth.qvel[3:6], abs=1e-6)
    assert state.foot_force.tolist() == np.round(truth.foot_force).tolist()
    assert truth.foot_force.sum() == pytest.approx(15.2 * 9.81, rel=0.1)
    assert state.acc == pytest.approx([0, 0, 9.81], abs=0.5)


def test_imu_errors_have_their_sizes() -> None:
    cfg = replace(CLEAN, gyro=0.01, acc=0.1, gyro_bias=0.005, acc_bias=0.05, yaw_drift=0.01)
    imu = Imu(cfg, np.random.default_rng(0))
    level, zero = np.array([1.0, 0, 0, 0]), np.zeros(3)
    reads = [imu.read(i * PERIOD, PERIOD, level, zero, zero) for i in range(5000)]
    quat, gyro, acc = (np.array(part) for part in zip(*reads, strict=True))
    assert gyro.std(0) == pytest.approx(0.01, rel=0.05)
    assert acc.std(0) == pytest.approx(0.1, rel=0.05)
    assert 0.0005 < np.abs(gyro.mean(0)).max() < 0.0056
    assert 0.005 < np.abs(acc.mean(0)).max() < 0.056
    drift = roll_pitch_yaw(quat[-1])[2] / (4999 * PERIOD)
    assert 0.0005 < abs(drift) <= 0.01


def test_bias_walks() -> None:
    cfg, zero = replace(CLEAN, gyro_walk=0.1), np.zeros(3)
    ends = [
        [imu.read(i * 0.01, 0.01, np.array([1.0, 0, 0, 0]), zero, zero) for i in range(400)][-1][1]
        for imu in (Imu(cfg, np.random.default_rng(seed)) for seed in range(60))
    ]
    assert np.std(ends) == pytest.approx(0.1 * math.sqrt(4.0), rel=0.15)


def test_slow_imu_repeats_itself() -> None:
    imu = Imu(replace(Sensors(), rate=200.0), np.random.default_rng(0))
    level, zero = np.array([1.0, 0, 0, 0]), np.zeros(3)
    reads = [tuple(imu.read(i * PERIOD, PERIOD, level, zero, zero)[1]) for i in range(500)]
    assert len(set(reads)) == 200  # a second


def test_encoders_count() -> None:
    robot = ready(replace(ideal(), sensors=replace(CLEAN, encoder=0.01)))
    state = last(robot, [STAND], 10)
    assert state.q == pytest.approx(np.round(state.q / 0.01) * 0.01, abs=1e-6)
    assert np.abs(state.q - robot.truth().qpos[7:]).max() <= 0.005 + 1e-6


def test_feet() -> None:
    """Counts are linear in the force; stuck feet and the message's range hold whatever the force."""
    feet = Feet(replace(CLEAN, foot_scale=0.3, foot_offset=15.0), np.random.default_rng(0))
    air, low, high = (feet.read(np.full(4, force), PERIOD) for force in (0.0, 1000.0, 2000.0))
    assert (np.abs(air) <= 15).all()
    assert len(set(air)) > 1
    assert ((low - air >= 700) & (low - air <= 1300)).all()
    assert high - low == pytest.approx(low - air, abs=1)
    feet.stuck = {2: 33}
    assert feet.read(np.full(4, 500.0), PERIOD)[2] == 33
    assert feet.read(np.full(4, 1e9), PERIOD).max() == 2**15 - 1

    drifting = Feet(replace(CLEAN, foot_drift=2.0), np.random.default_rng(0))
    walked = [drifting.read(np.zeros(4), 1.0) for _ in range(100)]
    assert 5 < np.std(walked[-1]) < 60  # 2 counts/sqrt(s) for 100 s: 20


def test_roll_pitch_yaw_by_hand() -> None:
    half = math.sqrt(0.5)
    assert roll_pitch_yaw(np.array([half, half, 0, 0])) == pytest.approx([math.pi / 2, 0, 0])
    assert roll_pitch_yaw(np.array([half, 0, half, 0]))[1] == pytest.approx(math.pi / 2, abs=1e-7)
    assert roll_pitch_yaw(np.array([half, 0, 0, half])) == pytest.approx([0, 0, math.pi / 2])


def test_battery_by_hand() -> None:
    battery = Battery(charge=50.0)
    assert battery.voltage == pytest.approx(8 * 3.7)
    battery.draw(np.zeros(12), np.zeros(12), 3600.0)
    assert battery.current == pytest.approx(-60 / 29.6)
    assert battery.charge == int(50 - 100 * 60 / 29.6 / 15)


def test_remote_travels() -> None:
    robot = ready()
    robot.remote = Remote(Button.L2 | Button.B, lx=0.5)
    assert unpack(last(robot, []).remote) == robot.remote
