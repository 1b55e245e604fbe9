"""Our simulator, policy mode and evaluator, against the bare engine on the same work."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from hmc.go2.model import HOME, Q_LOWER, Q_UPPER, load_model
from hmc.go2.policy import Policy
from hmc.go2.stances import HANDSTAND
from hmc.go2.task import CostCfg, policy_path, stance_cost
from hmc.modes import Mode, ModeSet, Motion
from hmc.rollout import roll
from hmc.schedule import Schedule, SwitchSpace
from hmc.sim.ids import Ids, where
from hmc.sim.mujoco import MujocoSim
from hmc.start import make_start
from hmc.task import Task
from hmc.trace import roots
from hmc.worlds import Worlds
from tools.benchmarks.figures import Common, Figures
from tools.random_policy import write_random_policy

SUBSTEPS = 4


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


def take_turns(
    ours: Callable[[], Iterator[None]],
    bare: Callable[[], Iterator[None]],
    repeats: int,
    clock_of: str = "wall",
) -> np.ndarray:
    """Seconds of each side, (repeats, 2). They take turns at every `yield`; one repeat warms up."""
    times = np.zeros((repeats, 2))
    clock = time.perf_counter if clock_of == "wall" else time.process_time
    for repeat in range(-1, repeats):
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
        raise RuntimeError(
            f"{what}: the two sides came to different states, so their times cannot be compared"
        )


@torch.no_grad()
def engine(args: Engine) -> Figures:
    """Given targets, and a policy's, through the simulator, against the bare engine."""
    figures, model, threads = Figures(), load_model(), args.threads
    sim, bare = (
        MujocoSim(model, args.worlds, substeps=SUBSTEPS, threads=threads),
        Bare(model, args.worlds, threads),
    )
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

    times = take_turns(
        open_loop, lambda: bare.replay(rows.numpy(), targets.numpy()), args.repeats, args.clock
    )
    same(sim.save().numpy(), bare.batch.state, "open loop")
    add_ratio(figures, "sim_open_loop", times, physics_steps, f"{args.worlds} worlds, given targets")

    with tempfile.TemporaryDirectory() as folder:
        path = args.policy or policy_path("handstand")
        if args.policy is None and not path.is_file():
            path = write_random_policy(Path(folder) / "random.onnx")
        policy = Policy(path, name="hand", threads=threads)
        words = "random policy" if path.name == "random.onnx" else path.name
        _policy_mode(figures, args, sim, bare, policy, words)
    return figures


def _policy_mode(
    figures: Figures, args: Engine, sim: MujocoSim, bare: Bare, policy: Policy, words: str
) -> None:
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
    times = take_turns(closed_loop, lambda: bare.replay(rows.numpy(), targets), args.repeats, args.clock)
    same(sim.save().numpy(), bare.batch.state, "policy mode")
    made = args.worlds * args.steps * SUBSTEPS
    add_ratio(figures, "sim_policy", times, made, f"{args.worlds} worlds, {words}")


@dataclass(frozen=True)
class Turns:
    """How evaluator and bare engine take turns: threads of both, repeats, and what the clock counts."""

    threads: int
    repeats: int
    clock: str = "wall"


@torch.no_grad()
def evaluator(figures: Figures, turns: Turns, path: Path, horizon: int, few: int) -> None:
    """The bare engine's efficiency inside the evaluator: `policy_efficiency` and `open_loop_efficiency`.

    Args:
        figures: get these, and the same of few worlds.
        turns: of the two sides.
        path: of the policy that all three modes are.
        horizon: of all of Omega, control steps.
        few: horizon with two modes, so that the worlds are few.
    """
    policies = [Policy(path, name=name, threads=turns.threads) for name in ("hand", "other", "third")]
    pose = HANDSTAND.pose.double()
    played = [
        Motion(mode.name, pose + 0.1 * torch.randn(max(horizon, few), 12, dtype=torch.float64))
        for mode in policies
    ]
    kinds: tuple[tuple[str, Sequence[Mode], str], ...] = (
        ("policy", policies, path.name),
        ("open_loop", played, "motions"),
    )
    for name, modes, words in kinds:
        _evaluator(figures, turns, name, modes, horizon, words)
        _evaluator(figures, turns, f"{name}_few", modes[:2], few, words)


def _evaluator(
    figures: Figures, turns: Turns, name: str, modes: Sequence[Mode], horizon: int, words: str
) -> None:
    """The planner's rollouts of all single switches, costs included, against the steps that they come to."""
    space = SwitchSpace(len(modes), horizon)
    others = torch.arange(len(space) // len(modes), len(space))  # into the mode that runs nothing changes
    schedules = space.stitch(Schedule.constant(0, horizon), others)
    model, many = load_model(), len(others)
    sim = MujocoSim(model, many, substeps=SUBSTEPS, threads=turns.threads)
    bare = Bare(model, many, turns.threads)
    cost = stance_cost(CostCfg(), lambda k: k >= 0)
    task = Task("hold", ModeSet(modes), cost, horizon, lambda n: sim)
    start = make_start(task, sim, HANDSTAND.state(), HANDSTAND.pose.double(), None, None, 0, None)
    worlds = Worlds(task, sim)
    trunk, step = roots(worlds, [start]), sim.step
    steps: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def keep(u: Tensor, ids: Ids = None) -> None:
        index = torch.arange(many)[where(ids)]
        steps.append((index.numpy(), sim.save(ids).numpy(), u.numpy()))
        step(u, ids)

    sim.step = keep  # type: ignore[method-assign]
    limit = 1e9  # nothing exceeds it, but as in a search it is looked at before branches are born
    roll(worlds, trunk, schedules, limit)
    del sim.step

    def rollouts() -> Iterator[None]:
        roll(worlds, trunk, schedules, limit)
        yield

    def whole() -> Iterator[None]:
        for ids, rows, target in steps:
            bare.batch.state[ids] = rows
            bare.ctrl[ids] = target
            bare.batch.step(ids, nstep=SUBSTEPS)
        yield

    times = take_turns(rollouts, whole, turns.repeats, turns.clock)
    last = steps[-1][0]
    same(sim.save().numpy()[last], bare.batch.state[last], name)
    made = sum(len(ids) for ids, _, _ in steps) * SUBSTEPS
    what = (
        f"the engine inside the evaluator: {many} schedules with costs, T {horizon}, M {len(modes)}, {words}"
    )
    add_ratio(figures, name, times, made, what)
