"""What the comparison of controllers on the flip measures: its settings, its controllers, its jobs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hmc import ModeSet, Task
from hmc.go2.observe import pitch
from hmc.go2.policy import Policy
from hmc.go2.task import JumpCfg, flip_task, make_sim, policy_path, sampling_mode, timeline
from hmc.sampling import METHODS, SamplingCfg
from hmc.start import make_start
from hmc.worlds import Worlds, finite
from tools.closed_loop import Controller, RunCfg, chosen, disturbed_start, planned, run
from tools.study import whole

CONTROLLERS = {
    "ppo": "one policy, told to flip, tuned",
    "mppi": "MPPI only",
    "cem": "CEM only",
    "ps": "predictive sampling only",
    "untuned": "fixed sequence",
    "sequence": "fixed sequence, tuned",
    "pitch": "switches on pitch, tuned",
    "motion": "planned, jump as a motion",
    "ours": "planned, jump by MPPI",
}
FOOT, JUMP, HAND = range(3)
NEVER = 1_000_000  # control steps


@dataclass(frozen=True)
class Table2Cfg:
    """cfg/table2.toml.

    Attributes:
        trials: runs of each controller.
        first_seed: of the first; each trial's start and noise are the same for all controllers.
        tuning_seeds: of the runs that fixed sequences and thresholds are tuned on.
        early: control steps before the command at which a jump may begin, to choose from.
        durations: of the jump in a fixed sequence [control steps], to choose from.
        thresholds: of the pitch at which the hand mode takes over [deg], to choose from; -90: foot stand.
        untuned: duration of the jump in the sequence that nobody tuned; it begins at the command.
        sampling: of the controllers that sample inputs all the time.
        unified: policy file of the controller without modes; empty for the one that comes with the package.
        flip: the task, the planner's search and the start: cfg/flip.toml.
    """

    trials: int = 5
    first_seed: int = 100
    tuning_seeds: tuple[int, ...] = (1000, 1001, 1002)
    early: tuple[int, ...] = (40, 20, 0)
    durations: tuple[int, ...] = (10, 15, 20)
    thresholds: tuple[float, ...] = (-45.0, 0.0, 45.0)
    untuned: int = 20
    sampling: SamplingCfg = field(default_factory=SamplingCfg)
    unified: str = ""
    flip: RunCfg = field(default_factory=RunCfg)

    def __post_init__(self) -> None:
        for method in METHODS:
            replace(self.sampling, method=method)  # what one of them cannot do with shows here
        if set(self.tuning_seeds) & set(range(self.first_seed, self.first_seed + self.trials)):
            raise ValueError(
                f"tuning_seeds {self.tuning_seeds} must not be among the trials' own, {self.first_seed} to "
                f"{self.first_seed + self.trials - 1}"
            )


@dataclass(frozen=True)
class Rule:
    """A sequence of modes that is fixed beforehand: foot, jump, hand.

    Of the policy without modes, the first two are what it is told, foot stand and handstand.

    Attributes:
        early: control steps before the command at which the jump begins.
        duration: of the jump, at most [control steps].
        threshold: of the pitch at which the hand mode takes over [deg].
    """

    early: int
    duration: int = NEVER
    threshold: float = math.inf


def told(cfg: Table2Cfg) -> ModeSet:
    """The policy without modes, told to hold the foot stand, and told to be in the handstand."""
    path = policy_path("unified", cfg.unified)

    def policy(name: str, wanted: float) -> Policy:
        return Policy(path, name=name, command=lambda x, k: x.new_full((len(x), 1), wanted))

    return ModeSet([policy("told foot", -1.0), policy("told hand", 1.0)])


class Sequencer:
    """Follows one rule in each of n worlds.

    Args:
        rules: one a world.
        command: control step of the command.
    """

    def __init__(self, rules: Sequence[Rule], command: int):
        self.begin = torch.tensor([command - rule.early for rule in rules])
        self.duration = torch.tensor([rule.duration for rule in rules])
        self.threshold = torch.tensor([rule.threshold for rule in rules])
        self.taken = torch.zeros(len(rules), dtype=torch.long)
        self.landed = torch.zeros(len(rules), dtype=torch.bool)

    def __call__(self, x: Tensor, k: int) -> Tensor:
        """Mode of each world, (n,), at states x (n, 37) and control step k."""
        over = (self.taken >= self.duration) | (pitch(x).rad2deg() >= self.threshold)
        self.landed |= (self.taken > 0) & over
        modes = torch.where(k < self.begin, FOOT, torch.where(self.landed, HAND, JUMP))
        self.taken += modes == JUMP
        return modes


@torch.no_grad()
def executed_costs(task: Task, cfg: RunCfg, rules: Sequence[Rule], seed: int) -> Tensor:
    """Cost of a run under each of n rules, all from the same start, (n,) float64; inf where it diverged."""
    sim = task.make_sim(len(rules))
    worlds, follow = Worlds(task, sim), Sequencer(rules, cfg.task.command)
    worlds.reset(make_start(task, sim, *disturbed_start(cfg.start, seed)), None)
    cost, before = torch.zeros(len(rules), dtype=torch.float64), np.full(len(rules), -1)
    for k in range(round(cfg.seconds / sim.dt)):
        x, u_prev = sim.x(), sim.u()
        lost = ~finite(x)
        cost[lost] = math.inf
        x = torch.where(lost[:, None], x.new_tensor(0.0), x)
        modes = follow(x, k).numpy()
        u, before = worlds.act(worlds.crew(None, modes, before), x, u_prev, k), modes
        cost += task.cost.stage_terms(x, u, u_prev, torch.full((len(x),), k)).sum(1) * sim.dt
        sim.step(u)
    return cost


def tune(cfg: Table2Cfg, rules: Sequence[Rule], modes: ModeSet | None = None) -> tuple[Rule, float]:
    """The rule with the lowest mean cost over the tuning seeds, and that cost.

    Args:
        cfg: of the study.
        rules: to choose from.
        modes: that they switch between; default: the flip's.
    """
    costs = []
    for seed in cfg.tuning_seeds:
        task = flip_task(cfg.flip.task, seed=seed)
        task = task if modes is None else replace(task, modes=modes, rules=None)
        costs.append(executed_costs(task, cfg.flip, rules, seed))
    mean = torch.stack(costs).mean(0)
    best = int(mean.argmin())
    return rules[best], float(mean[best])


def sequences(cfg: Table2Cfg) -> list[Rule]:
    """The grid of fixed sequences."""
    return [Rule(early, duration) for early, duration in product(cfg.early, cfg.durations)]


def orders(cfg: Table2Cfg) -> list[Rule]:
    """When to tell the policy without modes to flip."""
    return [Rule(early) for early in cfg.early]


def switches(cfg: Table2Cfg) -> list[Rule]:
    """The grid of thresholds."""
    return [Rule(early, threshold=angle) for early, angle in product(cfg.early, cfg.thresholds)]


@dataclass(frozen=True)
class Job:
    """One run: a controller of CONTROLLERS, and the seed of its start."""

    controller: str
    seed: int


@dataclass(frozen=True)
class Row:
    """What came of a run; control steps and time are a tick's, on average."""

    job: Job
    foot_stand: bool
    jump_flip: bool
    handstand: bool
    cost: float
    control_steps: float
    plan_ms: float


def jobs(cfg: Table2Cfg) -> list[Job]:
    """All of the comparison, what takes longest first."""
    seeds = range(cfg.first_seed, cfg.first_seed + cfg.trials)
    return [Job(name, seed) for name in CONTROLLERS for seed in seeds]


def controller(cfg: Table2Cfg, rules: dict[str, Rule], job: Job) -> tuple[Controller, Task]:
    """A job's controller, and the task that its cost is of."""
    flip = cfg.flip.task
    if job.controller == "motion":
        flip = replace(flip, jump=replace(flip.jump, mpc=False))
    task = flip_task(flip, seed=job.seed, threads=1)
    if job.controller in ("motion", "ours"):
        return planned(cfg.flip, task, job.seed), task
    if job.controller in METHODS:
        settings = JumpCfg(replace(cfg.sampling, method=job.controller), flip.cost)
        mode = sampling_mode(
            job.controller, settings, lambda n: make_sim(n, threads=1), timeline(flip.command), job.seed
        )
        return chosen(ModeSet([mode]), lambda x, k: job.controller), task
    if job.controller == "ppo":
        task = replace(task, modes=told(cfg), rules=None)
    follow = Sequencer([rules[job.controller]], flip.command)
    return chosen(task.modes, lambda x, k: task.modes.names[int(follow(x[None], k))]), task


def work(cfg: Table2Cfg, rules: dict[str, Rule], job: Job) -> tuple[Row, dict[str, np.ndarray]]:
    """One run, on one core; and its states, modes and cost terms."""
    torch.set_num_threads(1)
    control, task = controller(cfg, rules, job)
    done = run(control, task.cost, cfg.flip, job.seed)
    steps = float(np.mean([entry["control_steps"] for entry in done.log]))
    stages = done.stages
    row = Row(
        job,
        stages.foot_stand,
        stages.jump_flip,
        stages.handstand,
        done.cost,
        steps,
        float(done.plan_ms.mean()),
    )
    arrays = {"x": done.x.float().numpy(), "modes": np.array(done.modes), "terms": done.terms.float().numpy()}
    return row, arrays


def keep(folder: Path, made: tuple[Row, dict[str, np.ndarray]]) -> Row:
    """Write what a run was into `folder`; its row."""
    row, arrays = made
    target = folder / f"{row.job.controller}_{row.job.seed}.npz"
    with whole(target) as partial:
        np.savez_compressed(partial, allow_pickle=False, **arrays)
    return row
