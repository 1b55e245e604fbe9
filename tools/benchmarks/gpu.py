"""What engine warp brings on a GPU, beside the bare mujoco_warp: stepping, training, planning, memory."""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from hmc import Budget, ModeSet, Plan, Sim, SwitchSpace, Task, plan
from hmc.cfg import load
from hmc.go2.model import HOME, Q_LOWER, Q_UPPER, SUBSTEPS, load_model
from hmc.go2.policy import Policy
from hmc.go2.task import flip_task, jump_mode, policy_path
from hmc.memory import make_worlds
from hmc.sim.cuda import Recorded, graphs, num_bytes
from hmc.sim.device import devices, find_device, free_memory
from hmc.sim.make import make_sim
from hmc.sim.warp import WarpSim
from tools import closed_loop, curves
from tools.benchmarks import learning
from tools.benchmarks.engine import add_ratio, same, take_turns
from tools.benchmarks.figures import Common, Figures, cores, fits
from tools.benchmarks.train import Train, iterations
from train.config import ROOT, TrainCfg, read_training
from train.env import Go2Env
from train.make import make_env

# without a GPU: so little that Warp's CPU device gets through it
TINY: dict[str, Any] = {
    "batches": (2,),
    "worlds": (4,),
    "steps": 2,
    "repeats": 1,
    "horizon": 3,
    "samples": 4,
    "plan_steps": 6,
    "iterations": 1,
    "level": 0.0,
    "set": ("ppo.steps=4", "ppo.hidden=[16]", "ppo.minibatches=2"),
}


@dataclass(frozen=True)
class Gpu(Common):
    """Engine warp on this machine's GPU; without one, a tiny run on Warp's CPU device that tests the path.

    Attributes:
        tiny: whether a run without a GPU is tiny; with --no-tiny it has the sizes that are asked for.
        batches: switches at once, on engine warp and on the C engine with 2 threads and with all.
        worlds: numbers of worlds to step and to train in.
        steps: control steps of a repeat.
        repeats: of what is timed.
        horizon: of the search through all of Omega, with three policies as modes [control steps].
        samples: of the MPPI update.
        plan_steps: its horizon [control steps].
        iterations: of training that count, after one that does not.
        level: share of episodes from the stance that hold, up to which the handstand is trained then.
        out: folder for these runs and the picture of their learning curves.
        cpu: folder of the same training on a CPU, to be told of and drawn beside them; None for none.
        set: overrides of cfg/handstand.toml.
    """

    tiny: bool = True
    batches: tuple[int, ...] = (16, 128, 1024, 4096)
    worlds: tuple[int, ...] = (4096, 8192)
    steps: int = 50
    repeats: int = 5
    horizon: int = 75
    samples: int = 4096
    plan_steps: int = 40
    iterations: int = 5
    level: float = 0.9
    out: Path = ROOT / "out" / "gpu"
    cpu: Path | None = None
    set: tuple[str, ...] = ()


@torch.no_grad()
def gpu(args: Gpu) -> Figures:
    """Stepping, the environment, training, exact plans and MPPI on engine warp."""
    figures, device = Figures(), "cuda"
    if not torch.cuda.is_available():
        device, size = "cpu", "a tiny size" if args.tiny else "all of it"
        if args.tiny:
            figures.missing, args = listed(args), replace(args, **TINY)
        figures.notes["gpu"] = (
            f"{devices()}: what ran instead is {size} on Warp's CPU device, whose figures say "
            "nothing of a GPU"
        )
    else:
        figures.notes["gpu"] = (
            f"on {torch.cuda.get_device_name()}, CUDA driver {wp.get_cuda_driver_version()}"
        )
    fits(args.batches, "batches", args.horizon)
    runs = [] if args.cpu is None else [curves.read(args.cpu)]
    for run in runs:
        learning.tell(figures, "train_cpu", run, args.level)
    for worlds in args.worlds:
        _stepping(figures, args, device, worlds)
        _training(figures, args, device, worlds)
        runs.append(_learning(figures, args, device, worlds))
    curves.draw(runs, args.out / "learning.png")
    _planning(figures, args, device)
    return figures


def listed(args: Gpu) -> dict[str, str]:
    """Figures that only a GPU has, with words for each."""
    search = f"exact_t{args.horizon}"
    found = {}
    for worlds in args.worlds:
        found[f"step_{worlds}_bare_steps_per_s"] = "physics steps/s of mujoco_warp alone, in the same run"
        found[f"step_{worlds}_efficiency"] = "the simulator's rate over that"
        found[f"env_{worlds}_efficiency"] = "the environment's rate over that"
        found[f"train_{worlds}_steps_per_s"] = "environment steps/s, learning included"
        found[f"train_{worlds}_gib"] = "device memory that training takes, all included [GiB]"
        found[f"train_{worlds}_minutes"] = f"training until {args.level:.0%} hold from the stance [min]"
        found[f"memory_{worlds}_kb"] = "device memory a world, all included [KiB]"
    found[f"{search}_ms"] = "the single-switch problem solved exactly [ms]"
    found[f"{search}_candidates_per_s"] = "schedules a second"
    found[f"{search}_efficiency"] = "physics steps/s of the search over the bare engine's"
    for threads in on_cpu(args.threads or cores()):
        what = f"the smallest batch that is sooner than on the C engine, --threads {threads}"
        found[f"crossover_c{threads}_switches"] = what
    found[f"mppi_{args.samples}x{args.plan_steps}_ms"] = "an MPPI update [ms]"
    return found


def on_cpu(threads: int) -> list[int]:
    """Threads of the C engine that engine warp is compared with: 2, and all that there are."""
    return sorted({min(2, threads), threads})


class Bare:
    """mujoco_warp alone, with a simulator's model, sizes and driver: its step, captured where that can be."""

    def __init__(self, sim: WarpSim):
        self.device = wp.device_from_torch(sim.device)
        with wp.ScopedDevice(self.device):
            self.model = mjw.put_model(sim.model)
            self.data = mjw.make_data(
                sim.model, nworld=sim.num_worlds, nconmax=sim.contacts, njmax=sim.constraints
            )
        self.model.opt.warn_overflow = 0
        self.qpos, self.qvel = wp.to_torch(self.data.qpos), wp.to_torch(self.data.qvel)
        self.ctrl = wp.to_torch(self.data.ctrl)
        captured, self.model.opt.graph_conditional = graphs(sim.device)
        self.substeps = Recorded(self._substeps, self.device, captured)

    def reset(self, x: Tensor) -> None:
        """Begin at states (W, nx)."""
        with wp.ScopedDevice(self.device):
            mjw.reset_data(self.model, self.data)
        finish(str(x.device))
        self.qpos[:], self.qvel[:] = x[:, : self.qpos.shape[1]], x[:, self.qpos.shape[1] :]

    def step(self, u: Tensor) -> None:
        """One control step."""
        self.ctrl[:] = u
        self.substeps()

    def _substeps(self) -> None:
        with wp.ScopedDevice(self.device):
            for _ in range(SUBSTEPS):
                mjw.step(self.model, self.data)


def finish(device: str) -> None:
    """Wait for the device; nothing to wait for on a CPU."""
    if device != "cpu":
        torch.cuda.synchronize()


def seconds(work: Callable[[], Any], device: str, repeats: int) -> float:
    """How long it takes, the median; once before that for what is captured and cached [s]."""
    took = []
    for _ in range(repeats + 1):
        finish(device)
        began = time.perf_counter()
        work()
        finish(device)
        took.append(time.perf_counter() - began)
    return median(took[1:])


def _stepping(figures: Figures, args: Gpu, device: str, worlds: int) -> None:
    """Given targets through the simulator, zero actions through the environment, against mjw.step alone."""
    gc.collect()  # a runner and its table hold each other, and the worlds of the training before
    there = find_device(device)
    free = free_memory(there)
    sim = WarpSim(load_model(), worlds, device=there)
    if device != "cpu":
        sim.step(sim.u())
        used = free - free_memory(there)
        figures.add(f"memory_{worlds}_kb", used / worlds / 1024, "device memory a world, all included [KiB]")
    alone = Bare(sim)
    x = torch.zeros(worlds, 37, device=device)
    x[:, 2], x[:, 3], x[:, 7:19] = 0.29, 1.0, HOME.to(x)
    targets = HOME.to(x) + 0.1 * torch.randn(args.steps, worlds, 12, device=device)
    targets = targets.clamp(Q_LOWER.to(x), Q_UPPER.to(x))
    sim.reset(x, x[:, 7:19])
    rows = sim.save()

    def ours() -> Iterator[None]:
        sim.load(rows)
        for target in targets:
            sim.step(target)
            sim.x()
        finish(device)
        yield

    def bare() -> Iterator[None]:
        alone.reset(x)
        for target in targets:
            alone.step(target)
        finish(device)
        yield

    physics = worlds * args.steps * SUBSTEPS
    times = take_turns(ours, bare, args.repeats)
    if device == "cpu":  # on a GPU the order of threads decides the last bits
        deque(bare(), maxlen=0)
        deque(ours(), maxlen=0)
        same(sim.x().numpy(), torch.cat([alone.qpos, alone.qvel], 1).numpy(), "stepping")
    add_ratio(figures, f"step_{worlds}", times, physics, f"{worlds:,} worlds, given targets")
    figures.add(f"arrays_{worlds}_kb", num_bytes(alone.data) / worlds / 1024, "arrays of a world [KiB]")

    _, env = _handstand(args, device, worlds)

    def environment() -> Iterator[None]:
        for _ in targets:
            env.step(torch.zeros(worlds, 12, device=device))
        finish(device)
        yield

    times = take_turns(environment, bare, args.repeats)
    add_ratio(figures, f"env_{worlds}", times, physics, f"{worlds:,} worlds, rewards and resets included")


def _training(figures: Figures, args: Gpu, device: str, worlds: int) -> None:
    """PPO, learning included."""
    gc.collect()
    there = find_device(device)
    free = free_memory(there)
    cfg, env = _handstand(args, device, worlds)
    with torch.enable_grad():
        whole, *_ = iterations(Train(warm_up=1, iterations=args.iterations), cfg, env)
    if device != "cpu":  # what torch keeps to itself included: it was in use
        used = free - torch.cuda.mem_get_info(there)[0]
        figures.add(f"train_{worlds}_gib", used / 2**30, "device memory that training takes [GiB]")
    rate = worlds * cfg.ppo.steps / float(whole.mean())
    figures.add(f"train_{worlds}_steps_per_s", rate, "environment steps/s, learning included")


def _learning(figures: Figures, args: Gpu, device: str, worlds: int) -> curves.Curves:
    """The same training from its beginning up to its success."""
    gc.collect()
    cfg, env = _handstand(args, device, worlds)
    argv = ["--mode", "handstand", "--engine", "warp", "--set", *args.set, f"env.worlds={worlds}"]
    with torch.enable_grad():
        run = learning.train_until(args.level, cfg, env, args.out / f"train_{worlds}", argv)
    learning.tell(figures, f"train_{worlds}", run, args.level)
    return replace(run, title=f"{run.title}, {worlds:,} worlds")


def _handstand(args: Gpu, device: str, worlds: int) -> tuple[TrainCfg, Go2Env]:
    """Its training in so many worlds of engine warp."""
    cfg = read_training("handstand", "handstand", (*args.set, f"env.worlds={worlds}"))
    return cfg, make_env(cfg.env, "warp", device=device)


def _planning(figures: Figures, args: Gpu, device: str) -> None:
    """All of Omega, policies as modes, on warp and on the C engine; one MPPI update."""
    cfg = load(ROOT / "cfg" / "flip.toml", closed_loop.RunCfg)
    task = flip_task(cfg.task, threads=args.threads)
    third = Policy(policy_path("handstand", cfg.task.hand), name="again", threads=args.threads)
    modes = ModeSet([task.modes["foot"], task.modes["hand"], third])
    small = replace(task, modes=modes, horizon=args.horizon, rules=None)
    x, u = closed_loop.disturbed_start(cfg.start, 0)
    size, name = len(SwitchSpace(3, args.horizon)), f"exact_t{args.horizon}"
    everyone = args.threads or cores()

    def on(engine: str, threads: int = 0) -> Task:
        """The task on an engine: the search has as many worlds as fit."""
        where = {"device": device} if engine == "warp" else {"threads": threads}
        return replace(small, make_sim=lambda worlds: make_sim(load_model(), worlds, engine, **where))

    def took(task: Task, switches: int) -> tuple[float, Plan]:
        """How long the best of so many switches takes [ms], and what was found."""
        sim = make_worlds(task, switches + 1)
        start = x.to(sim.device, sim.dtype), u.to(sim.device, sim.dtype)
        solve = partial(exact, task, sim, *start, switches)
        return 1e3 * seconds(solve, device, args.repeats), solve()

    ms, result = took(on("warp"), size)
    rate = result.control_steps * SUBSTEPS / (ms / 1e3)
    bare = figures.values[f"step_{max(args.worlds)}_bare_steps_per_s"]
    figures.add(f"{name}_efficiency", rate / bare, "physics steps/s of the search over the bare engine's")
    figures.add(f"{name}_candidates_per_s", 1e3 * result.draws / ms, "schedules a second")
    figures.add(f"{name}_ms", ms, f"the best of {size:,} switches, M 3, three policies [ms]")
    times = {size: ms}
    for switches in args.batches:
        times[switches], _ = took(on("warp"), switches)
        figures.add(f"batch_{switches}_ms", times[switches], f"{switches} of them at once [ms]")
    for threads in on_cpu(everyone):
        sooner = []
        for switches, ms in sorted(times.items()):
            other, _ = took(on("mujoco", threads), switches)
            of = name if switches == size else f"batch_{switches}"
            figures.add(f"{of}_c{threads}_ms", other, f"the same on the C engine, --threads {threads} [ms]")
            sooner += [switches] if ms < other else []
        crossover = f"crossover_c{threads}_switches"
        if not sooner:
            figures.notes[crossover] = f"no batch was sooner than on the C engine, --threads {threads}"
        elif crossover not in figures.missing:
            figures.add(
                crossover, sooner[0], f"the smallest batch that is sooner than that, --threads {threads}"
            )
    knots = min(cfg.task.jump.sampling.knots, args.plan_steps)
    settings = replace(
        cfg.task.jump.sampling,
        samples=args.samples,
        horizon=args.plan_steps,
        replan_every=args.plan_steps,
        worlds=args.samples,
        knots=knots,
    )
    mpc = jump_mode(
        replace(cfg.task.jump, sampling=settings),
        lambda n: make_sim(load_model(), n, "warp", device=device),
        seed=0,
    )
    one = [row[None].to(device, torch.float32) for row in (x, u)]
    update = partial(replan, mpc, one[0], one[1], iter(range(10**6)))
    figures.add(
        f"mppi_{args.samples}x{args.plan_steps}_ms",
        1e3 * seconds(update, device, args.repeats),
        "an MPPI update of so many samples and control steps [ms]",
    )


def exact(task: Task, sim: Sim, x: Tensor, u: Tensor, size: int) -> Plan:
    """The single-switch problem from a foot stand: the best of `size` switches, drawn if that is not all."""
    foot = ["foot"] * task.horizon
    solver = "exhaustive" if size == len(SwitchSpace(len(task.modes), task.horizon)) else "sample"
    return plan(task, x, u=u, schedule=foot, solver=solver, samples=size, iterations=1, sim=sim,
                budget=Budget(draws=size))  # fmt: skip


def replan(mpc: Any, x: Tensor, u: Tensor, steps: Iterator[int]) -> None:
    """One update at a control step at which there was none yet, so that none is remembered."""
    k = torch.tensor([next(steps)], device=x.device)
    mpc.act(x, u, mpc.reset(x, u, k), k)
