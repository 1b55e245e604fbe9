"""The cartpole study in a tiny setting: what is written, and that a stopped study goes on; its reference."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hmc.cfg import load
from hmc.sampling import METHODS
from hmc.sim.cartpole import CartpoleSim
from hmc.tasks.cartpole import CartpoleCfg
from tools import cartpole, cartpole_figures, cartpole_study, study
from tools.cartpole_figures import gap, reference

TINY = (
    *("horizons=[6, 8]", "compare=[8]", "seeds=2", "rollouts=60", "optima=1", "starts=1", "num_modes=[3, 5]"),
    "angles=[3.14159, 1.5]",
    *("loop.steps=2", "loop.rollouts=10", "task.horizon=8", "task.angle=3.14159", "schedules.samples=16"),
    *("mppi.samples=10", "cem.samples=10", "ps.samples=10"),
)


@pytest.fixture(scope="module")
def cfg() -> cartpole_study.StudyCfg:
    return load(cartpole.ROOT / "cfg" / "cartpole.toml", cartpole_study.StudyCfg, TINY)


@pytest.fixture(scope="module")
def rows(cfg) -> list[cartpole_study.Row]:
    return [cartpole_study.work(cfg, job) for job in cartpole_study.jobs(cfg)]


def test_every_planner_keeps_to_the_same_budget(cfg, rows):
    for row in rows:
        budget = (
            cfg.rollouts * row.job.horizon
            if row.job.part == "solve"
            else 2 * cfg.loop.rollouts * row.job.horizon
        )
        assert row.control_steps <= budget, row
        if row.job.planner in METHODS:
            assert row.control_steps == budget


def test_costs_are_those_of_the_task(cfg, rows):
    """No schedule is below what iLQR finds by more than its tolerance, and a gap is a mean step's cost."""
    for row in rows:
        assert math.isfinite(row.cost)
        if (row.job.part, row.job.num_modes) == ("solve", 5):
            least = reference(rows, row.job).cost
            assert gap(rows, row) == pytest.approx((row.cost - least) / row.job.horizon)
            assert gap(rows, row) > -1e-3
    again = cartpole_study.work(cfg, rows[0].job)
    assert (again.cost, again.control_steps) == (rows[0].cost, rows[0].control_steps)


def test_modes_and_angles_are_compared_in_both_parts(cfg, rows):
    for part in ("solve", "loop"):
        mine = [row.job for row in rows if row.job.part == part and row.job.horizon == 8]
        assert {job.num_modes for job in mine if job.planner == "schedules"} == {3, 5}
        assert {job.planner for job in mine if job.angle == 1.5} >= set(cartpole_study.PLANNERS)
    with pytest.raises(ValueError, match=r"compare = \[9\]: choose among the horizons 6, 8"):
        replace(cfg, compare=(9,))


def test_a_longer_horizon_is_no_worse_than_what_holds_the_shorter_one():
    """What iLQR comes to at 40 steps, held up from there on, costs hardly more than it does."""
    task = CartpoleCfg(horizon=60)
    cfg = cartpole_study.StudyCfg(horizons=(40, 60), compare=(), iterations=30, task=task)
    short, long = (cartpole_study.Job("solve", "ilqr", horizon, 0, 5, math.pi) for horizon in (40, 60))
    before, after = cartpole_study.optimum(cfg, short), cartpole_study.optimum(cfg, long)
    assert before.cost < 15
    assert after.cost < before.cost + 0.1
    assert after.controls.shape == (60, 1)


def test_hold_keeps_the_pole_up():
    sim = CartpoleSim(1)
    x = torch.tensor([2 * math.pi + 0.15, 0.1, -0.2, 0.3], dtype=torch.float64)
    inputs = cartpole_study.hold(sim, x, 200)
    assert inputs.shape == (200, 1)
    assert inputs.abs().max() <= 1
    for u in inputs:
        x = sim.advance(x[None], u[None])[0]
    assert abs(float(x[0]) - 2 * math.pi) < 0.01
    assert float(x[1:].abs().max()) < 0.3


def test_a_stopped_study_goes_on(cfg, rows, tmp_path, monkeypatch, capsys):
    ran = []

    def stops(_, todo, processes, console):
        for job in todo[:3]:
            ran.append(job)
            yield next(row for row in rows if row.job == job)
        raise KeyboardInterrupt

    def ends(_, todo, processes, console):
        ran.extend(todo)
        yield from (next(row for row in rows if row.job == job) for job in todo)

    args = cartpole.Args(out=tmp_path, set=TINY)
    monkeypatch.setattr(study, "run_all", stops)
    assert cartpole.main(args) == 1
    assert "stopped with 3 of" in capsys.readouterr().out
    assert not (tmp_path / "results.csv").exists()
    monkeypatch.setattr(study, "run_all", ends)
    assert cartpole.main(args) == 0
    assert sorted(map(str, ran)) == sorted(map(str, cartpole_study.jobs(cfg)))
    assert study.read(tmp_path / "results.csv", cartpole_study.Row) == rows
    assert {"gap.png", "sequence.png"} <= {path.name for path in tmp_path.iterdir()}


def test_other_settings_begin_anew(rows, tmp_path, monkeypatch):
    todos = []

    def stops(_, todo, processes, console):
        todos.append(len(todo))
        yield next(row for row in rows if row.job == todo[0])
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run_all", stops)
    for settings in (TINY, TINY, (*TINY, "rollouts=70")):
        cartpole.main(cartpole.Args(out=tmp_path, set=settings))
    assert todos == [len(rows), len(rows) - 1, len(rows)]


def test_what_cannot_be_drawn_is_refused_before_it_is_computed(capsys, tmp_path):
    for items, line in (
        (("task.horizon=50",), "task.horizon = 50, which is drawn: choose one of the horizons 6, 8"),
        (("seeds=0",), "seeds must be at least 1, got 0"),
        (("optima=0",), "optima must be at least 1, got 0"),
    ):
        with pytest.raises(SystemExit):
            cartpole.main(cartpole.Args(out=tmp_path, set=(*TINY, *items)))
        assert line in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_table_is_there_if_a_figure_fails(rows, tmp_path, monkeypatch):
    def fails(*_):
        raise RuntimeError

    monkeypatch.setattr(study, "run_all", lambda *_: iter(rows))
    monkeypatch.setattr(cartpole_figures, "gaps", fails)
    with pytest.raises(RuntimeError):
        cartpole.main(cartpole.Args(out=tmp_path, set=TINY))
    assert study.read(tmp_path / "results.csv", cartpole_study.Row) == rows


def test_an_unknown_key(capsys):
    with pytest.raises(SystemExit):
        cartpole.main(cartpole.Args(set=("horizon=[3]",)))
    assert "unknown key horizon; did you mean horizons?" in capsys.readouterr().err
