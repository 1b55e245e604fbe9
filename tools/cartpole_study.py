"""What the cartpole study measures: its settings, its jobs, and the work of one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial

import torch
from torch import Tensor
from torch.func import jacfwd

from hmc import Budget, Plan, Receding, Task, plan
from hmc.ilqr import Optimum, ilqr
from hmc.sampling import METHODS, SamplingCfg, SamplingMpc
from hmc.sim.cartpole import CartpoleSim
from hmc.tasks.cartpole import CartpoleCfg, cartpole, initial_state

# a controller: state (1, 4), last input (1, 1), control step, snapshot row -> input (1, 1), steps rolled out
Controller = Callable[[Tensor, Tensor, int, Tensor], tuple[Tensor, int]]
ONE, ZERO = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
PLANNERS = ("schedules", *METHODS)


@dataclass(frozen=True)
class SamplerCfg:
    """One of the baselines.

    Attributes:
        noise: standard deviation of a knot's noise, in units of the force limit.
        spacing: control steps from one knot to the next.
        samples: rollouts an update.
        elites: of cem.
        temperature: of mppi.
    """

    noise: float = 1.0
    spacing: int = 4
    samples: int = 50
    elites: int = 8
    temperature: float = 0.1


@dataclass(frozen=True)
class SchedulesCfg:
    """The search over mode schedules, see `hmc.plan`."""

    samples: int = 64
    max_samples: int = 0
    order: str = "uniform"
    pairs: int = 0


@dataclass(frozen=True)
class LoopCfg:
    """Receding-horizon control: length of a run [control steps], and whole rollouts' worth of control
    steps that a planner may spend at each."""

    steps: int = 100
    rollouts: int = 50


@dataclass(frozen=True)
class StudyCfg:
    """cfg/cartpole.toml.

    Attributes:
        horizons: T, in control steps.
        seeds: of each planner.
        rollouts: budget of one solution: this many times T control steps.
        optima: iLQR's runs, with a seed each; the best of all is the reference.
        starts: random inputs that each of them begins from, beside what it came to at shorter horizons.
        iterations: of iLQR from each, at most.
        compare: horizons at which the following are compared.
        num_modes: numbers of modes.
        angles: start angles [rad].
        task: the cartpole.
        loop: receding-horizon control.
        schedules, mppi, cem, ps: the planners.
    """

    horizons: tuple[int, ...] = (20, 40, 70, 100, 150)
    seeds: int = 5
    rollouts: int = 1000
    optima: int = 3
    starts: int = 1
    iterations: int = 100
    compare: tuple[int, ...] = (70, 100)
    num_modes: tuple[int, ...] = (3, 5, 9, 17)
    angles: tuple[float, ...] = (math.pi, math.pi / 2)
    task: CartpoleCfg = field(default_factory=CartpoleCfg)
    loop: LoopCfg = field(default_factory=LoopCfg)
    schedules: SchedulesCfg = field(default_factory=SchedulesCfg)
    mppi: SamplerCfg = field(default_factory=SamplerCfg)
    cem: SamplerCfg = field(default_factory=SamplerCfg)
    ps: SamplerCfg = field(default_factory=SamplerCfg)

    def __post_init__(self) -> None:
        known = ", ".join(map(str, self.horizons))
        if not set(self.compare) <= set(self.horizons):
            raise ValueError(f"compare = {list(self.compare)}: choose among the horizons {known}")
        if self.task.horizon not in self.horizons:
            raise ValueError(
                f"task.horizon = {self.task.horizon}, which is drawn: choose one of the horizons {known}"
            )


@dataclass(frozen=True)
class Job:
    """One number of the study.

    Attributes:
        part: "solve" (one horizon, from the start) or "loop" (receding horizon).
        planner: one of PLANNERS, or "ilqr".
        horizon: T.
        seed: of everything random.
        num_modes: of the schedules.
        angle: at the start [rad].
    """

    part: str
    planner: str
    horizon: int
    seed: int
    num_modes: int
    angle: float


@dataclass(frozen=True)
class Row:
    """A line of results.csv: a job, the J it came to, and what it spent."""

    job: Job
    cost: float
    control_steps: int
    seconds: float


def jobs(cfg: StudyCfg) -> list[Job]:
    """All of the study, the longest first."""
    modes, angle, seeds = cfg.task.num_modes, cfg.task.angle, range(cfg.seeds)
    found = [
        Job(part, planner, horizon, seed, modes, angle)
        for horizon in sorted(cfg.horizons, reverse=True)
        for part, planners in (("loop", PLANNERS), ("solve", (*PLANNERS, "ilqr")))
        for planner in planners
        for seed in (range(cfg.optima) if planner == "ilqr" else seeds)
    ]
    found += [
        Job(part, "schedules", horizon, seed, count, angle)
        for part in ("loop", "solve")
        for horizon in cfg.compare
        for count in cfg.num_modes
        for seed in seeds
    ]
    found += [
        Job(part, planner, horizon, seed, modes, angle)
        for part, planners in (("loop", PLANNERS), ("solve", (*PLANNERS, "ilqr")))
        for horizon in cfg.compare
        for angle in cfg.angles
        for planner in planners
        for seed in (range(cfg.optima) if planner == "ilqr" else seeds)
    ]
    return list(dict.fromkeys(found))


def task_of(cfg: StudyCfg, job: Job) -> tuple[Task, Tensor]:
    """A job's cartpole and the state it begins in."""
    settings = replace(cfg.task, horizon=job.horizon, num_modes=job.num_modes, angle=job.angle)
    return cartpole(settings), initial_state(settings)


def sampler(cfg: SamplerCfg, method: str, task: Task, horizon: int, seed: int, rollouts: int) -> SamplingMpc:
    """A baseline that spends `rollouts` whole rollouts a re-plan."""
    settings = SamplingCfg(
        method=method,
        horizon=horizon,
        samples=cfg.samples,
        temperature=cfg.temperature,
        elites=cfg.elites,
        knots=max(2, round(horizon / cfg.spacing)),
        noise=cfg.noise,
        replan_every=1,
        iterations=max(1, rollouts // cfg.samples),
        worlds=cfg.samples,
    )
    return SamplingMpc(method, settings, task.make_sim, task.cost, -ONE, ONE, seed=seed)


def search(cfg: StudyCfg, job: Job) -> Plan:
    """The search over mode schedules, from the mode without force."""
    task, x = task_of(cfg, job)
    idle = [job.num_modes // 2] * job.horizon
    budget = Budget(control_steps=cfg.rollouts * job.horizon)
    return plan(task, x, schedule=idle, seed=job.seed, budget=budget, **asdict(cfg.schedules))


def optimum(cfg: StudyCfg, job: Job) -> Optimum:
    """The best of iLQR's local optima: from random inputs, and from what it comes to at the next shorter
    horizon, followed by no input or by what holds the pole up."""
    task, x = task_of(cfg, job)
    sim = task.make_sim(1)
    assert isinstance(sim, CartpoleSim)
    generator = torch.Generator().manual_seed(job.seed)
    random = torch.empty(cfg.starts, job.horizon, 1, dtype=torch.float64).uniform_(-1, 1, generator=generator)
    begins = list(random)
    if shorter := [each for each in cfg.horizons if each < job.horizon]:
        before = optimum(cfg, replace(job, horizon=max(shorter)))
        steps = job.horizon - max(shorter)
        ends = torch.zeros(steps, 1, dtype=torch.float64), hold(sim, before.states[-1], steps)
        begins += [torch.cat([before.controls, end]) for end in ends]
    descend = partial(
        ilqr, sim.advance, task.cost, sim.dt, x, lower=-ONE, upper=ONE, iterations=cfg.iterations
    )
    found = [descend(begin) for begin in begins]
    return min(found, key=lambda each: each.cost)


def hold(sim: CartpoleSim, x: Tensor, steps: int) -> Tensor:
    """Inputs (steps, 1) from state x (4,) on by which LQR about upright holds the pole, within the limits."""
    a, b = jacfwd(lambda x, u: sim.advance(x[None], u[None])[0], (0, 1))(torch.zeros_like(x), 0 * ONE)
    q = torch.tensor([4.0, 0.1, 0.1, 0.1], dtype=torch.float64).diag()
    value = q
    for _ in range(1000):
        gain = torch.linalg.solve(1 + b.T @ value @ b, b.T @ value @ a)
        value = q + a.T @ value @ (a - b @ gain)
    inputs = []
    for _ in range(steps):
        upright = torch.cat([torch.atan2(x[:1].sin(), x[:1].cos()), x[1:]])
        inputs.append((-gain @ upright).clamp(-1, 1))
        x = sim.advance(x[None], inputs[-1][None])[0]
    return torch.stack(inputs)


def solve(cfg: StudyCfg, job: Job) -> tuple[float, int]:
    """J of one horizon from the start, and the control steps it took."""
    if job.planner == "ilqr":
        return optimum(cfg, job).cost, 0
    if job.planner == "schedules":
        found = search(cfg, job)
        return found.cost, found.control_steps
    task, x = task_of(cfg, job)
    alone = sampler(getattr(cfg, job.planner), job.planner, task, job.horizon, job.seed, cfg.rollouts)
    solution = alone.solve(x, ZERO, cfg.rollouts * job.horizon)
    return solution.cost, solution.control_steps


def controller(cfg: StudyCfg, job: Job, task: Task, x: Tensor) -> Controller:
    """A planner that gives one input at a time, from state x (1, 4) on."""
    if job.planner != "schedules":
        settings = getattr(cfg, job.planner)
        mpc = sampler(settings, job.planner, task, job.horizon, job.seed, cfg.loop.rollouts)
        memory = mpc.reset(x, ZERO[None], torch.tensor([0]))

        def act(x: Tensor, before: Tensor, k: int, _: Tensor) -> tuple[Tensor, int]:
            nonlocal memory
            made = mpc.control_steps
            u, memory = mpc.act(x, before, memory, torch.tensor([k]))
            return u, mpc.control_steps - made

        return act
    budget = Budget(control_steps=cfg.loop.rollouts * job.horizon)
    idle = [job.num_modes // 2] * job.horizon
    receding = Receding(task, schedule=idle, seed=job.seed, budget=budget, **asdict(cfg.schedules))

    def tick(x: Tensor, before: Tensor, _: int, snapshot: Tensor) -> tuple[Tensor, int]:
        found = receding.tick(x[0], before[0], snapshot)
        return found.u[None], found.plan.control_steps

    return tick


def loop(cfg: StudyCfg, job: Job) -> tuple[float, int]:
    """Executed cost of a run under receding-horizon control, and the control steps rolled out."""
    task, x = task_of(cfg, job)
    world, cost, spent = task.make_sim(1), 0.0, 0
    world.reset(x[None], ZERO[None])
    control = controller(cfg, job, task, x[None])
    for i in range(cfg.loop.steps):
        x, before = world.x(), world.u()
        u, made = control(x, before, i, world.save()[0])
        spent += made
        cost += float(task.cost.stage_terms(x, u, before, torch.tensor([i])).sum()) * world.dt
        world.step(u)
    return cost + float(task.cost.terminal_terms(world.x(), torch.tensor([cfg.loop.steps])).sum()), spent


def work(cfg: StudyCfg, job: Job) -> Row:
    """One job, on one core."""
    torch.set_num_threads(1)
    began = time.perf_counter()
    with torch.no_grad():
        cost, spent = (loop if job.part == "loop" else solve)(cfg, job)
    return Row(job, cost, spent, time.perf_counter() - began)
