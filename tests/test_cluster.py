"""Studies on a local Ray cluster: a worker is killed in the middle, and no job is lost or counted twice."""

from __future__ import annotations

import gc
import importlib.util
import subprocess
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from hmc.cli import command_line
from tests.squares import Job, Row, work, work_on_a_node
from tools import cluster, robustness, study

HAS_RAY = importlib.util.find_spec("ray") is not None
needs_ray = pytest.mark.skipif(not HAS_RAY, reason="needs the ray extra: pip install -e .[ray]")


def begun(folder: Path) -> Counter[int]:
    """How often each job began."""
    return Counter(map(int, (folder / "begun").read_text(encoding="utf-8").split()))


def studied(folder: Path, jobs: list[Job]) -> list[Row] | None:
    """The study of these jobs on a cluster of this machine, where job 3 kills its first worker."""
    workers, do = study.Workers(processes=2, ray=""), partial(work, folder, 3)
    return study.carry_out(do, jobs, folder / "table.csv", Row, workers, Console(quiet=True))


@needs_ray
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a start of Ray's that failed
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_lost_worker(tmp_path):
    """Its job runs again; what a stopped study has done already does not; every row is there once."""
    jobs = [Job(i) for i in range(6)]
    expected = [Row(job, job.number**2) for job in jobs]
    study.write(tmp_path / "table.csv", expected[4:])
    assert studied(tmp_path, jobs) == expected
    assert begun(tmp_path) == Counter({0: 1, 1: 1, 2: 1, 3: 2})
    assert study.read(tmp_path / "table.csv", Row) == expected
    assert studied(tmp_path, jobs) == expected
    assert begun(tmp_path).total() == 5, "nothing left to do"
    gc.collect()  # what Ray left, while its warnings are ignored


@pytest.fixture
def two_machines(monkeypatch):
    """A cluster of two nodes on this machine, a core each; the second one is lost or ends with the test."""
    import ray

    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # a path that is short enough for sockets
        monkeypatch.setenv("RAY_TMPDIR", folder)
        cluster.join("", 1)
        command = [str(Path(sys.executable).with_name("ray")), "start", "--num-cpus=1", "--block"]
        command.append(f"--address={ray.get_runtime_context().gcs_address}")
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT) as node:
            give_up = time.monotonic() + 60
            while len(ray.nodes()) < 2 and time.monotonic() < give_up:
                time.sleep(0.1)
            yield
            ray.shutdown()
            node.terminate()


@needs_ray
def test_a_lost_machine(tmp_path, two_machines):
    """Its job runs again elsewhere; every row is there once."""
    import ray

    assert len(ray.nodes()) == 2
    jobs = [Job(i) for i in range(6)]
    head = ray.get_runtime_context().get_node_id()
    found = cluster.on_ray(partial(work_on_a_node, tmp_path, head), jobs)
    assert sorted(found, key=lambda row: row.job.number) == [Row(job, job.number**2) for job in jobs]
    away = {path.name.removeprefix("away_") for path in tmp_path.glob("away_*")}
    assert len(away) == 2, "two began there"
    assert any((tmp_path / f"head_{number}").exists() for number in away), "again"


@needs_ray
def test_a_cluster_that_was_killed_is_not_looked_for(tmp_path, monkeypatch):
    """It leaves its address behind, and Ray would try to join it for ever."""
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    monkeypatch.setattr("ray._private.services.find_gcs_addresses", set)
    (tmp_path / "ray").mkdir()
    for folder in (tmp_path, tmp_path / "ray"):
        (folder / "ray_current_cluster").write_text("127.0.0.1:1")
    assert cluster._current() == ""


@needs_ray
@pytest.mark.parametrize("address", ["127.0.0.1:1", "127.0.0.1", "ray://127.0.0.1:1"])
def test_no_cluster_there(address):
    with pytest.raises(ValueError, match=rf"no Ray cluster .* {address} .*: processes of this") as error:
        cluster.join(address, 1)
    assert "\n" not in str(error.value)


def test_without_ray(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit):
        studied(tmp_path, [Job(1)])
    (line,) = capsys.readouterr().err.splitlines()
    assert "--ray needs the package ray: pip install 'hmc[ray]', or leave --ray out" in line


def test_command_line():
    def workers(*words: str) -> study.Workers:
        args = command_line(robustness.Args, args=words)
        return study.Workers(args.processes, args.ray)

    assert workers() == study.Workers()
    assert workers("--ray") == study.Workers(ray="")
    assert workers("--ray", "--processes", "3") == study.Workers(3, "")
    assert workers("--ray", "10.0.0.1:6379", "--out", "x") == study.Workers(ray="10.0.0.1:6379")
