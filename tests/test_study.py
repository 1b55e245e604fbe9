"""Studies: what begins anew, what stays, and how they end before their end; on processes of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from hmc.go2.task import FlipCfg
from tests.squares import Job, Row, work
from tools import study
from tools.closed_loop import policies

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Cfg:
    """Settings of a study."""

    trials: int = 2


@dataclass(frozen=True)
class Grown:
    """A row that has gained a field."""

    job: Job
    square: int
    cube: int


def test_what_a_study_depends_on(tmp_path):
    """Settings, what is in its files, wherever they are, and the fields of its rows."""
    policy, same, cfg = tmp_path / "policy.onnx", tmp_path / "same.onnx", Cfg()
    for path in (policy, same):
        path.write_bytes(b"trained")
    first = study.folder_of(tmp_path, cfg, Row, files=[policy])
    assert study.folder_of(tmp_path, cfg, Row, files=[same]) == first
    others = [
        study.folder_of(tmp_path, Cfg(3), Row, files=[policy]),
        study.folder_of(tmp_path, cfg, Grown, files=[policy]),
        study.folder_of(tmp_path, cfg, Row),
    ]
    policy.write_bytes(b"trained again")
    others.append(study.folder_of(tmp_path, cfg, Row, files=[policy]))
    assert len({first, *others}) == 5


def test_policies_of_a_flip(tmp_path):
    given = tmp_path / "mine.onnx"
    cfg = FlipCfg(foot=str(given))
    assert [path.name for path in policies(cfg)] == ["mine.onnx", "handstand.onnx"]
    held = replace(cfg, idle=("stand", "crouch"))
    valued = replace(cfg, cost=replace(cfg.cost, value=1.0))
    assert [path.name for path in policies(cfg, held, valued)] == [
        *("mine.onnx", "handstand.onnx", "stand.onnx", "footstand_value.onnx", "handstand_value.onnx"),
    ]


def test_a_part_of_a_study_leaves_the_rest_in_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "run_all", lambda do, todo, *_: map(do, todo))
    table, told = tmp_path / "table.csv", list[list[Row]]()
    workers, console = study.Workers(), Console(quiet=True)

    def done(jobs: list[Job]) -> list[Row] | None:
        do = partial(work, tmp_path, -1)
        return study.carry_out(do, jobs, table, Row, workers, console, tell=told.append)

    whole = [Row(Job(i), i * i) for i in range(6)]
    assert done([row.job for row in whole]) == whole
    assert done([Job(7), Job(2)]) == [Row(Job(7), 49), whole[2]]
    assert told[-1] == [Row(Job(7), 49), whole[2]], "of today's jobs alone"
    assert sorted(study.read(table, Row), key=lambda row: row.job.number) == [*whole, Row(Job(7), 49)]


def test_what_is_asked_for_twice_counts_once(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "run_all", lambda do, todo, *_: map(do, todo))
    jobs, workers, console = [Job(3), Job(2), Job(3)], study.Workers(), Console(quiet=True)
    do, table = partial(work, tmp_path, -1), tmp_path / "table.csv"
    for _ in range(2):
        assert study.carry_out(do, jobs, table, Row, workers, console) == [Row(Job(3), 9), Row(Job(2), 4)]
    assert (tmp_path / "begun").read_text().split() == ["3", "2"]


def test_one_run_at_a_time_in_a_folder(tmp_path, capsys):
    folder = study.folder_of(tmp_path, Cfg(), Row)
    jobs, workers = [Job(1)], study.Workers(processes=1)
    with study.alone(folder):
        for begin in (
            lambda: study.carry_out(work, jobs, folder / "t.csv", Row, workers, Console(quiet=True)),
            lambda: study.folder_of(tmp_path, Cfg(), Row, resume=False),
        ):
            with pytest.raises(SystemExit) as ended:
                begin()
            assert ended.value.code == 2
            (line,) = capsys.readouterr().err.strip().splitlines()
            assert line.startswith(f"error: another run works in {folder}: wait for it")
    assert study.folder_of(tmp_path, Cfg(), Row, resume=False) == folder


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "table.txt"
    path.write_text("before")

    def fails() -> None:
        with study.whole(path) as partly:
            assert partly.suffix == ".txt", "the format of what is written by its name"
            assert str(os.getpid()) in partly.name, "another process has another one"
            partly.write_text("half")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fails()
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_where_no_file_can_be_written(tmp_path):
    """What is there stays as it is, and nothing is left beside it."""
    path = tmp_path / "new" / "table.txt"
    study.can_write(path)
    path.write_text("before")
    study.can_write(path)
    assert path.read_text() == "before"
    assert list(path.parent.iterdir()) == [path]
    for there in (path.parent, path / "in_a_file.txt"):
        with pytest.raises(ValueError, match=r"cannot write .*: choose another file"):
            study.can_write(there)


def test_a_lost_worker_is_a_line(tmp_path, capsys):
    jobs, workers = [Job(i) for i in range(4)], study.Workers(processes=1)
    do, table = partial(work, tmp_path, 2), tmp_path / "table.csv"
    console = Console(width=200)
    assert study.carry_out(do, jobs, table, Row, workers, console) is None
    said = capsys.readouterr().out
    assert "a worker was lost (out of memory?) with 2 of 4 done: the same command goes on from there" in said
    assert study.carry_out(do, jobs, table, Row, workers, console) == [
        Row(job, job.number**2) for job in jobs
    ]
    assert (tmp_path / "begun").read_text().split().count("0") == 1


@pytest.mark.parametrize("how", ["Ctrl-C", "kill"])
def test_stopped_workers_save_what_they_are_at(tmp_path, how):
    """Whether the terminal tells all of the study's processes, or somebody the first one."""
    command = [sys.executable, "-m", "tests.squares", str(tmp_path)]
    with subprocess.Popen(
        command, cwd=ROOT, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        until = time.monotonic() + 60
        while len(list(tmp_path.glob("begun_*"))) < 2 and time.monotonic() < until:
            time.sleep(0.05)
        if how == "Ctrl-C":
            os.killpg(program.pid, signal.SIGINT)
        else:
            program.terminate()
        said, errors = program.communicate(timeout=30)
    assert program.returncode == 1
    assert "stopped with 0 of 3 done: the same command goes on from there" in said
    assert errors == ""
    assert {path.name for path in tmp_path.glob("*_*")} == {"begun_0", "begun_1", "saved_0", "saved_1"}
    left = f"pgrep --session {program.pid} || true"
    until = time.monotonic() + 10
    while (found := subprocess.check_output(left, shell=True)) and time.monotonic() < until:
        time.sleep(0.05)  # multiprocessing's own helper ends when it sees that it is alone
    assert not found, "nobody is left behind"


@pytest.mark.parametrize(
    ("end", "status", "line"),
    [
        (KeyboardInterrupt(), 1, "stopped: the same command goes on from there"),
        (
            OSError(28, "No space left on device"),
            2,
            "No space left on device: mend that, and the same command",
        ),
    ],
)
def test_what_ends_a_study_outside_its_jobs_is_a_line(capsys, end, status, line):
    before = signal.getsignal(signal.SIGTERM)  # Ray leaves one of its own

    @study.stoppable
    def main(_: None) -> int:
        raise end

    assert main(None) == status
    (said,) = capsys.readouterr().err.splitlines()
    assert line in said
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_keeps_nothing_begins_anew(capsys):
    @study.at_one_go
    def main(_: None) -> int:
        raise KeyboardInterrupt

    assert main(None) == 1
    assert capsys.readouterr().err == "stopped: the same command begins anew\n"


def test_fewer_than_no_processes():
    with pytest.raises(ValueError, match="processes must be at least 1, or 0 for as many"):
        study.Workers(processes=-1)
