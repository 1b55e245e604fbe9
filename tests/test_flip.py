"""The demo's code path, shortened: plan, run, judge, write. The policies are untrained."""

from __future__ import annotations

import json
import math
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from rich.console import Console

from hmc.cfg import load
from hmc.go2.model import DT
from hmc.go2.stages import Stages
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import flip_task
from tools import closed_loop, figures, flip, jump_guess, record_flips, showreel
from tools.random_policy import write_random_policy

SHORT = (
    *("seconds=0.2", "task.horizon=6", "task.command=5", "search.samples=4", "search.control_steps=100"),
    *("task.jump.sampling.horizon=4", "task.jump.sampling.knots=3", "task.jump.sampling.samples=3"),
    *("task.jump.sampling.replan_every=2", "task.jump.sampling.worlds=12"),
)
STEPS = 10
SUMMARY = {
    *("seeds", "success", "foot_stand", "jump_flip", "handstand"),
    *("cost_mean", "plan_ms_p50", "plan_ms_p99", "coverage_mean"),
}


@pytest.fixture(scope="module")
def overrides(tmp_path_factory) -> tuple[str, ...]:
    folder = tmp_path_factory.mktemp("policies")
    paths = [write_random_policy(folder / f"{name}.onnx", hidden=(8,), seed=i) for i, name in enumerate("ab")]
    return (*SHORT, f"task.foot={paths[0]}", f"task.hand={paths[1]}")


@pytest.fixture(scope="module")
def cfg(overrides) -> closed_loop.RunCfg:
    return load(flip.ROOT / "cfg" / "flip.toml", closed_loop.RunCfg, overrides)


def one_run(cfg: closed_loop.RunCfg, seed: int, seen: list[Any] | None = None) -> closed_loop.Run:
    progress = None if seen is None else lambda *args: seen.append(args)
    task = flip_task(cfg.task, seed=seed, threads=1)
    return closed_loop.run(closed_loop.planned(cfg, task, seed), task.cost, cfg, seed, progress=progress)


@pytest.fixture(scope="module")
def done(cfg) -> closed_loop.Run:
    return one_run(cfg, 0)


def test_a_run_is_recorded_step_by_step(cfg, done):
    assert done.x.shape == (STEPS + 1, 37)
    assert len(done.modes) == STEPS
    assert done.terms.shape == (STEPS, 6)
    assert [entry["step"] for entry in done.log] == list(range(STEPS))
    assert done.x.isfinite().all()
    assert done.cost == pytest.approx(sum(entry["stage_cost"] for entry in done.log))
    for entry, x, mode in zip(done.log, done.x, done.modes, strict=False):
        assert entry["x"] == pytest.approx(x.tolist(), abs=1e-6)
        assert entry["mode"] == mode
        assert mode in ("foot", "jump", "hand")
        assert 0 <= entry["coverage"] <= 1
        assert entry["control_steps"] <= 100 + 6 * 4 * (1 + 3 * 4), "the budget, and what was under way"
        assert entry["plan_ms"] > 0
        assert len(entry["u"]) == 12


def test_the_log_is_what_happened(cfg, done):
    """The logged inputs, applied again, give the logged states."""
    world = flip_task(cfg.task, threads=1).make_sim(1)
    x, u = closed_loop.disturbed_start(cfg.start, 0)
    world.reset(x[None], u[None])
    for entry, after in zip(done.log, done.x[1:], strict=True):
        world.step(torch.tensor(entry["u"])[None].double())
        torch.testing.assert_close(world.x()[0], after, atol=1e-3, rtol=1e-3)


def test_the_same_seed_gives_the_same_run(cfg, done):
    seen: list[Any] = []
    again, other = one_run(cfg, 0, seen), one_run(cfg, 1)
    assert torch.equal(again.x, done.x)
    assert again.modes == done.modes
    assert [entry["schedule"] for entry in again.log] == [entry["schedule"] for entry in done.log]
    assert not torch.equal(other.x[0], done.x[0])
    assert [step for step, *_ in seen] == list(range(1, STEPS + 1)), "progress"
    _, entry, angle, height = seen[0]
    assert entry["step"] == 0
    assert angle == pytest.approx(-90, abs=6)
    assert height == pytest.approx(0.573, abs=0.02)


def test_disturbed_start(cfg):
    stand = FOOTSTAND.state()
    rows = [closed_loop.disturbed_start(cfg.start, seed) for seed in range(20)]
    x, u = (torch.stack(values) for values in zip(*rows, strict=True))
    assert torch.equal(x[0], closed_loop.disturbed_start(cfg.start, 0)[0])
    torch.testing.assert_close(x[:, 3:7].norm(dim=1), torch.ones(20).double())
    assert ((x[:, 7:19] - stand[7:19]).abs() <= cfg.start.joints).all()
    assert torch.equal(u, x[:, 7:19])
    assert FOOTSTAND.uprightness(x).min() > math.cos(1.5 * cfg.start.tilt)
    assert (x.std(0)[[7, 19, 22, 25]] > 0).all()


def test_files_of_a_run(cfg, done, tmp_path):
    text = StringIO()
    task = flip_task(cfg.task, threads=1)
    flip.write_run(tmp_path, done, task, cfg, video=False, console=Console(file=text))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "seed_0.json", "seed_0_cost.png", "seed_0_timeline.png",
    ]  # fmt: skip
    log = json.loads((tmp_path / "seed_0.json").read_text(encoding="utf-8"))
    assert log["seed"] == 0
    assert set(log["stages"]) == {"foot_stand", "jump_flip", "handstand"}
    assert log["steps"] == done.log
    assert text.getvalue() == ""


def test_a_video_that_cannot_be_made_is_one_line(cfg, done, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no_such_backend")
    text = StringIO()
    flip.write_run(tmp_path, done, flip_task(cfg.task, threads=1), cfg, True, Console(file=text, width=500))
    (line,) = text.getvalue().strip().splitlines()
    assert line.startswith("no video: OpenGL is missing here")
    assert (tmp_path / "seed_0.json").exists()


def test_summary(cfg, done):
    summary = flip.summarise([done, done])
    assert set(summary) == SUMMARY
    assert (summary["seeds"], summary["success"]) == (2, 0)
    assert summary["cost_mean"] == pytest.approx(done.cost)
    assert 0 < summary["plan_ms_p50"] <= summary["plan_ms_p99"]
    assert flip.table([done]).row_count == 1


def test_the_program(overrides, done, tmp_path, monkeypatch, capsys):
    """All seeds, all files, and an exit status that says whether any of them succeeded."""
    args = flip.Args(seeds=2, first_seed=3, out=tmp_path / "flip", processes=2, video=False, set=overrides)
    assert flip.main(args) == 1, "untrained policies do not flip"
    summary = json.loads((tmp_path / "flip" / "summary.json").read_text(encoding="utf-8"))
    assert set(summary) == SUMMARY
    assert summary["seeds"] == 2
    assert {path.name for path in (tmp_path / "flip").glob("*.json")} == {
        "seed_3.json",
        "seed_4.json",
        "summary.json",
    }
    assert not list((tmp_path / "flip").glob("*partial*"))
    printed = capsys.readouterr().out
    assert "foot stand" in printed
    assert "plan p99" in printed

    reached = Stages(foot_stand=True, jump_flip=True, handstand=True)
    monkeypatch.setattr(flip, "run_all", lambda *_: iter([replace(done, stages=reached)]))
    monkeypatch.setattr(flip, "write_run", lambda *_: None)
    assert flip.main(replace(args, seeds=1)) == 0


def test_figures_are_in_seconds(cfg, done, tmp_path, monkeypatch):
    """Of a run that is no whole number of control steps long, too: 0.21 s are ten of them."""
    steps = []
    monkeypatch.setattr(figures, "timeline", lambda *given: steps.append(given[5]))
    monkeypatch.setattr(figures, "cost_terms", lambda *given: steps.append(given[4]))
    longer = replace(cfg, seconds=0.21)
    flip.write_run(tmp_path, done, flip_task(cfg.task), longer, False, Console(quiet=True))
    assert steps == [DT, DT]


def test_what_is_done_is_summarised_when_a_worker_is_lost(overrides, done, tmp_path, monkeypatch, capsys):
    def lost(*_):
        yield done
        raise BrokenProcessPool

    monkeypatch.setattr(flip, "run_all", lost)
    flip.main(flip.Args(seeds=2, out=tmp_path, video=False, set=overrides))
    assert "a worker was lost (out of memory?) with 1 of 2 runs done" in capsys.readouterr().out
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["seeds"] == 1


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"first": 32}, "expected 0 <= first <= last, got 32 and 30"),
        ({"states": 0}, "states must be at least 1, got 0"),
        ({"out": Path()}, "error: cannot write . (it is a folder): choose another file"),
        ({"seed": 10**30}, "error: Overflow"),
    ],
)
def test_records_of_no_jump(tmp_path, capsys, given, line):
    with pytest.raises(SystemExit) as ended:
        record_flips.main(record_flips.Args(**{"out": tmp_path / "flips.pt", **given}))
    assert ended.value.code == 2
    assert line in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"points": 0}, "points must be at least 1, got 0"),
        ({"elite": 1}, "elite must be 2 to 40, the number of candidates, got 1"),
        ({"candidates": 6}, "elite must be 2 to 6, the number of candidates, got 8"),
        ({"durations": ()}, "durations: expected one or more of at least 1 control step, got ()"),
        ({"durations": (20, -1)}, "durations: expected one or more of at least 1 control step, got (20, -1)"),
        ({"out": Path()}, "error: cannot write . (it is a folder): choose another file"),
    ],
)
def test_a_search_of_nothing(tmp_path, capsys, given, line):
    """Some wrote a guess of nan."""
    with pytest.raises(SystemExit) as ended:
        jump_guess.main(jump_guess.Args(**{"out": tmp_path / "guess.toml", **given}))
    assert ended.value.code == 2
    assert line in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("program", [flip, showreel])
def test_no_seeds(program, tmp_path, capsys):
    (tmp_path / "file").touch()
    for given, line in (
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"first_seed": -1}, "first_seed must be at least 0, got -1"),
        ({"set": ("seconds=0",)}, "with seconds=0: "),
        ({"out": tmp_path / "file"}, "cannot write"),
    ):
        with pytest.raises(SystemExit):
            program.main(program.Args(**{"out": tmp_path / "out", **given}))
        assert line in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    with pytest.raises(ValueError, match="processes must be at least 1, or 0"):
        flip.Args(processes=-1)


def refused(capsys, *items: str) -> str:
    """The line with which the program ends; nothing is written before."""
    with pytest.raises(SystemExit) as ended:
        flip.main(flip.Args(seeds=1, out=Path("never"), processes=1, set=items))
    assert ended.value.code == 2
    assert not Path("never").exists()
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_an_unknown_key(overrides, capsys):
    line = refused(capsys, *overrides, "task.horizn=3")
    assert "unknown key task.horizn; did you mean horizon?" in line


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("task.horizon=0", "horizon must be at least 1 control step, got 0"),
        ("task.jump.sampling.samples=0", "sampling.samples must be at least 1, got 0"),
        ("task.foot=gone.onnx", "policy gone.onnx: no such file"),
    ],
)
def test_bad_values(overrides, capsys, item, message):
    assert message in refused(capsys, *overrides, item)


def test_a_policy_of_another_observation_version(overrides, capsys, tmp_path):
    path = write_random_policy(tmp_path / "old.onnx", hidden=(8,))
    model = onnx.load(str(path))
    for field in model.metadata_props:
        if field.key == "observation_version":
            field.value = "7"
    onnx.save(model, str(path))
    line = refused(capsys, *overrides, f"task.hand={path}")
    assert f"policy {path}: observation_version is 7, expected 1" in line
    assert "train and export it again" in line
