"""The main job: the Go2 plans its way from the foot stand through a flip to the handstand."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: E402
from rich.table import Table  # noqa: E402
from torch import Tensor  # noqa: E402

from hmc import Budget, Receding, Task  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cli import one_line_errors  # noqa: E402
from hmc.go2.model import DT, SUBSTEPS  # noqa: E402
from hmc.go2.observe import pitch  # noqa: E402
from hmc.go2.stages import Stages, judge  # noqa: E402
from hmc.go2.stances import FOOTSTAND  # noqa: E402
from hmc.go2.task import FlipCfg, flip_task, make_sim  # noqa: E402
from hmc.sim.base import Sim  # noqa: E402
from tools import figures, render  # noqa: E402


@dataclass(frozen=True)
class SearchCfg:
    """The search at each control step.

    Attributes:
        samples: switches drawn a batch.
        order: of the draws, see `hmc.plan`.
        pairs: further draws beside each batch, of two switches at once.
        draws: switches that a tick's search may draw.
        control_steps: control steps that it may roll out.
    """

    samples: int = 16
    order: str = "tails"
    pairs: int = 8
    draws: int = 16
    control_steps: int = 8000


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


@dataclass
class Run:
    """One seed's closed loop, recorded step by step.

    Attributes:
        seed: of the start, the draws and the jump's noise.
        x: states, (n + 1, 37).
        modes: mode of each step, (n,).
        log: one record a step.
        terms: stage cost terms of each step times dt, (n, terms).
        stages: what was reached.
    """

    seed: int
    x: Tensor
    modes: Tensor
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
    roll, tilt = noise(2, cfg.tilt / 2).tolist()  # half angles
    w, qx, qy, qz = x[3:7].tolist()
    turn = torch.tensor([1.0, roll, tilt, 0.0], dtype=torch.float64)
    a, b, c, d = (turn / turn.norm()).tolist()
    x[3:7] = torch.tensor(
        [
            w * a - qx * b - qy * c - qz * d,
            w * b + qx * a + qy * d - qz * c,
            w * c - qx * d + qy * a + qz * b,
            w * d + qx * c - qy * b + qz * a,
        ],
        dtype=torch.float64,
    )
    return x, x[7:19].clone()


def search_options(cfg: SearchCfg) -> dict[str, Any]:
    """Arguments of `Receding`."""
    budget = Budget(draws=cfg.draws, control_steps=cfg.control_steps)
    return {"samples": cfg.samples, "order": cfg.order, "pairs": cfg.pairs, "budget": budget}


def exact(cfg: FlipCfg, world: Sim) -> Tensor | None:
    """The world's snapshot, if the planner's model is the world's own: else it would mean something else."""
    same = cfg.substeps == SUBSTEPS and cfg.iterations is None
    return world.save()[0] if same else None


def run(cfg: RunCfg, task: Task, seed: int, progress: Any = None) -> Run:
    """One closed loop of planning and simulation."""
    world = make_sim(1, threads=1)
    x, u = disturbed_start(cfg.start, seed)
    world.reset(x[None], u[None])
    planner = Receding(
        task,
        seed=seed,
        schedule=["foot"] * task.horizon,
        **search_options(cfg.search),
    )
    steps = round(cfg.seconds / world.dt)
    xs, modes, log, terms = [world.x()[0]], [], [], []
    for k in range(steps):
        x, u_prev = world.x(), world.u()
        began = time.perf_counter()
        tick = planner.tick(x[0], u_prev[0], exact(cfg.task, world))
        elapsed = 1e3 * (time.perf_counter() - began)
        stage = task.cost.stage_terms(x, tick.u[None], u_prev, torch.tensor([k]))[0] * world.dt
        world.step(tick.u[None])
        plan = tick.plan
        xs.append(world.x()[0])
        modes.append(tick.mode)
        terms.append(stage)
        log.append(
            {
                "step": k,
                "time": k * world.dt,
                "mode": task.modes.names[tick.mode],
                "schedule": str(plan.schedule),
                "cost": plan.cost,
                "stage_cost": float(stage.sum()),
                "plan_ms": elapsed,
                "coverage": plan.coverage,
                "draws": plan.draws,
                "control_steps": plan.control_steps,
                "diverged": plan.diverged,
                "x": [round(v, 6) for v in x[0].tolist()],
                "u": [round(v, 6) for v in tick.u.tolist()],
            }
        )
        if progress is not None:
            progress(k + 1, log[-1], float(pitch(x)[0]), float(x[0, 2]))
    x = torch.stack(xs)
    mode = torch.tensor(modes)
    stages = judge(x, mode, world.dt, task.modes.index("hand"))
    return Run(seed, x, mode, log, torch.stack(terms), stages)


def _work(cfg: RunCfg, seed: int, notes: Any) -> Run:
    """One seed in a process of its own, on one core; `notes` gets (seed, steps done, what is going on)."""
    torch.set_num_threads(1)

    def show(done: int, entry: dict[str, Any], angle: float, height: float) -> None:
        note = f"{entry['mode']:>5}  pitch {np.degrees(angle):+4.0f}  height {height:.2f} m"
        notes.put((seed, done, note))

    return run(cfg, flip_task(cfg.task, seed=seed, threads=1), seed, show)


def run_all(cfg: RunCfg, seeds: Sequence[int], processes: int, console: Console) -> Iterator[Run]:
    """Run seeds side by side and show how far each is; a run comes when it ends."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    context = multiprocessing.get_context("spawn")
    with (
        context.Manager() as manager,
        Progress(*columns, console=console) as bar,
        ProcessPoolExecutor(min(processes, len(seeds)), mp_context=context) as pool,
    ):
        notes = manager.Queue()
        total = round(cfg.seconds / DT)
        jobs = {seed: bar.add_task(f"seed {seed}", total=total, note="", start=False) for seed in seeds}
        waiting = {pool.submit(_work, cfg, seed, notes) for seed in seeds}
        try:
            while waiting:
                ended, waiting = wait(waiting, timeout=0.2)
                while not notes.empty():
                    seed, done, note = notes.get()
                    bar.start_task(jobs[seed])
                    bar.update(jobs[seed], completed=done, note=note)
                    if not console.is_terminal and done % 50 == 0:
                        console.print(f"seed {seed}: step {done} of {total}, {note}", highlight=False)
                yield from (future.result() for future in ended)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def summarise(runs: list[Run]) -> dict[str, Any]:
    """What summary.json holds."""
    times = np.concatenate([run.plan_ms for run in runs])
    return {
        "seeds": len(runs),
        "success": sum(run.stages.success for run in runs),
        "foot_stand": sum(run.stages.foot_stand for run in runs),
        "jump_flip": sum(run.stages.jump_flip for run in runs),
        "handstand": sum(run.stages.handstand for run in runs),
        "cost_mean": float(np.mean([run.cost for run in runs])),
        "plan_ms_p50": float(np.percentile(times, 50)),
        "plan_ms_p99": float(np.percentile(times, 99)),
        "coverage_mean": float(np.mean([entry["coverage"] for run in runs for entry in run.log])),
    }


def write_json(path: Path, data: Any) -> None:
    """Write a file that is either whole or not there."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    os.replace(partial, path)


def write_run(out: Path, done: Run, task: Task, cfg: RunCfg, video: bool, console: Console) -> None:
    """One run's log, figures and video into `out`."""
    stages = {name: bool(value) for name, value in vars(done.stages).items()}
    log = out / f"seed_{done.seed}.json"
    write_json(log, {"seed": done.seed, "stages": stages, "cost": done.cost, "steps": done.log})
    dt, names = cfg.seconds / len(done.log), [entry["mode"] for entry in done.log]
    title = f"seed {done.seed}: " + ", ".join(
        f"{name.replace('_', ' ')} {'yes' if ok else 'no'}" for name, ok in stages.items()
    )
    x = done.x[:-1]
    figures.timeline(
        out / f"seed_{done.seed}_timeline.png",
        names,
        pitch(x).numpy(),
        x[:, 2].numpy(),
        cfg.task.command * dt,
        dt,
        title,
    )
    terms = done.terms.numpy() / dt
    figures.cost_terms(out / f"seed_{done.seed}_cost.png", list(task.cost.stage), terms, names, dt)
    if video and (reason := render.render_run(render.Args(log))):
        console.print(reason)


def table(runs: list[Run]) -> Table:
    """A row a seed."""
    view = Table(title="the flip")
    for name in ("seed", "foot stand", "jump flip", "handstand", "cost", "plan p50 [ms]", "plan p99 [ms]"):
        view.add_column(name, justify="right")
    sign = {True: "[green]yes[/]", False: "[red]no[/]"}
    for item in runs:
        p50, p99 = np.percentile(item.plan_ms, [50, 99])
        view.add_row(
            str(item.seed),
            sign[item.stages.foot_stand],
            sign[item.stages.jump_flip],
            sign[item.stages.handstand],
            f"{item.cost:.2f}",
            f"{p50:.0f}",
            f"{p99:.0f}",
        )
    return view


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        seeds: number of runs.
        first_seed: seed of the first.
        out: folder to write to.
        processes: seeds that run at the same time, a core each; 0 for as many as there are cores.
        video: render a video of each run, if OpenGL is there.
        set: overrides of cfg/flip.toml, such as search.samples=64.
    """

    seeds: int = 3
    first_seed: int = 0
    out: Path = ROOT / "out" / "flip"
    processes: int = 0
    video: bool = True
    set: tuple[str, ...] = ()


def main(args: Args) -> int:
    """Run all seeds, write everything, return the exit status."""
    with one_line_errors():
        cfg = load(ROOT / "cfg" / "flip.toml", RunCfg, args.set)
        flip_task(cfg.task)  # what is wrong with a policy file shows here
        args.out.mkdir(parents=True, exist_ok=True)
    console = Console()
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    runs: list[Run] = []
    with contextlib.suppress(KeyboardInterrupt):
        for done in run_all(cfg, seeds, args.processes or os.cpu_count() or 1, console):
            runs.append(done)
            write_run(args.out, done, flip_task(cfg.task), cfg, args.video, console)
    runs.sort(key=lambda done: done.seed)
    if not runs:
        console.print("stopped before the first run ended: nothing written")
        return 1
    summary = summarise(runs)
    write_json(args.out / "summary.json", summary)
    console.print(table(runs))
    return 0 if summary["success"] else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
