"""Studies: jobs on all cores, their results in a table that grows, and a stopped study that goes on."""

from __future__ import annotations

import csv
import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar, get_type_hints

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from hmc.cfg import dump

PARSERS: dict[Any, Callable[[str], Any]] = {str: str, int: int, float: float, bool: "True".__eq__}


class Row(Protocol):
    """A line of a table: a frozen dataclass whose field `job` is another one; the values of both are str,
    int, float or bool."""

    @property
    def job(self) -> Any:
        """What was asked for; jobs are alike only if all of their values are."""
        ...


R = TypeVar("R", bound=Row)
S = TypeVar("S")


def folder_of(out: Path, cfg: Any) -> Path:
    """Where the table of a study under these settings grows; others begin anew.

    Raises:
        ValueError: nothing can be written there.
    """
    folder = out / hashlib.sha256(dump(cfg).encode()).hexdigest()[:12]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".probe").write_text("", encoding="utf-8")
        (folder / ".probe").unlink()
    except OSError as error:
        raise ValueError(f"cannot write into {folder} ({error}): choose another folder with --out") from error
    return folder


def carry_out(
    work: Callable[[Any], R],
    jobs: Sequence[Any],
    table: Path,
    kind: Callable[..., R],
    processes: int,
    console: Console,
) -> list[R] | None:
    """Do what the table lacks; all rows in the order of the jobs, or None when stopped by Ctrl-C.

    Args:
        work: what makes a row of a job, in a process of its own.
        jobs: all of the study.
        table: .csv, whole at any time; rows in it are not made again.
        kind: of the rows.
        processes: that work at the same time, a core each; 0 for as many as there are cores.
        console: where progress is shown.
    """
    rows = {row.job: row for row in read(table, kind)} if table.exists() else {}
    todo = [job for job in jobs if job not in rows]
    try:
        for row in run_all(work, todo, processes or os.cpu_count() or 1, console):
            rows[row.job] = row
            write(table, [rows[job] for job in jobs if job in rows])
    except KeyboardInterrupt:
        done = sum(job in rows for job in jobs)
        console.print(f"stopped with {done} of {len(jobs)} done: the same command goes on from there")
        return None
    return [rows[job] for job in jobs]


def run_all(work: Callable[[Any], S], todo: Sequence[Any], processes: int, console: Console) -> Iterator[S]:
    """Results as they come, from a pool of processes."""
    columns = (
        *Progress.get_default_columns()[:2],
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    context = multiprocessing.get_context("spawn")
    with (
        Progress(*columns, console=console) as bar,
        ProcessPoolExecutor(processes, mp_context=context) as pool,
    ):
        shown = bar.add_task("the study", total=len(todo))
        waiting = {pool.submit(work, job) for job in todo}
        try:
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in ended:
                    bar.advance(shown)
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
