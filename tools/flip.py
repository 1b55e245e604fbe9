"""The main job: the Go2 plans its way from the foot stand through a flip to the handstand."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: E402
from rich.table import Table  # noqa: E402

from hmc import Task  # noqa: E402
from hmc.cfg import load  # noqa: E402
from hmc.cli import command_line, one_line_errors  # noqa: E402
from hmc.go2.model import DT  # noqa: E402
from hmc.go2.observe import pitch  # noqa: E402
from hmc.go2.task import flip_task  # noqa: E402
from tools import figures, render  # noqa: E402
from tools.closed_loop import Run, RunCfg, planned, run  # noqa: E402
from tools.pool import ENDS, cores, kill_is_ctrl_c, pool_of, results, stop, stop_at_once, why  # noqa: E402
from tools.study import can_write, seeds_of, write_json  # noqa: E402


def _work(cfg: RunCfg, seed: int, notes: Any) -> Run:
    """One seed in a process of its own, on one core; `notes` gets (seed, steps done, what is going on)."""
    torch.set_num_threads(1)

    def show(done: int, entry: dict[str, Any], angle: float, height: float) -> None:
        notes.put((seed, done, f"{entry['mode']:>5}  pitch {angle:+4.0f}  height {height:.2f} m"))

    task = flip_task(cfg.task, seed=seed, threads=1)
    return run(planned(cfg, task, seed), task.cost, cfg, seed, progress=show)


def run_all(cfg: RunCfg, seeds: Sequence[int], processes: int, console: Console) -> Iterator[Run]:
    """Run seeds side by side and show how far each is; a run comes when it ends."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    with (
        multiprocessing.get_context("spawn").Manager() as manager,
        Progress(*columns, console=console) as bar,
        pool_of(min(processes, len(seeds))) as pool,
    ):
        notes = manager.Queue()
        total = round(cfg.seconds / DT)
        jobs = {seed: bar.add_task(f"seed {seed}", total=total, note="", start=False) for seed in seeds}
        waiting = {pool.submit(stop_at_once, _work, cfg, seed, notes) for seed in seeds}
        try:
            while waiting:
                ended, waiting = wait(waiting, timeout=0.2)
                while not notes.empty():
                    seed, done, note = notes.get()
                    bar.start_task(jobs[seed])
                    bar.update(jobs[seed], completed=done, note=note)
                    if not console.is_terminal and done % 50 == 0:
                        console.print(f"seed {seed}: step {done} of {total}, {note}", highlight=False)
                yield from results(ended)
        except BaseException:
            stop(pool)
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


def write_run(out: Path, done: Run, task: Task, cfg: RunCfg, video: bool, console: Console) -> None:
    """One run's log, figures and video into `out`."""
    stages = {name: bool(value) for name, value in vars(done.stages).items()}
    log = out / f"seed_{done.seed}.json"
    write_json(log, {"seed": done.seed, "stages": stages, "cost": done.cost, "steps": done.log})
    names = done.modes
    title = f"seed {done.seed}: " + ", ".join(
        f"{name.replace('_', ' ')} {'yes' if ok else 'no'}" for name, ok in stages.items()
    )
    x = done.x[:-1]
    figures.timeline(
        out / f"seed_{done.seed}_timeline.png",
        names,
        pitch(x).numpy(),
        x[:, 2].numpy(),
        [cfg.task.command * DT],
        DT,
        title,
    )
    terms = done.terms.numpy() / DT
    figures.cost_terms(out / f"seed_{done.seed}_cost.png", list(task.cost.stage), terms, names, DT)
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

    def __post_init__(self) -> None:
        cores(self.processes)


def main(args: Args) -> int:
    """Run all seeds, write everything, return the exit status."""
    with one_line_errors():
        seeds = seeds_of(args)
        cfg = load(ROOT / "cfg" / "flip.toml", RunCfg, args.set)
        flip_task(cfg.task)  # what is wrong with a policy file shows here
        can_write(args.out / "summary.json")
    console = Console()
    runs: list[Run] = []
    try:
        with kill_is_ctrl_c():
            for done in run_all(cfg, seeds, cores(args.processes), console):
                with one_line_errors():  # such as of a full disk
                    write_run(args.out, done, flip_task(cfg.task), cfg, args.video, console)
                runs.append(done)
    except ENDS as end:
        console.print(f"{why(end)} with {len(runs)} of {len(seeds)} runs done")
    runs.sort(key=lambda done: done.seed)
    if not runs:
        return 1
    summary = summarise(runs)
    write_json(args.out / "summary.json", summary)
    console.print(table(runs))
    return 0 if summary["success"] else 1


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
