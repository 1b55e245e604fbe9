"""How fast it is, relative to the bare engine: `python tools/bench.py engine|train|planner [--json FILE]`.

Ratios are taken between two ways of doing the same work that take turns within one run, so that they mean
something on a busy machine too; rates a second do only on an idle one. What is compared is checked to have
come to the same states.
"""

from __future__ import annotations

import itertools
import os
import platform
import statistics
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import onnxruntime  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402
from mujoco.batch import Batch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc import Budget, Receding, Task, plan  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cost import Cost  # noqa: E402
from hmc.go2.model import HOME, Q_LOWER, Q_UPPER, load_model  # noqa: E402
from hmc.go2.policy import Policy  # noqa: E402
from hmc.go2.stances import FOOTSTAND, HANDSTAND  # noqa: E402
from hmc.go2.task import CostCfg, flip_task, policy_path, stance_cost  # noqa: E402
from hmc.modes import ModeSet  # noqa: E402
from hmc.rollout import Worlds, roll  # noqa: E402
from hmc.sim.mujoco import MujocoSim  # noqa: E402
from hmc.start import make_start  # noqa: E402
from hmc.tasks.cartpole import CartpoleCfg, ConstantInput, cartpole, initial_state  # noqa: E402
from tools import flip  # noqa: E402
from tools.random_policy import write_random_policy  # noqa: E402

SUBSTEPS = 4

# What the project asks of itself: figure -> at least this much.
TARGETS = {"open_loop_efficiency": 0.95, "policy_efficiency": 0.80, "train_steps_per_s": 6000.0}


@dataclass(frozen=True)
class Common:
    """What all measurements take.

    Attributes:
        json: file to write the figures to.
        threads: of the engine, of torch and of onnxruntime; 0 for all cores.
    """

    json: Path | None = None
    threads: int = 0


@dataclass(frozen=True)
class Engine(Common):
    """Our simulator and modes against the bare engine with the same model, threads and substeps.

    Attributes:
        worlds: stepped together.
        steps: control steps of a repeat.
        repeats: of each side.
        policy: file of the policy mode; default: the handstand that comes with the package.
        clock: wall, or cpu: time that all threads spent together, for one thread on a busy machine.
    """

    worlds: int = 256
    steps: int = 20
    repeats: int = 15
    policy: Path | None = None
    clock: Literal["wall", "cpu"] = "wall"


@dataclass(frozen=True)
class Train(Common):
    """Training steps a second, learning included, and where the time goes.

    Attributes:
        mode: whose cfg/MODE.toml.
        warm_up: iterations that do not count.
        iterations: that do.
        set: overrides of the configuration.
    """

    mode: str = "handstand"
    warm_up: int = 3
    iterations: int = 10
    set: tuple[str, ...] = ()


@dataclass(frozen=True)
class Planner(Common):
    """What the search itself costs, on a system that costs nothing, on the cartpole and on the Go2.

    Attributes:
        horizon: of the systems that cost nothing, control steps.
        draws: switches evaluated on the cartpole.
        samples: switches a batch.
        ticks: of the Go2's closed loop, from shortly before the command to flip on.
        set: overrides of cfg/flip.toml.
    """

    horizon: int = 50
    draws: int = 2048
    samples: int = 256
    ticks: int = 20
    set: tuple[str, ...] = ()


@dataclass
class Figures:
    """Figures by name, each with the words that explain it in the table."""

    values: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, value: float, note: str) -> None:
        """Take down one figure."""
        self.values[name], self.notes[name] = float(value), note

    def table(self, title: str) -> Table:
        """A row a figure, with its target where there is one."""
        view = Table(title=title)
        view.add_column("figure")
        view.add_column("value", justify="right")
        view.add_column("target")
        view.add_column("what")
        for name, value in self.values.items():
            target, digits = "", 3 if abs(value) < 10 else 0
            if name in TARGETS:
                met = "[green]met[/]" if value >= TARGETS[name] else "[red]not met[/]"
                target = f">= {TARGETS[name]:,g}  {met}"
            view.add_row(name, f"{value:,.{digits}f}", target, self.notes[name])
        return view


def machine(threads: int) -> dict[str, str | int | float]:
    """What the figures were taken on."""
    model = platform.processor() or "unknown"
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return {
        "cpu": model, "cores": os.cpu_count() or 1, "cores_allowed": cores(), "threads": threads,
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else -1.0,
        "python": platform.python_version(), "torch": str(torch.__version__), "mujoco": mujoco.__version__,
        "numpy": np.__version__, "onnxruntime": onnxruntime.__version__,
    }


def cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def take_turns(
    ours: Callable[[], Iterator[None]], bare: Callable[[], Iterator[None]], args: Engine
) -> np.ndarray:
    """Seconds of each side, (repeats, 2). They take turns at every `yield`; one repeat warms up."""
    times = np.zeros((args.repeats, 2))
    clock = time.perf_counter if args.clock == "wall" else time.process_time
    for repeat in range(-1, args.repeats):
        sides = ours(), bare()
        for turn in itertools.count():
            more = True
            for side in (0, 1) if turn % 2 else (1, 0):
                began = clock()
                more = next(sides[side], False) is None and more
                if repeat >= 0:
                    times[repeat, side] += clock() - began
            if not more:
                break
    return times


class Bare:
    """The engine alone, made to replay targets (T, W, nu) from snapshot rows."""

    def __init__(self, model: mujoco.MjModel, worlds: int, threads: int):
        self.batch = Batch(model, worlds, threads)
        self.ctrl = self.batch.bind("ctrl")

    def replay(self, rows: np.ndarray, targets: np.ndarray) -> Iterator[None]:
        """Step through all targets."""
        self.batch.state[:] = rows
        for target in targets:
            self.ctrl[:] = target
            self.batch.step(nstep=SUBSTEPS)
            yield


def add_ratio(figures: Figures, name: str, times: np.ndarray, physics_steps: int, what: str) -> None:
    """Efficiency = bare time / our time, the median over repeats, with its spread and our rate."""
    ratio = times[:, 1] / times[:, 0]
    low, high = np.percentile(ratio, [10, 90])
    rate = physics_steps / np.median(times, axis=0)
    figures.add(f"{name}_efficiency", float(np.median(ratio)), f"{what}; 10 to 90 %: {low:.3f} to {high:.3f}")
    figures.add(f"{name}_steps_per_s", rate[0], "physics steps/s, ours")
    figures.add(f"{name}_bare_steps_per_s", rate[1], "physics steps/s, the engine alone on the same work")
    figures.add(f"{name}_us_per_step", 1e6 / rate[0], "wall time a physics step, ours [us]")


def same(ours: np.ndarray, bare: np.ndarray, what: str) -> None:
    """Refuse to compare the speed of two different things."""
    if not np.array_equal(ours, bare):
        raise RuntimeError(f"{what}: the two sides came to different states, so their times cannot be compared")


@torch.no_grad()
def engine(args: Engine) -> Figures:
    """Open loop, policy mode and evaluator against the bare engine."""
    figures, model, threads = Figures(), load_model(), args.threads
    sim, bare = MujocoSim(model, args.worlds, substeps=SUBSTEPS, threads=threads), Bare(model, args.worlds, threads)
    physics_steps = args.worlds * args.steps * SUBSTEPS
    # open loop: from a stand on four legs, targets around it
    targets = HOME.double() + 0.1 * torch.randn(args.steps, args.worlds, 12, dtype=torch.float64)
    targets = targets.clamp(Q_LOWER.double(), Q_UPPER.double())
    x = HANDSTAND.state().expand(args.worlds, -1).clone()
    x[:, 2], x[:, 3], x[:, 5], x[:, 7:19] = 0.29, 1.0, 0.0, HOME.double()
    sim.reset(x, x[:, 7:19])
    rows = sim.save()

    def open_loop() -> Iterator[None]:
        sim.load(rows)
        for target in targets:
            sim.step(target)
            sim.x()
            yield

    times = take_turns(open_loop, lambda: bare.replay(rows.numpy(), targets.numpy()), args)
    same(sim.save().numpy(), bare.batch.state, "open loop")
    add_ratio(figures, "open_loop", times, physics_steps, f"{args.worlds} worlds, given targets")

    with tempfile.TemporaryDirectory() as folder:
        path = args.policy or policy_path("handstand")
        if not path.is_file():
            path = write_random_policy(Path(folder) / "random.onnx")
        policy = Policy(path, name="hand", threads=threads)
        words = "random policy" if path.name == "random.onnx" else path.name
        _policy_mode(figures, args, sim, bare, policy, words)
        _evaluator(figures, args, sim, bare, policy, words)
    return figures


def _policy_mode(figures: Figures, args: Engine, sim: MujocoSim, bare: Bare, policy: Policy, words: str) -> None:
    """Worlds in the handstand, each disturbed in its own way, under the policy."""
    x = HANDSTAND.state() + 0.05 * torch.randn(args.worlds, 37, dtype=torch.float64)
    x[:, 3:7] = HANDSTAND.state()[3:7]
    u = x[:, 7:19].clone()
    sim.reset(x, u)
    rows, k = sim.save(), torch.zeros(args.worlds, dtype=torch.long)
    entry = policy.reset(x, u, k)
    applied = torch.zeros(args.steps, args.worlds, 12, dtype=torch.float64)

    def closed_loop() -> Iterator[None]:
        sim.load(rows)
        memory = entry
        for step in range(args.steps):
            action, memory = policy.act(sim.x(), sim.u(), memory, k + step)
            sim.step(action)
            applied[step] = action
            yield

    deque(closed_loop(), maxlen=0)
    targets = applied.numpy().copy()
    times = take_turns(closed_loop, lambda: bare.replay(rows.numpy(), targets), args)
    same(sim.save().numpy(), bare.batch.state, "policy mode")
    add_ratio(figures, "policy", times, args.worlds * args.steps * SUBSTEPS, f"{args.worlds} worlds, {words}")


def _evaluator(figures: Figures, args: Engine, sim: MujocoSim, bare: Bare, policy: Policy, words: str) -> None:
    """The planner's rollouts under the same policy, costs included."""
    cost = stance_cost(CostCfg(), lambda k: k >= 0)
    task = Task("hold", ModeSet([policy]), cost, args.steps, lambda n: sim)
    start = make_start(task, sim, HANDSTAND.state(), HANDSTAND.pose.double(), None, None, 0, None)
    worlds, schedules = Worlds(task, sim), torch.zeros(args.worlds, args.steps, dtype=torch.long)
    worlds.reset(start, torch.arange(args.worlds))
    rows, targets, step = sim.save().numpy(), np.zeros((args.steps, args.worlds, 12)), sim.step

    def keep(u: Tensor, ids: Tensor | None = None) -> None:
        targets[keep.count] = u.numpy()  # type: ignore[attr-defined]
        keep.count += 1  # type: ignore[attr-defined]
        step(u, ids)

    keep.count = 0  # type: ignore[attr-defined]
    sim.step = keep  # type: ignore[method-assign]
    roll(worlds, start, schedules)
    del sim.step

    def rollouts() -> Iterator[None]:
        roll(worlds, start, schedules)
        yield

    def whole() -> Iterator[None]:
        deque(bare.replay(rows, targets), maxlen=0)
        yield

    times = take_turns(rollouts, whole, args)
    same(sim.save().numpy(), bare.batch.state, "evaluator")
    add_ratio(figures, "evaluator", times, args.worlds * args.steps * SUBSTEPS, f"rollouts with costs, {words}")


def train(args: Train) -> Figures:
    """PPO as train/ppo.py runs it: the same configuration, environment and runner."""
    from train.env import StanceEnv
    from train.ppo import TrainCfg, rsl_config
    from train.runner import Runner

    figures = Figures()
    cfg = load(ROOT / "cfg" / f"{args.mode}.toml", TrainCfg, args.set)
    torch.manual_seed(1)
    sim = MujocoSim(load_model(), cfg.env.worlds, substeps=SUBSTEPS, threads=args.threads)
    spent, step, entries = [0.0], sim.step, []

    def timed(u: Tensor, ids: Tensor | None = None) -> None:
        began = time.perf_counter()
        step(u, ids)
        spent[0] += time.perf_counter() - began

    sim.step = timed  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        meta = {"command": "tools/bench.py", "seed": "1", "config": "{}", "config_sha256": ""}
        runner = Runner(StanceEnv(cfg.env, sim), rsl_config(cfg.ppo), folder, "cpu", meta)
        began = [0.0]

        def update(log: dict[str, Any], extras: list[dict[str, Any]]) -> None:
            now = time.perf_counter()
            entries.append((now - began[0], log["collect_time"], log["learn_time"], spent[0]))
            began[0], spent[0] = now, 0.0

        runner.table.update = update  # type: ignore[method-assign]
        began[0] = time.perf_counter()
        runner.learn(args.warm_up + args.iterations, init_at_random_ep_len=True)
    whole, collect, learn, physics = np.array(entries[args.warm_up :]).T
    size = cfg.env.worlds * cfg.ppo.steps
    rate = size / whole
    low, high = np.percentile(rate, [10, 90])
    figures.add("train_steps_per_s", float(np.median(rate)),
                f"environment steps/s, learning included; 10 to 90 %: {low:,.0f} to {high:,.0f}")
    figures.add("collect_share", collect.sum() / whole.sum(), "of the time: collecting, physics included")
    figures.add("physics_share", physics.sum() / whole.sum(), "of the time: stepping the engine")
    figures.add("learn_share", learn.sum() / whole.sum(), "of the time: learning")
    return figures


@torch.no_grad()
def planner(args: Planner) -> Figures:
    """Overhead a candidate, the share of naive control steps, and the Go2's planning time."""
    figures = Figures()
    modes = ModeSet([ConstantInput(str(i), float(i)) for i in range(3)])
    zero = Cost({"nothing": lambda x, u, u_prev, k: x[:, 0]}, nonnegative=True)
    still = Task("still", modes, zero, args.horizon, NullSim)
    sim = NullSim(args.samples)
    found = [plan(still, [0.0], solver="exhaustive", samples=args.samples, sim=sim) for _ in range(3)]
    figures.add("plan_overhead_us", statistics.median(1e6 * p.elapsed / p.draws for p in found),
                f"a candidate, modes and simulator that do nothing [us]; T {args.horizon}, M 3, all of Omega")

    cfg = CartpoleCfg()
    sim_cart = cartpole(cfg).make_sim(args.samples)
    result = plan(cartpole(cfg), initial_state(cfg), samples=args.samples, budget=Budget(draws=args.draws),
                  solver="exhaustive", sim=sim_cart)
    figures.add("candidates_per_s", result.draws / result.elapsed, f"cartpole, T {cfg.horizon}, M {cfg.num_modes}")
    figures.add("control_steps_fraction", result.control_steps / (cfg.horizon * result.draws),
                "control steps used over T x schedules, cartpole")

    run = load(ROOT / "cfg" / "flip.toml", flip.RunCfg, args.set)
    if all(policy_path(*names).is_file() for names in (("footstand", run.task.foot), ("handstand", run.task.hand))):
        _ticks(figures, args, run)
    else:
        figures.notes["go2"] = "no policies: the Go2's planning time is left out"
    return figures


def _ticks(figures: Figures, args: Planner, cfg: flip.RunCfg) -> None:
    """The Go2's closed loop as tools/flip.py runs it, around the moment of the command."""
    task = flip_task(cfg.task, threads=args.threads)
    world, (x, u) = task.make_sim(1), flip.disturbed_start(cfg.start, 0)
    world.reset(x[None], u[None])
    loop = Receding(task, schedule=["foot"] * task.horizon, k=max(0, cfg.task.command - 5),
                    samples=cfg.search.samples, order=cfg.search.order,
                    budget=Budget(control_steps=cfg.search.control_steps))
    times, used, naive = [], 0, 0
    for _ in range(args.ticks):
        began = time.perf_counter()
        tick = loop.tick(world.x()[0], world.u()[0], world.save()[0])
        times.append(1e3 * (time.perf_counter() - began))
        used, naive = used + tick.plan.control_steps, naive + task.horizon * tick.plan.draws
        world.step(tick.u[None])
    p50, p99 = np.percentile(times, [50, 99])
    figures.add("go2_tick_ms_p50", p50, f"planning time of a tick at cfg/flip.toml's budget, {args.ticks} ticks [ms]")
    figures.add("go2_tick_ms_p99", p99, "the slowest of them [ms]")
    figures.add("go2_us_per_control_step", 1e3 * sum(times) / used, "wall time a control step, all included [us]")
    figures.add("go2_control_steps_fraction", used / naive, "control steps used, MPPI's own included, over T x draws")


class NullSim:
    """Worlds whose state never changes, at no cost: what is left is the planner's own work."""

    nx = nu = 1
    dt = 0.02
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, num_worlds: int):
        self.num_worlds, self._zero = num_worlds, torch.zeros(num_worlds, 1, dtype=self.dtype)

    def x(self, ids: Tensor | None = None) -> Tensor:
        return self._zero[: self.num_worlds if ids is None else len(ids)]

    u = save = x

    def reset(self, x: Tensor, u: Tensor, ids: Tensor | None = None) -> None:
        pass

    def step(self, u: Tensor, ids: Tensor | None = None) -> None:
        pass

    def load(self, rows: Tensor, ids: Tensor | None = None) -> None:
        pass


def main(args: Engine | Train | Planner) -> int:
    """Measure, print, write."""
    threads = args.threads or cores()
    args = type(args)(**{**vars(args), "threads": threads})
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    name = type(args).__name__.lower()
    host = machine(threads)
    figures = {"engine": engine, "train": train, "planner": planner}[name](args)  # type: ignore[operator]
    console = Console()
    console.print(figures.table(f"bench {name}"))
    for key, note in figures.notes.items():
        if key not in figures.values:
            console.print(note)
    console.print(", ".join(f"{key} {value}" for key, value in host.items()), highlight=False)
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        flip.write_json(args.json, {"bench": name, **figures.values, "machine": host})
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Engine | Train | Planner)))  # type: ignore[call-overload]
