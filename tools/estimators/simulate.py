"""Motions of the Go2 in C MuJoCo at 1 kHz, recorded as clean readings and the truth at 500 Hz."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from deploy.kinematics import legs
from hmc.cfg import load
from hmc.go2 import model as go2
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.go2.task import flip_task, policy_path
from hmc.modes import Mode
from tools.closed_loop import RunCfg, disturbed_start
from tools.robot.body import Body, stick

ROOT = Path(__file__).resolve().parents[2]
Array = NDArray[np.float64]
PHYSICS, SENSORS = 0.001, 0.002  # s
MOTIONS = ("stand", "trot", "footstand", "handstand", "flip", "fall")


@dataclass(frozen=True)
class BodyCfg:
    """How the simulated robot differs from the estimator's kinematics; half widths of uniform draws.

    Attributes:
        link: lengths of thighs and shanks, lateral offset of the legs [m].
        friction: of the feet, least and most.
    """

    link: float = Body.length
    friction: tuple[float, float] = (0.4, 1.0)


@dataclass(frozen=True)
class Log:
    """One motion at 500 Hz, n ticks: what perfect sensors would read, and the truth.

    Attributes:
        t: [s], (n,).
        gyro, acc: mean over the tick, in the body frame at the IMU [rad/s], [m/s^2], (n, 3).
        tau: joint torques [N m], (n, 12).
        force: normal forces of the feet [N], (n, 4).
        x: state, (n, 37).
        slip: speed of each foot's lowest point in the ground's plane [m/s], (n, 4).
        kept: whether the robot did what it should: no fall, the flip caught, or at rest after a fall.
    """

    t: Array
    gyro: Array
    acc: Array
    tau: Array
    force: Array
    x: Array
    slip: Array
    kept: bool


def robot(cfg: BodyCfg, rng: np.random.Generator) -> mujoco.MjModel:
    """The Go2 with an IMU, its links and friction off by draws from `rng`."""
    spec = mujoco.MjSpec.from_file(str(resources.files("hmc.go2") / "go2.xml"))
    spec.option.timestep = PHYSICS
    stick(spec)
    for name, kind in (("gyro", "GYRO"), ("acc", "ACCELEROMETER")):
        kind = getattr(mujoco.mjtSensor, f"mjSENS_{kind}")
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    model = spec.compile()
    for leg in go2.LEGS:
        along, shank, out = rng.uniform(-cfg.link, cfg.link, 3)
        model.body_pos[model.body(f"{leg}_calf").id, 2] += along
        model.geom_pos[model.geom(f"{leg}_foot").id, 2] += shank
        model.body_pos[model.body(f"{leg}_thigh").id, 1] += out
        model.geom_friction[model.geom(f"{leg}_foot").id, 0] = rng.uniform(*cfg.friction)
    return model


class Recorder:
    """Steps one robot and keeps what is read at each tick."""

    def __init__(self, model: mujoco.MjModel, x: Array, u: Array):
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = x[:19], x[19:], u
        self.rows: list[Array] = []
        self._feet = [model.geom(f"{leg}_foot").id for leg in go2.LEGS]

    @property
    def x(self) -> Array:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def run(self, u: Array, seconds: float) -> None:
        """Hold targets u (12,) for a while."""
        self.data.ctrl[:] = u
        for _ in range(round(seconds / SENSORS)):
            imu = np.zeros(6)
            for _ in range(round(SENSORS / PHYSICS)):
                mujoco.mj_step(self.model, self.data)
                imu += self.data.sensordata * (PHYSICS / SENSORS)
            # forces and velocities of links belong to the state before the last substep
            mujoco.mj_forward(self.model, self.data)
            self.rows.append(np.concatenate([[self.data.time], imu, self._rest()]))

    def restart(self) -> None:
        """Forget what was recorded; the motion goes on."""
        self.rows, self.data.time = [], 0.0

    def _rest(self) -> Array:
        """Torques (12,), foot forces (4,), state (37,), slip (4,)."""
        data, force, wrench = self.data, np.zeros(4), np.zeros(6)
        for i, contact in enumerate(data.contact):
            for leg, geom in enumerate(self._feet):
                if geom in contact.geom:
                    mujoco.mj_contactForce(self.model, data, i, wrench)
                    force[leg] += wrench[0]
        slip, velocity = np.zeros(4), np.zeros(6)
        for leg, geom in enumerate(self._feet):
            mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, velocity, 0)
            wx, wy, _, vx, vy, _ = velocity
            slip[leg] = math.hypot(vx - go2.FOOT_RADIUS * wy, vy + go2.FOOT_RADIUS * wx)
        return np.concatenate([data.actuator_force, force, self.x, slip])

    def log(self, kept: bool) -> Log:
        """All that was recorded."""
        rows = np.array(self.rows)
        t, gyro, acc, tau, force, x, slip = np.split(rows, np.cumsum([1, 3, 3, 12, 4, 37]), axis=1)
        return Log(t[:, 0], gyro, acc, tau, force, x, slip, kept)


def simulate(motion: str, seconds: float, seed: int, cfg: BodyCfg | None = None) -> Log:
    """Record a motion.

    Args:
        motion: one of `MOTIONS`; the flip takes the foot stand's and the handstand's time from `seconds`, the
            fall is a handstand that goes limp after a second.
        seconds: length [s].
        seed: of the robot's body and of its start.

    Raises:
        ValueError: an unknown motion.
    """
    if motion not in MOTIONS:
        raise ValueError(f"motion {motion!r}: expected one of {', '.join(MOTIONS)}")
    model = robot(cfg or BodyCfg(), np.random.default_rng([seed, 0]))
    if motion in ("stand", "trot"):
        return _gait(model, seconds, motion == "trot")
    if motion == "flip":
        return _flip(model, seconds, seed)
    stance = FOOTSTAND if motion == "footstand" else HANDSTAND
    x = stance.state().numpy()
    recorder = Recorder(model, x, x[7:19])
    if motion == "fall":
        return _fall(recorder, seconds)
    hold(recorder, Policy(policy_path(motion)), round(seconds / go2.DT), 0)
    return recorder.log(bool(stance.held(torch.from_numpy(recorder.x)[None])))


def hold(recorder: Recorder, mode: Mode, steps: int, first: int) -> None:
    """Run a mode for some control steps; it sees the true state."""
    x, u = _rows(recorder)
    memory = mode.reset(x, u, torch.tensor([first]))
    for k in range(first, first + steps):
        x, u = _rows(recorder)
        target, memory = mode.act(x, u, memory, torch.tensor([k]))
        recorder.run(target[0].numpy(), go2.DT)


def _rows(recorder: Recorder) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(recorder.x)[None], torch.from_numpy(recorder.data.ctrl.copy())[None]


def _gait(model: mujoco.MjModel, seconds: float, trot: bool) -> Log:
    """Stand on four legs, or trot after a second: diagonal pairs step at 2.5 Hz, feet sliding."""
    home = go2.HOME.double().numpy()
    x = np.zeros(37)
    x[2], x[3], x[7:19] = go2.HOME_HEIGHT, 1.0, home
    recorder = Recorder(model, x, home)
    recorder.run(home, 2.0)
    recorder.restart()
    recorder.run(home, min(1.0, seconds))
    lift, stride, rate, weight = 0.35, 0.06, 2.5, 100.0
    while (time := recorder.data.time) < seconds - 1e-9:
        target, leg = home.reshape(4, 3).copy(), legs(recorder.x[7:19])
        for i, phase in enumerate((0.0, 0.5, 0.5, 0.0)) if trot else ():
            angle = 2.0 * math.pi * ((rate * (time - 1.0) + phase) % 1.0)
            up = lift * max(0.0, math.sin(angle))
            target[i, 1] += up + stride * math.cos(angle)
            target[i, 2] -= 2.0 * up
            if up == 0.0:  # the servo is soft: two legs would sag under the weight
                target[i] -= weight / 2.0 / go2.KP * leg.jacobian[i, 2]
        recorder.run(target.reshape(12), SENSORS)
    return recorder.log(bool(go2.vertical(torch.from_numpy(recorder.x)[None, 3:7])[0, 2] > 0.9))


def _flip(model: mujoco.MjModel, seconds: float, seed: int) -> Log:
    """The foot stand, then 15 control steps of the jump, then the handstand."""
    cfg = load(ROOT / "cfg" / "flip.toml", RunCfg)
    modes = flip_task(cfg.task, seed=seed, threads=1).modes
    start, u = disturbed_start(cfg.start, seed)
    recorder = Recorder(model, start.numpy(), u.numpy())
    jump, before = 15, round(0.4 * seconds / go2.DT)
    hold(recorder, modes["foot"], before, 0)
    hold(recorder, modes["jump"], jump, before)
    hold(recorder, modes["hand"], round(seconds / go2.DT) - before - jump, before + jump)
    return recorder.log(bool(HANDSTAND.held(torch.from_numpy(recorder.x)[None])))


def _fall(recorder: Recorder, seconds: float) -> Log:
    """The handstand for a second, then the joints at the pose of four feet: it topples, and comes to lie."""
    steps = min(50, round(seconds / go2.DT))
    hold(recorder, Policy(policy_path("handstand")), steps, 0)
    recorder.run(go2.HOME.double().numpy(), seconds - steps * go2.DT)
    return recorder.log(bool(np.linalg.norm(recorder.x[19:25]) < 0.1))
