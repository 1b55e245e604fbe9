"""What the harder test of the flip measures: its settings, its jobs, and the work of one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.conditions import Conditions
from hmc.go2.ensemble import EnsembleCfg
from hmc.go2.observe import pitch
from hmc.go2.stances import HANDSTAND
from hmc.go2.task import flip_task
from hmc.go2.variants import VariantsCfg
from tools.closed_loop import MODEL, Run, RunCfg, planned, run

PLANNERS = ("nominal", "ensemble")
KEPT = 3.0  # s at the end of a run in which the handstand is held


@dataclass(frozen=True)
class SweepCfg:
    """Values of one factor at a time, all else as in the planner's model."""

    friction: tuple[float, ...] = ()
    payload: tuple[float, ...] = ()
    com: tuple[float, ...] = ()
    strength: tuple[float, ...] = ()
    stiffness: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    latency: tuple[float, ...] = ()
    zeros: tuple[float, ...] = ()
    noise: tuple[float, ...] = ()
    push: tuple[float, ...] = ()


@dataclass(frozen=True)
class RobustnessCfg:
    """cfg/robustness.toml.

    Attributes:
        trials: runs of each planner under all conditions at once.
        first_seed: of the first.
        sweep_trials: runs at each value of a factor.
        base: overrides of cfg/flip.toml that always hold, here those of the deployed planner. A noisy state
            makes every tick's jumps new ones, which sampling MPC would take ten times as long for.
        command: time of the command [s]; the search and the task are otherwise those of cfg/flip.toml.
        seconds: length of a run [s].
        foot_push: earliest and latest moment of the push in the foot stand [s].
        hand_push: of that in the handstand, after the command [s].
        conditions: of all at once. Each trial is another robot.
        ensemble: models that the planner called by this name plans on.
        sweep: factors and their values, in the units of `VariantsCfg`; noise: times that of the conditions;
            push: speed [m/s].
        flip: cfg/flip.toml under `base`.
    """

    trials: int = 100
    first_seed: int = 200
    sweep_trials: int = 10
    base: tuple[str, ...] = ()
    command: float = 3.0
    seconds: float = 9.2
    foot_push: tuple[float, float] = (0.4, 1.2)
    hand_push: tuple[float, float] = (1.2, 2.2)
    conditions: Conditions = field(default_factory=Conditions)
    ensemble: EnsembleCfg = field(default_factory=lambda: EnsembleCfg(members=2))
    sweep: SweepCfg = field(default_factory=SweepCfg)
    flip: RunCfg = field(default_factory=RunCfg)


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        planner: one of PLANNERS.
        factor: what differs from the planner's model; "all" for the conditions as they are.
        value: of the factor.
        seed: of the start, the robot, the noise and the pushes.
    """

    planner: str
    factor: str
    value: float
    seed: int


@dataclass(frozen=True)
class Row:
    """What came of a run; `success` is all three stages, `story` says in a line what went wrong."""

    job: Job
    success: bool
    foot_stand: bool
    jump_flip: bool
    kept: bool
    cost: float
    control_steps: float
    plan_ms: float
    story: str


def jobs(cfg: RobustnessCfg) -> list[Job]:
    """All of the test."""
    seeds = range(cfg.first_seed, cfg.first_seed + cfg.trials)
    found = [Job(planner, "all", 0.0, seed) for seed in seeds for planner in PLANNERS]
    for factor, values in vars(cfg.sweep).items():
        some = range(cfg.first_seed, cfg.first_seed + cfg.sweep_trials)
        found += [Job("nominal", factor, value, seed) for value in values for seed in some]
    return found


def conditions_of(cfg: RobustnessCfg, job: Job) -> Conditions:
    """What the robot of a job meets."""
    if job.factor == "all":
        return cfg.conditions
    if job.factor == "push":
        return replace(MODEL, push=job.value)
    if job.factor == "noise":
        return replace(MODEL, noise=cfg.conditions.noise.scaled(job.value))
    one: Any = job.value if job.factor in ("com", "zeros") else (job.value, job.value)
    return replace(MODEL, variants=VariantsCfg(**{job.factor: one}))


def pushes_of(cfg: RobustnessCfg, job: Job) -> dict[int, tuple[float, float]]:
    """A push in each stance: control step -> speed [m/s] and direction [rad]."""
    generator = torch.Generator().manual_seed(job.seed)
    moments, shares = torch.rand(2, generator=generator), torch.rand(2, generator=generator)
    directions = 2 * math.pi * torch.rand(2, generator=generator)
    top = conditions_of(cfg, job).push
    # alone, a push has the speed that is asked for; among other conditions, up to it
    speeds = (top * (shares if job.factor == "all" else torch.ones(2))).tolist()
    found = {}
    for i, (first, last) in enumerate((cfg.foot_push, cfg.hand_push)):
        at = first + (last - first) * float(moments[i]) + i * cfg.command
        found[round(at / go2.DT)] = (speeds[i], float(directions[i]))
    return {} if top == 0 else found


def work(cfg: RobustnessCfg, job: Job) -> Row:
    """One run, on one core."""
    torch.set_num_threads(1)
    ensemble = cfg.ensemble if job.planner == "ensemble" else EnsembleCfg()
    settings = replace(cfg.flip.task, command=round(cfg.command / go2.DT), ensemble=ensemble)
    flip = replace(cfg.flip, seconds=cfg.seconds, task=settings)
    task = flip_task(settings, seed=job.seed, threads=1)
    pushes = pushes_of(cfg, job)
    control = planned(flip, task, job.seed)
    done = run(control, task.cost, flip, job.seed, conditions=conditions_of(cfg, job), pushes=pushes)
    kept = bool(HANDSTAND.held(done.x)[-round(KEPT / go2.DT) :].all())
    stages = done.stages
    success = stages.foot_stand and stages.jump_flip and kept
    return Row(
        job,
        success,
        stages.foot_stand,
        stages.jump_flip,
        kept,
        done.cost,
        sum(entry["control_steps"] for entry in done.log) / len(done.log),
        float(done.plan_ms.mean()),
        "" if success else story(done, pushes),
    )


def story(done: Run, pushes: dict[int, tuple[float, float]]) -> str:
    """In a line, how a run failed: when and in which mode something else than feet touched the floor."""
    gap = go2.clearances(done.x)
    down = (gap["trunk"] <= 0) | (gap["thigh"] <= 0).any(1) | (gap["calf"] <= 0).any(1)
    if not bool(down.any()):
        return f"no fall; the handstand was held for {_longest(HANDSTAND.held(done.x)):.1f} s"
    at = int(down.nonzero()[0])
    mode = done.modes[min(at, len(done.modes) - 1)]
    angle = math.degrees(float(pitch(done.x[at : at + 1])))
    line = f"fell at {at * go2.DT:.2f} s in {mode}, pitch {angle:+.0f}"
    before = [step for step in pushes if 0 <= at - step < 75]
    if before:
        speed, direction = pushes[before[-1]]
        line += f", {(at - before[-1]) * go2.DT:.2f} s after a push of {speed:.2f} m/s"
        line += f" towards {math.degrees(direction):.0f} degrees"
    return line


def _longest(true: Tensor) -> float:
    """Duration of the longest run of true states [s]."""
    best = now = 0
    for value in true.tolist():
        now = now + 1 if value else 0
        best = max(best, now)
    return best * go2.DT
