"""The flip in closed loop: settings, starts, controllers of the robot, and a run recorded step by step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from hmc import ModeSet, Receding, Task
from hmc.cfg import load
from hmc.cost import Cost
from hmc.go2.conditions import Conditions, NoiseCfg, Robots
from hmc.go2.model import DT, SUBSTEPS, product
from hmc.go2.observe import pitch
from hmc.go2.stages import Stages, judge
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import FlipCfg, policy_path
from hmc.receding import SearchCfg
from hmc.running import Running


@dataclass(frozen=True)
class StartCfg:
    """Half widths of the uniform disturbance of the starting foot stand.

    Attributes:
        joints: [rad].
        joint_speed: [rad/s].
        velocity: [m/s].
        spin: [rad/s].
        tilt: roll and pitch [rad].
    """

    joints: float = 0.05
    joint_speed: float = 0.3
    velocity: float = 0.15
    spin: float = 0.15
    tilt: float = 0.05


@dataclass(frozen=True)
class RunCfg:
    """cfg/flip.toml.

    Attributes:
        seconds: length of a run [s].
        task: modes, cost, horizon.
        search: effort at each control step.
        start: disturbance of the start.
    """

    seconds: float = 5.6
    task: FlipCfg = field(default_factory=FlipCfg)
    search: SearchCfg = field(default_factory=SearchCfg)
    start: StartCfg = field(default_factory=StartCfg)

    def __post_init__(self) -> None:
        if self.seconds <= DT / 2:  # they are rounded to control steps
            raise ValueError(f"seconds must be at least one control step, {DT:g}, got {self.seconds:g}")


MODEL = Conditions(noise=NoiseCfg.none())  # the robot is the planner's model, and knows its state


class Action(NamedTuple):
    """What a controller does at a control step: the input (12,), its mode's name, and what it notes down."""

    u: Tensor
    mode: str
    notes: dict[str, Any]


# (state as estimated (37,), last input (12,), snapshot of the world if the model is the robot) -> action
Controller = Callable[[Tensor, Tensor, Tensor | None], Action]
# at the end of each control step: (steps done, its record, pitch [rad], height [m])
Progress = Callable[[int, dict[str, Any], float, float], None]


@dataclass
class Run:
    """One seed's closed loop, recorded step by step.

    Attributes:
        seed: of the start, the draws and the jump's noise.
        x: true states, (n + 1, 37).
        modes: mode of each step, n names.
        log: one record a step.
        terms: stage cost terms of each step times dt, (n, terms).
        stages: what was reached.
    """

    seed: int
    x: Tensor
    modes: list[str]
    log: list[dict[str, Any]]
    terms: Tensor
    stages: Stages

    @property
    def cost(self) -> float:
        """Executed cost: the sum of all stage terms."""
        return float(self.terms.sum())

    @property
    def plan_ms(self) -> np.ndarray:
        """Planning time of each step [ms]."""
        return np.array([entry["plan_ms"] for entry in self.log])


def disturbed_start(cfg: StartCfg, seed: int) -> tuple[Tensor, Tensor]:
    """A foot stand under noise: state (37,) and last input (12,)."""
    generator = torch.Generator().manual_seed(seed)

    def noise(n: int, width: float) -> Tensor:
        return (2 * torch.rand(n, generator=generator, dtype=torch.float64) - 1) * width

    x = FOOTSTAND.state()
    x[7:19] += noise(12, cfg.joints)
    x[19:22] += noise(3, cfg.velocity)
    x[22:25] += noise(3, cfg.spin)
    x[25:37] += noise(12, cfg.joint_speed)
    roll, tilt = noise(2, cfg.tilt / 2)  # half angles
    turn = torch.stack([torch.ones_like(roll), roll, tilt, torch.zeros_like(roll)])
    x[3:7] = product(x[None, 3:7], turn[None] / turn.norm())[0]
    return x, x[7:19].clone()


def planned(cfg: RunCfg, task: Task, seed: int) -> Controller:
    """The planner: searches at every control step and runs the first step's mode."""
    loop = Receding(task, seed=seed, schedule=["foot"] * task.horizon, **cfg.search.options())

    def act(x: Tensor, u: Tensor, snapshot: Tensor | None) -> Action:
        tick = loop.tick(x, u, snapshot)
        plan = tick.plan
        notes = {
            "schedule": str(plan.schedule),
            "cost": plan.cost,
            "coverage": plan.coverage,
            "draws": plan.draws,
            "control_steps": plan.control_steps,
            "diverged": plan.diverged,
        }
        return Action(tick.u, task.modes.names[tick.mode], notes)

    return act


def chosen(modes: ModeSet, choose: Callable[[Tensor, int], str]) -> Controller:
    """Runs the mode that `choose` names for a state (37,) and control step."""
    running, k = Running(modes), 0

    def act(x: Tensor, u: Tensor, snapshot: Tensor | None) -> Action:
        nonlocal k
        name, made = choose(x, k), sum(mode.control_steps for mode in modes)
        action = running.act(modes.index(name), x, u, k)
        k += 1
        spent = sum(mode.control_steps for mode in modes) - made
        return Action(action, name, {"control_steps": spent})

    return act


def policies(*tasks: FlipCfg) -> list[Path]:
    """The policy files that flips of these tasks are run by."""
    found: dict[Path, None] = {}
    for cfg in tasks:
        critics = ("footstand_value", "handstand_value") if cfg.cost.value > 0 else ()
        learned = [name for name in cfg.idle if name in ("stand", "getup")]
        given = {"footstand": cfg.foot, "handstand": cfg.hand, **dict.fromkeys((*critics, *learned), "")}
        found |= dict.fromkeys(policy_path(name, path) for name, path in given.items())
    return list(found)


def same_model(cfg: FlipCfg) -> bool:
    """Whether a snapshot of the nominal robot means the same in the planner's model: it says how a world
    moves, not what the floor holds up, nor how often the solver iterates."""
    return cfg.substeps == SUBSTEPS and cfg.engine == "mujoco"


S = TypeVar("S")


def study_cfg(path: Path, kind: type[S], items: tuple[str, ...]) -> S:
    """A study's file with the flip of the flip.toml beside it as its `flip`.

    Overrides that begin with ``flip.`` are the latter's, and so is the study's `base`, if it has one.
    """
    own, flip = split(items, "flip.")
    found: Any = load(path, kind, own)
    base = getattr(found, "base", ())
    return cast(S, replace(found, flip=load(path.with_name("flip.toml"), RunCfg, (*base, *flip))))


def split(items: tuple[str, ...], prefix: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Overrides without a prefix, and those with it, which they lose."""
    inner = tuple(item.removeprefix(prefix) for item in items if item.startswith(prefix))
    return tuple(item for item in items if not item.startswith(prefix)), inner


@torch.no_grad()
def run(
    control: Controller,
    cost: Cost,
    cfg: RunCfg,
    seed: int,
    *,
    conditions: Conditions = MODEL,
    pushes: dict[int, tuple[float, float]] | None = None,
    progress: Progress | None = None,
) -> Run:
    """One closed loop of a controller and the robot.

    Args:
        control: called once a control step.
        cost: what is summed up over the run, from the true states.
        cfg: the start and the length.
        seed: of the start and of the robot.
        conditions: of the robot; by default it is the planner's model and knows its state exactly.
        pushes: control step -> speed [m/s] and direction [rad] of a push before it.
        progress: called after every step.
    """
    x, u = disturbed_start(cfg.start, seed)
    robot = Robots(conditions, x[None], u[None], seed=seed)
    exact = conditions == MODEL and same_model(cfg.task)
    xs, modes, log, terms = [x], [], [], []
    dt = robot.sim.dt
    for k in range(round(cfg.seconds / dt)):
        if pushes is not None and k in pushes:
            speed, direction = pushes[k]
            robot.push(torch.tensor([speed]), torch.tensor([direction]))
        x, u_prev = robot.x[0], robot.u[0]
        believed = x if conditions == MODEL else robot.estimate()[0]
        began = time.perf_counter()
        u, mode, notes = control(believed, u_prev, robot.sim.save()[0] if exact else None)
        elapsed = 1e3 * (time.perf_counter() - began)
        stage = cost.stage_terms(x[None], u[None], u_prev[None], torch.tensor([k]))[0] * dt
        robot.step(u[None])
        xs.append(robot.x[0])
        modes.append(mode)
        terms.append(stage)
        log.append(
            {
                "step": k,
                "time": k * dt,
                "mode": mode,
                "stage_cost": float(stage.sum()),
                "plan_ms": elapsed,
                **notes,
                "x": [round(v, 6) for v in x.tolist()],
                "u": [round(v, 6) for v in u.tolist()],
            }
        )
        if progress is not None:
            progress(k + 1, log[-1], math.degrees(float(pitch(x[None])[0])), float(x[2]))
    states = torch.stack(xs)
    switched = torch.tensor([name == "hand" for name in modes])
    if not switched.any():  # a controller without this mode is asked for the handstand by the command
        switched = torch.arange(len(modes)) >= cfg.task.command
    return Run(seed, states, modes, log, torch.stack(terms), judge(states, switched.long(), dt, 1))
