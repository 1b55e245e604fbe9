"""Studies: jobs on all cores or machines, results in a table that grows, and a stopped study that goes on."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import multiprocessing
import os
import shutil
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar, get_type_hints

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn
from tyro.constructors import PrimitiveConstructorSpec

from hmc.cfg import dump
from hmc.cli import one_line_errors
from tools import cluster

PARSERS: dict[Any, Callable[[str], Any]] = {str: str, int: int, float: float, bool: "True".__eq__}


class Row(Protocol):
    """A line of a table: a frozen dataclass whose field `job` is another one; the values of both are str,
    int, float or bool."""

    @property
    def job(self) -> Any:
        """What was asked for; jobs are alike only if all of their values are."""
        ...


R = TypeVar("R", bound=Row)

# --ray alone or with an address; a str, empty without one
ADDRESS = PrimitiveConstructorSpec(
    nargs="*",
    metavar="[ADDRESS]",
    instance_from_str=" ".join,
    is_instance=lambda value: isinstance(value, str),
    str_from_instance=lambda address: [address] if address else [],
)


@dataclass(frozen=True)
class Workers:
    """Who works on the jobs of a study; a part of a command line.

    Attributes:
        processes: jobs at the same time on this machine, a core each; 0 for as many as there are cores.
        ray: work on a Ray cluster instead, a core a job: that at an address such as 10.0.0.1:6379; without
            one, the cluster that this machine is part of, or else one of this machine alone.
        resume: go on from what an earlier run of the same study has done; --no-resume drops that.
    """

    processes: int = 0
    ray: Annotated[str, ADDRESS] | None = None
    resume: bool = True

    @property
    def cores(self) -> int:
        """Jobs at the same time on this machine."""
        return self.processes or os.cpu_count() or 1


def folder_of(out: Path, cfg: Any, resume: bool = True) -> Path:
    """Where the table of a study under these settings grows; others begin anew, this one without `resume`.

    Raises:
        ValueError: nothing can be written there.
    """
    folder = out / hashlib.sha256(dump(cfg).encode()).hexdigest()[:12]
    try:
        if not resume and folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".probe").write_text("", encoding="utf-8")
        (folder / ".probe").unlink()
    except OSError as error:
        raise ValueError(f"cannot write into {folder} ({error}): choose another folder with --out") from error
    return folder


def _itself(row: Any) -> Any:
    return row


def _nobody(rows: Any) -> None:
    del rows


def carry_out(
    work: Callable[[Any], Any],
    jobs: Sequence[Any],
    table: Path,
    kind: Callable[..., R],
    workers: Workers,
    console: Console,
    receive: Callable[[Any], R] = _itself,
    tell: Callable[[list[R]], None] = _nobody,
) -> list[R] | None:
    """Do what the table lacks; all rows in the order of the jobs, or None when stopped by Ctrl-C.

    Args:
        work: what makes a row of a job, in a process of its own that may be on another machine; a job whose
            process was lost is worked on again.
        jobs: all of the study.
        table: .csv, whole at any time; rows in it are not made again.
        kind: of the rows.
        workers: who works.
        console: where progress is shown.
        receive: what makes a row, in this process, where `work` returns more than that; files are written
            here, because another machine has other folders.
        tell: told the rows so far, in the order of the jobs, whenever one is added.
    """
    rows = {row.job: row for row in read(table, kind)} if table.exists() else {}
    todo = [job for job in jobs if job not in rows]
    try:
        for row in map(receive, run_all(work, todo, workers, console)):
            rows[row.job] = row
            found = [rows[job] for job in jobs if job in rows]
            write(table, found)
            tell(found)
    except KeyboardInterrupt:
        done = sum(job in rows for job in jobs)
        console.print(f"stopped with {done} of {len(jobs)} done: the same command goes on from there")
        return None
    return [rows[job] for job in jobs]


def run_all(
    work: Callable[[Any], Any], todo: Sequence[Any], workers: Workers, console: Console
) -> Iterator[Any]:
    """What comes of the jobs, as it comes."""
    if not todo:
        return
    if workers.ray is None:
        done = on_processes(work, todo, workers.cores)
    else:
        with one_line_errors():
            cluster.join(workers.ray, workers.cores)
        done = cluster.on_ray(work, todo)
    columns = (
        *Progress.get_default_columns()[:2],
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar, contextlib.closing(done):
        yield from bar.track(done, total=len(todo), description="the study")


def on_processes(work: Callable[[Any], Any], todo: Sequence[Any], processes: int) -> Generator[Any]:
    """What comes of the jobs, as it comes, from a pool of processes."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        waiting = {pool.submit(work, job) for job in todo}
        try:
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in ended:
                    yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def read(path: Path, kind: Callable[..., R]) -> list[R]:
    """The rows of a table."""
    made = get_type_hints(kind)["job"]

    def values(of: Any, line: dict[str, str]) -> dict[str, Any]:
        types = get_type_hints(of)
        names = [each.name for each in fields(of) if each.name != "job"]
        return {name: PARSERS[types[name]](line[name]) for name in names}

    with path.open(newline="", encoding="utf-8") as lines:
        return [kind(job=made(**values(made, line)), **values(kind, line)) for line in csv.DictReader(lines)]


def write(path: Path, rows: Sequence[Any]) -> None:
    """A table that is either whole or not there."""
    partial = path.with_name(path.name + ".partial")
    lines = [{**values.pop("job"), **values} for values in map(asdict, rows)]
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
    os.replace(partial, path)


def write_json(path: Path, data: Any) -> None:
    """Write a file that is either whole or not there."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    os.replace(partial, path)
