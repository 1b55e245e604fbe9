"""Studies: jobs on all cores or machines, results in a table that grows, and a stopped study that goes on."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import functools
import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar, get_type_hints

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn
from tyro.constructors import PrimitiveConstructorSpec

from hmc.cfg import dump
from hmc.cli import one_line_errors
from tools import cluster
from tools.pool import ENDS, cores, kill_is_ctrl_c, on_processes, why

PARSERS: dict[Any, Callable[[str], Any]] = {str: str, int: int, float: float, bool: "True".__eq__}


class Row(Protocol):
    """A line of a table: a frozen dataclass whose field `job` is another one; the values of both are str,
    int, float or bool."""

    @property
    def job(self) -> Any:
        """What was asked for; jobs are alike only if all of their values are."""
        ...


R = TypeVar("R", bound=Row)
A = TypeVar("A")

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

    def __post_init__(self) -> None:
        cores(self.processes)

    @property
    def cores(self) -> int:
        """Jobs at the same time on this machine."""
        return cores(self.processes)


def at_least_one(of: Any, *names: str) -> None:
    """Raise a ValueError unless these counts, of settings or of a command line, are 1 or more."""
    for name in names:
        if getattr(of, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(of, name)}")


def seeds_of(args: Any) -> range:
    """The `seeds` seeds from `first_seed` on that a command line asks for; a ValueError if these are none."""
    at_least_one(args, "seeds")
    if args.first_seed < 0:
        raise ValueError(f"first_seed must be at least 0, got {args.first_seed}")
    return range(args.first_seed, args.first_seed + args.seeds)


def can_write(path: Path) -> None:
    """Make the folder of a file; raise a ValueError unless the file can be written there, which what takes
    minutes is not to find out at its end."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ValueError(f"cannot write {path} ({error}): choose another file") from error


def folder_of(
    out: Path, cfg: Any, kind: Callable[..., Row], resume: bool = True, files: Iterable[Path] = ()
) -> Path:
    """Where the table of a study under these settings grows; others begin anew, this one without `resume`.

    Args:
        out: folder of all studies of a kind.
        cfg: settings.
        kind: of the rows; those of other fields are another study's.
        resume: go on from what is there.
        files: that the work reads, such as policies: what is in them counts like a setting.

    Raises:
        ValueError: nothing can be written there.
        OSError: one of `files` cannot be read.
    """
    known = hashlib.sha256(dump(cfg).encode())
    columns: tuple[Any, ...] = _job_of(kind), kind
    known.update(" ".join(each.name for of in columns for each in fields(of)).encode())
    for file in files:
        known.update(hashlib.sha256(file.read_bytes()).digest())
    folder = out / known.hexdigest()[:12]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not resume:
            with alone(folder):
                shutil.rmtree(folder)
                folder.mkdir()
        (folder / ".probe").write_text("", encoding="utf-8")
        (folder / ".probe").unlink()
    except OSError as error:
        raise ValueError(f"cannot write into {folder} ({error}): choose another folder with --out") from error
    return folder


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Work in `folder` while no other run does; where one does, a line that says so ends the program."""
    with (folder / ".lock").open("w", encoding="utf-8") as lock:
        with one_line_errors():
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(
                    f"another run works in {folder}: wait for it, or take another folder with --out"
                ) from None
            except OSError:
                pass  # a file system without locks: two runs cost time there, and no file
        yield


def stoppable(main: Callable[[A], int], then: str = "goes on from there") -> Callable[[A], int]:
    """A study's program that Ctrl-C, `kill` or a full disk end in a line that says how it goes on."""

    @functools.wraps(main)
    def program(args: A) -> int:
        try:
            with kill_is_ctrl_c():
                return main(args)
        except ENDS as end:
            print(f"{why(end)}: the same command {then}", file=sys.stderr)
            return 1
        except OSError as error:
            if os.environ.get("HMC_TRACEBACK"):
                raise
            print(f"error: {error}: mend that, and the same command {then}", file=sys.stderr)
            return 2

    return program


def at_one_go(main: Callable[[A], int]) -> Callable[[A], int]:
    """The same of a program that keeps nothing to go on from."""
    return stoppable(main, "begins anew")


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
    """Do what the table lacks; all rows in the order of the jobs, or None when stopped or a worker was lost.

    Rows of other jobs stay in the table: a part of a study does not undo the rest.

    Args:
        work: what makes a row of a job, in a process of its own that may be on another machine; a job whose
            process was lost is worked on again.
        jobs: all of the study; those that come twice count once.
        table: .csv, whole at any time; rows in it are not made again.
        kind: of the rows.
        workers: who works.
        console: where progress is shown.
        receive: what makes a row, in this process, where `work` returns more than that; files are written
            here, because another machine has other folders.
        tell: told the rows so far, in the order of the jobs, whenever one is added.
    """
    jobs = list(dict.fromkeys(jobs))  # what is asked for twice counts once
    with alone(table.parent):
        rows = {row.job: row for row in read(table, kind)} if table.exists() else {}
        todo, asked = [job for job in jobs if job not in rows], set(jobs)
        try:
            for row in map(receive, run_all(work, todo, workers, console)):
                rows[row.job] = row
                found = [rows[job] for job in jobs if job in rows]
                write(table, [*found, *(row for job, row in rows.items() if job not in asked)])
                tell(found)
        except ENDS as end:
            done = sum(job in rows for job in jobs)
            console.print(f"{why(end)} with {done} of {len(jobs)} done: the same command goes on from there")
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


def _job_of(kind: Callable[..., Row]) -> Any:
    """The class of a row's job."""
    return get_type_hints(kind)["job"]


def read(path: Path, kind: Callable[..., R]) -> list[R]:
    """The rows of a table."""
    made = _job_of(kind)

    def values(of: Any, line: dict[str, str]) -> dict[str, Any]:
        types = get_type_hints(of)
        names = [each.name for each in fields(of) if each.name != "job"]
        return {name: PARSERS[types[name]](line[name]) for name in names}

    with path.open(newline="", encoding="utf-8") as lines:
        return [kind(job=made(**values(made, line)), **values(kind, line)) for line in csv.DictReader(lines)]


def write(path: Path, rows: Sequence[Any]) -> None:
    """A table that is either whole or not there."""
    lines = [{**values.pop("job"), **values} for values in map(asdict, rows)]
    with whole(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def write_json(path: Path, data: Any) -> None:
    """Write a file that is either whole or not there."""
    with whole(path) as partial:
        partial.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file of this process alone to write to, of the same kind, which then takes the place of `path`."""
    partial = path.with_name(f"{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
