"""The flip: from the foot stand through a jump to the handstand, as a `Task`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.cost import Cost, StageFn, TerminalFn
from hmc.go2 import model as go2
from hmc.go2.ensemble import EnsembleCfg, make_ensemble
from hmc.go2.network import rotation
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STAND
from hmc.go2.value import Value
from hmc.modes import Mode, ModeSet, Motion
from hmc.rules import Rules
from hmc.sampling import SamplingCfg, SamplingMpc
from hmc.sim import make as engines
from hmc.sim.base import Sim
from hmc.task import Task
from hmc.trace import Floats

TARGETS = (FOOTSTAND, HANDSTAND, STAND)  # what a cost may ask for
FOOT_TARGET, HAND_TARGET, STAND_TARGET = range(3)


@dataclass(frozen=True)
class CostCfg:
    """Weights of Table I, and how long the planner takes the last state to go on.

    Attributes:
        height: of (z_target - z)^2 [1/m^2].
        orientation: of the squared distance of the gravity direction's body x, y from the target's.
        joints: of |q - q_nominal|^2 [1/rad^2], q_nominal the target stance's pose.
        rate: of |u_k - u_{k-1}|^2 [1/rad^2].
        energy: of the norm of joint powers [1/W].
        pose: of exp(-|q - q_default|^2), as printed.
        tail: the terminal cost is the height, orientation and joint terms at the end, held for this
            long [s]. Without it a fall now is better than a flip that ends just behind the horizon.
        value: of what the last state lacks to the value that the target's policy puts on its stance at rest,
            as a share of that; see `hmc.go2.value`. Only a task's own cost has it, not that of its jump.
    """

    height: float = 1.5
    orientation: float = 1.0
    joints: float = 0.5
    rate: float = 0.001
    energy: float = 0.003
    pose: float = 2.5e-7
    tail: float = 1.0
    value: float = 0.0


@dataclass(frozen=True)
class JumpCfg:
    """The jump mode.

    Attributes:
        sampling: the sampler's settings.
        cost: what its rollouts are judged by; the target is always the handstand.
        spacing: control steps between the points of the guess.
        guess: points (front thigh, front calf, rear thigh, rear calf) [rad] that the plan starts from,
            written by tools/jump_guess.py; empty: hold the last input.
        asymmetry: noise of single joints relative to that of left-right symmetric motion.
        hip: noise of the hip joints relative to the others.
        mpc: whether sampling MPC improves the guess on the way; else it is played as it is, which takes no
            rollouts inside the mode.
        dwell: control steps that it runs at least before another mode takes over; 0: any number.
    """

    sampling: SamplingCfg = field(default_factory=SamplingCfg)
    cost: CostCfg = field(default_factory=CostCfg)
    spacing: int = 8
    guess: tuple[tuple[float, ...], ...] = ()
    asymmetry: float = 0.2
    hip: float = 0.3
    mpc: bool = True
    dwell: int = 0

    def __post_init__(self) -> None:
        if self.spacing < 1 or self.dwell < 0:
            raise ValueError(
                f"jump.spacing must be at least 1 and jump.dwell at least 0, got {self.spacing}, {self.dwell}"
            )
        for point in self.guess:
            if len(point) != 4:
                raise ValueError(
                    f"jump.guess: each point is front thigh, front calf, rear thigh, rear calf, got {point}"
                )


@dataclass(frozen=True)
class FlipCfg:
    """The flip task.

    Attributes:
        horizon: planner's horizon, control steps.
        command: control step at which the target changes from the foot stand to the handstand.
        cost: weights of the planner's cost.
        jump: the jump mode.
        foot: policy file of the foot stand; empty for the one that comes with the package.
        hand: policy file of the handstand, likewise.
        substeps: physics steps a control step of the planner's model; the robot's own has 4.
        iterations: of the contact solver in the planner's model, at most; None for the robot's own.
        contacts: what the floor holds up in the planner's model, see `hmc.go2.model.load_model`.
        ensemble: other models that schedules are judged on as well.
        engine: that the planner rolls out on: mujoco, or warp for a GPU, or auto.
        device: of the engine; empty for its own, as in `hmc.sim.make.make_sim`.
        idle: further modes that this task has no use for, to see what they cost the search: of stand, getup
            (policies), home and crouch (joint positions held).
    """

    horizon: int = 75
    command: int = 75
    cost: CostCfg = field(default_factory=CostCfg)
    jump: JumpCfg = field(default_factory=JumpCfg)
    foot: str = ""
    hand: str = ""
    substeps: int = go2.SUBSTEPS
    iterations: int | None = None
    contacts: go2.Contacts = "all"
    ensemble: EnsembleCfg = field(default_factory=EnsembleCfg)
    engine: Literal["mujoco", "warp", "auto"] = "mujoco"
    device: str = ""
    idle: tuple[Literal["stand", "getup", "home", "crouch"], ...] = ()


def timeline(command: int) -> Callable[[Tensor], Tensor]:
    """Whether the target is the handstand at control step k (n,), else the foot stand."""
    return lambda k: k >= command


def stance_cost(cfg: CostCfg, target: Callable[[Tensor], Tensor]) -> Cost:
    """Table I with a target that depends on the control step.

    Args:
        cfg: weights.
        target: of control steps k (n,), as an index into `TARGETS`, or whether it is the handstand, (n,).
    """

    def height(x: Tensor, k: Tensor) -> Tensor:
        rows = _targets(x.dtype, x.device)[0][target(k).long()]
        return cfg.height * (rows - x[:, 2]).square()

    def orientation(x: Tensor, k: Tensor) -> Tensor:
        up = go2.vertical(x[:, 3:7])
        gravity = _targets(x.dtype, x.device)[1][target(k).long()]
        return cfg.orientation * ((up[:, 0] + gravity).square() + up[:, 1].square())

    def joints(x: Tensor, k: Tensor) -> Tensor:
        pose = _targets(x.dtype, x.device)[2][target(k).long()]
        return cfg.joints * (x[:, 7:19] - pose).square().sum(1)

    def rate(x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor) -> Tensor:
        return cfg.rate * (u - u_prev).square().sum(1)

    def energy(x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor) -> Tensor:
        power = x[:, 25:37] * go2.motor_torque(x[:, 7:19], x[:, 25:37], u)
        return cfg.energy * torch.linalg.vector_norm(power, dim=1)

    def pose(x: Tensor, *_: Tensor) -> Tensor:
        home = _targets(x.dtype, x.device)[2][STAND_TARGET]
        return cfg.pose * torch.exp(-(x[:, 7:19] - home).square().sum(1))

    stage_in_numpy, tail_in_numpy = _in_numpy(cfg, target)

    def tail(x: Tensor, k: Tensor) -> Tensor:
        if x.device.type == "cpu" and x.dtype == torch.float64 and not x.requires_grad:
            return tail_in_numpy(x, k)
        return cfg.tail * (height(x, k) + orientation(x, k) + joints(x, k))

    stage: dict[str, StageFn] = {
        "height": lambda x, u, u_prev, k: height(x, k),
        "orientation": lambda x, u, u_prev, k: orientation(x, k),
        "joints": lambda x, u, u_prev, k: joints(x, k),
        "rate": rate,
        "energy": energy,
        "pose": pose,
    }
    return Cost(stage, {"tail": tail}, nonnegative=True, on_cpu=stage_in_numpy)


def _in_numpy(cfg: CostCfg, target: Callable[[Tensor], Tensor]) -> tuple[StageFn, TerminalFn]:
    """The stage terms of `stance_cost` and its tail by the same operations: for few states a torch operation
    takes several times as long as one of numpy's. What adds numbers up is torch's, in its order."""
    weights = np.array([cfg.height, cfg.orientation, cfg.joints, cfg.rate, cfg.energy, cfg.pose])[:, None]
    cpu = torch.float64, torch.device("cpu")
    heights, gravity, poses = (each.numpy() for each in _targets(*cpu))

    def place(state: Floats, at: NDArray[np.int64], found: Floats) -> None:
        """Height and orientation without their weights, into `found` (2, n)."""
        ahead, sideways = rotation(state, slice(6, 8))
        ahead += gravity[at]
        below = heights[at] - state[:, 2]
        found[0], found[1] = below * below, ahead * ahead + sideways * sideways

    def terms(x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor) -> Tensor:
        state, inputs, at = x.numpy(), u.numpy(), target(k).long().numpy()
        q, qd = state[:, 7:19], state[:, 25:37]
        away = np.empty((3, len(state), 12))
        np.subtract(q, poses[at], out=away[0])
        np.subtract(inputs, u_prev.numpy(), out=away[1])
        np.subtract(q, poses[STAND_TARGET], out=away[2])
        away *= away
        squares = torch.from_numpy(away).sum(2)
        power = torch.from_numpy(qd * go2.motor_torque_in_numpy(q, qd, inputs))
        found = np.empty((6, len(state)))
        place(state, at, found[:2])
        found[2:4] = squares[:2]
        found[4], found[5] = torch.linalg.vector_norm(power, dim=1), torch.exp(-squares[2])
        found *= weights
        return torch.from_numpy(found).T

    def tail(x: Tensor, k: Tensor) -> Tensor:
        state, at = x.numpy(), target(k).long().numpy()
        away = state[:, 7:19] - poses[at]
        away *= away
        found = np.empty((3, len(state)))
        place(state, at, found[:2])
        found[2] = torch.from_numpy(away).sum(1)
        found *= weights[:3]
        height, orientation, joints = found
        return torch.from_numpy(cfg.tail * (height + orientation + joints))

    return terms, tail


def with_values(cost: Cost, weight: float, hand: Callable[[Tensor], Tensor], threads: int = 1) -> Cost:
    """A cost that ends with what the last state lacks in value; arguments as of `stance_cost`."""
    foot, other = (Value(policy_path(f"{name}_value"), threads) for name in ("footstand", "handstand"))

    def value(x: Tensor, k: Tensor) -> Tensor:
        target = hand(k)
        if x.device.type != "cpu":  # to count the rows of each is to wait for a GPU
            return weight * (1.0 - torch.where(target, other(x), foot(x))).clamp(min=0.0)
        lack = torch.zeros(len(x), dtype=x.dtype, device=x.device)
        for worth, rows in ((foot, (~target).nonzero()[:, 0]), (other, target.nonzero()[:, 0])):
            if len(rows) == len(x):
                return weight * (1.0 - worth(x)).clamp(min=0.0)
            if len(rows):
                lack[rows] = (1.0 - worth(x[rows])).clamp(min=0.0)
        return weight * lack

    return replace(cost, terminal={**cost.terminal, "value": value})


def _idle_mode(name: str, threads: int) -> Mode:
    """A mode that the flip has no use for, see `FlipCfg.idle`."""
    held = {"home": go2.HOME, "crouch": torch.tensor((0.0, 1.3, -2.6) * 4)}
    if name in held:
        return Motion(name, held[name].double()[None])
    return Policy(policy_path(name), name=name, threads=threads)


@cache
def _targets(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Of TARGETS: height [m] and gravity along the body's x axis, (3,) each, and pose (3, 12)."""
    with torch.inference_mode(False):
        state = torch.stack([each.state() for each in TARGETS]).to(device, dtype)
        gravity = torch.tensor([-1.0, 1.0, 0.0], dtype=dtype, device=device)
        return state[:, 2].clone(), gravity, state[:, 7:19].clone()


def policy_path(name: str, given: str = "") -> Path:
    """The policy file of a mode: the given one, else the one that comes with the package.

    Raises:
        ValueError: the package has none of this name; says how it is made.
    """
    path = Path(given) if given else Path(str(resources.files("hmc.go2") / "policies" / f"{name}.onnx"))
    if not given and not path.is_file():
        mode = name.removesuffix("_value")
        value = "" if mode == name else " --value"
        raise ValueError(
            f"policy {path}: no such file: make it with python train/ppo.py --mode {mode}, then "
            f"python train/export.py out/train/{mode}/latest.pt {path}{value}"
        )
    return path


def jump_mode(cfg: JumpCfg, make_sim: Callable[[int], Sim], seed: int) -> Mode:
    """The jump: MPPI towards the handstand, or the guess as it is."""
    if not cfg.mpc:
        if not cfg.guess:
            raise ValueError("jump.mpc is false, so jump.guess is played, but it is empty: give its points")
        inputs = dense_guess(torch.tensor(cfg.guess, dtype=torch.float64), cfg.spacing)
        return Motion("jump", inputs.clamp(go2.Q_LOWER.double(), go2.Q_UPPER.double()))
    return sampling_mode("jump", cfg, make_sim, lambda k: torch.ones_like(k, dtype=torch.bool), seed)


def sampling_mode(
    name: str, cfg: JumpCfg, make_sim: Callable[[int], Sim], hand: Callable[[Tensor], Tensor], seed: int
) -> SamplingMpc:
    """Sampling MPC towards the stance that `hand(k)` names, its noise mostly left-right symmetric."""
    symmetric = torch.zeros(4, 12)
    for row, joint in enumerate((1, 2, 7, 8)):
        symmetric[row, [joint, joint + 3]] = 1.0
    single = cfg.asymmetry * torch.diag(torch.tensor([cfg.hip, 1.0, 1.0] * 4))
    guess = None
    if cfg.guess:
        guess = dense_guess(torch.tensor(cfg.guess, dtype=torch.float64), cfg.spacing)
    return SamplingMpc(
        name,
        cfg.sampling,
        make_sim,
        stance_cost(cfg.cost, hand),
        go2.Q_LOWER.double(),
        go2.Q_UPPER.double(),
        guess=guess,
        basis=torch.cat([symmetric, single]).double(),
        seed=seed,
    )


def dense_guess(points: Tensor, spacing: int) -> Tensor:
    """Inputs (G, 12) of a left-right symmetric motion through points (P, 4), `spacing` steps apart."""
    at = torch.arange(spacing * (len(points) - 1) + 1) / spacing
    low = at.floor().long().clamp(max=len(points) - 2)
    dense = points[low] + (at - low)[:, None] * (points[low + 1] - points[low])
    hip, front, rear = torch.zeros(len(dense), 1, dtype=dense.dtype), dense[:, :2], dense[:, 2:]
    return torch.cat([hip, front, hip, front, hip, rear, hip, rear], 1)


def make_sim(
    num_worlds: int,
    substeps: int = go2.SUBSTEPS,
    iterations: int | None = None,
    threads: int = 0,
    engine: str = "mujoco",
    device: str = "",
    contacts: go2.Contacts = "all",
) -> Sim:
    """Worlds of the Go2; see `hmc.go2.model.load_model` and `hmc.sim.make.make_sim` (device "": none)."""
    model = go2.load_model(substeps, iterations, contacts)
    return engines.make_sim(
        model, num_worlds, engine, device=device or None, substeps=substeps, threads=threads
    )


def flip_task(cfg: FlipCfg, *, seed: int = 0, threads: int = 0) -> Task:
    """The flip with modes foot, jump and hand.

    Args:
        cfg: settings.
        seed: of the jump's noise and of the ensemble.
        threads: of the engine and the policies; 0 for all cores.

    Raises:
        ValueError: the engine or the device is not there, or a policy file is of no use.
    """
    engines.choose(cfg.engine, cfg.device or None)
    coarse: dict[str, Any] = {"substeps": cfg.substeps, "iterations": cfg.iterations, "threads": threads}
    coarse |= {"engine": cfg.engine, "device": cfg.device, "contacts": cfg.contacts}
    sim = partial(make_sim, **coarse)
    modes = ModeSet(
        [
            Policy(policy_path("footstand", cfg.foot), name="foot", threads=threads),
            jump_mode(cfg.jump, sim, seed),
            Policy(policy_path("handstand", cfg.hand), name="hand", threads=threads),
            *(_idle_mode(name, threads) for name in cfg.idle),
        ]
    )
    cost = stance_cost(cfg.cost, timeline(cfg.command))
    if cfg.cost.value > 0:
        cost = with_values(cost, cfg.cost.value, timeline(cfg.command), threads)
    others = make_ensemble(cfg.ensemble, seed=seed, **coarse)
    rules = Rules(dwell={"jump": cfg.jump.dwell}) if cfg.jump.dwell > 0 else None
    return Task("flip", modes, cost, cfg.horizon, sim, rules=rules, ensemble=others)
