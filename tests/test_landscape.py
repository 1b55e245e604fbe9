"""The picture of a search: every switch's cost at its place, and a run's log read back."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from hmc import Budget, Evaluator, Rules, Schedule, Switch, make_start, plan
from hmc.cfg import load
from hmc.go2.task import flip_task
from hmc.tasks.cartpole import CartpoleCfg, cartpole
from tests.toy import Bad, Damp, Push, slow_cost, toy_task
from tools import landscape as shows
from tools.closed_loop import RunCfg, planned, run
from tools.figures import search
from tools.landscape import Args, Landscape, draw, landscape, main, of_log, parse, read, reason

NAMES = ("foot", "jump", "hand")


def test_every_switch_is_at_its_place(tmp_path):
    task = toy_task(4)
    sim = task.make_sim(16)
    schedule = Schedule((0, 0, 1, 1), task.modes.names)
    found = landscape(task, Evaluator(task, sim, make_start(task, sim, [0.4, -0.2])), schedule)
    assert found.costs.shape == (3, 4, 4)
    for mode in range(3):
        for start in range(4):
            for duration in range(1, 5):
                cost = found.costs[mode, start, duration - 1]
                if start + duration > 4:
                    assert math.isnan(cost)
                else:
                    switched = schedule.stitch(Switch(mode, start, duration))
                    assert cost == pytest.approx(slow_cost(task, switched, [0.4, -0.2]))
    assert slow_cost(task, found.best, [0.4, -0.2]) == pytest.approx(np.nanmin(found.costs))
    assert found.switch is not None
    assert found.best == schedule.stitch(found.switch)
    assert [sum(terms.values()) for terms in found.terms] == pytest.approx(
        [found.cost, np.nanmin(found.costs)]
    )
    assert not found.barred.any()
    draw(tmp_path / "picture.png", found, "toy")
    assert (tmp_path / "picture.png").stat().st_size > 5000


def shown(found: Landscape, path: Path, monkeypatch: pytest.MonkeyPatch) -> Figure:
    """The figure that is drawn."""
    figures = []
    monkeypatch.setattr(shows, "save", lambda figure, _: figures.append(figure))
    draw(path, found, "toy")
    return figures[0]


def test_the_mark_is_on_the_best_switch_by_its_own_duration(tmp_path, monkeypatch):
    task = toy_task(4)
    sim = task.make_sim(16)
    begin = Evaluator(task, sim, make_start(task, sim, [0.4, -0.2]))
    found = landscape(task, begin, Schedule((0, 0, 1, 1), task.modes.names))
    assert found.switch is not None
    panels = shown(found, tmp_path, monkeypatch).axes[:3]
    for mode, axis in enumerate(panels):
        marks = [np.asarray(line.get_xydata()).tolist() for line in axis.lines]
        mine = [[[found.switch.start, found.switch.duration]]] if mode == found.switch.mode else []
        assert marks == mine
        left, right, low, high = axis.images[0].get_extent()
        assert (left, right, low, high) == (-0.5, 3.5, 0.5, 4.5), "durations of 1 to T"


def test_nothing_is_marked_where_nothing_improves(tmp_path, monkeypatch):
    task = toy_task(4)
    best = plan(task, [0.4, -0.2], solver="exhaustive")
    assert best.locally_optimal
    sim = task.make_sim(16)
    found = landscape(task, Evaluator(task, sim, make_start(task, sim, [0.4, -0.2])), best.schedule)
    assert (found.switch, found.best) == (None, best.schedule)
    assert found.terms[0] == found.terms[1]
    assert not any(axis.lines for axis in shown(found, tmp_path, monkeypatch).axes)


def test_barred_and_diverged_switches_are_told_apart(tmp_path, monkeypatch):
    """A mode that may not come second, and one that ends in NaN."""
    task = toy_task(4, [Push(1.0), Damp(), Bad(0)])
    task = replace(task, rules=Rules(forbidden=[("push1", "damp")]))
    sim = task.make_sim(16)
    begin = Evaluator(task, sim, make_start(task, sim, [0.4, -0.2], mode=0))
    found = landscape(task, begin, Schedule((0, 0, 0, 0), task.modes.names))
    legal = ~np.isnan(found.costs[0])
    assert found.barred[1][legal].all()
    assert not found.barred[[0, 2]].any()
    assert np.isinf(found.costs[2][legal]).all()
    panels = shown(found, tmp_path, monkeypatch).axes[:3]
    kinds = [np.unique(np.ma.compressed(axis.images[1].get_array())).tolist() for axis in panels]
    assert kinds == [[], [0.0], [1.0]]
    legend = panels[2].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "against the rules",
        "diverged, or not to be entered",
    ]


def test_a_plan_step_by_step(tmp_path, capsys):
    """The cartpole's: each accepted step with the terms that fell, and the landscape after some of them."""
    small = ("horizon=12", "num_modes=3", "angle=1.0")
    args = Args(
        task="cartpole", step=1, out=tmp_path / "new" / "c.png", worlds=64, control_steps=4000, set=small
    )
    main(args)
    assert (tmp_path / "new" / "c.png").stat().st_size > 5000
    said = capsys.readouterr().out
    task = cartpole(CartpoleCfg(horizon=12, num_modes=3, angle=1.0))
    budget = Budget(control_steps=4000)
    found = plan(task, [1.0, 0, 0, 0], schedule=[1] * 12, budget=budget)
    assert str(found.schedules[1]) in said
    assert (tmp_path / "new" / "c_plan.png").stat().st_size > 5000
    ((_, after), *_) = found.steps
    assert reason(found.incumbent_terms, after) in " ".join(said.split())
    with pytest.raises(SystemExit):
        main(replace(args, step=99))
    assert f"the plan has 0 to {len(found.steps)} accepted steps, got --step 99" in capsys.readouterr().err


def test_how_a_plan_came_about(tmp_path, monkeypatch):
    """A row a schedule, a bar a stretch of a mode in its colour; what a step overwrote is outlined."""
    figures = []
    monkeypatch.setattr("tools.figures.save", lambda figure, _: figures.append(figure))
    found = plan(toy_task(8), [0.4, -0.2], seed=3, moves=2)
    assert len(found.steps) > 1
    search(tmp_path / "s.png", found)
    axis = figures[0].axes[0]
    boxes = [
        (
            round(box.get_y() + 0.5 * box.get_height()),
            box.get_x(),
            box.get_width(),
            box.get_fill(),
            box.get_fc(),
        )
        for box in axis.patches
    ]
    bars = [(row, start, width) for row, start, width, filled, _ in boxes if filled]
    runs = [(row, run.start, run.duration) for row, made in enumerate(found.schedules) for run in made.runs()]
    assert bars == runs
    marks = [(row, start, width) for row, start, width, filled, _ in boxes if not filled]
    steps = enumerate((switches for switches, _ in found.steps), 1)
    assert marks == [(row, each.start, each.duration) for row, switches in steps for each in switches]
    legend = axis.get_legend()
    colors = [handle.get_facecolor() for handle in legend.legend_handles]
    modes = [run.mode for made in found.schedules for run in made.runs()]
    assert [color for *_, filled, color in boxes if filled] == [colors[mode] for mode in modes]
    assert [text.get_text() for text in legend.get_texts()] == list(found.schedule.names)
    assert [text.get_text() for text in axis.texts] == [f"{cost:.5g}" for cost in found.costs]


def test_the_largest_fall_comes_first():
    before, after = {"a": 1.0, "b": 2.0, "c": 0.0}, {"a": 1.5, "b": 0.5, "c": -0.25}
    assert reason(before, after) == "b -1.5, c -0.25, a +0.5"


def test_a_compact_line_is_read_back():
    schedule = Schedule((0, 0, 0, 1, 2, 2), NAMES)
    assert parse(str(schedule), NAMES) == schedule


def test_steps_that_cannot_be_shown(tmp_path):
    log = tmp_path / "seed_0.json"
    steps = [{"mode": mode, "u": [0.0]} for mode in ("foot", "jump", "hand", "hand")]
    log.write_text(json.dumps({"seed": 7, "steps": steps}))
    assert read(log, 2) == (7, steps[:3])
    with pytest.raises(ValueError, match="has steps 0 to 3, got --step 4"):
        read(log, 4)


def test_a_plan_costs_what_its_log_says(tmp_path):
    """From the input and with the memory that there were: at the start, and in each mode."""
    items = ("seconds=0.64", "task.horizon=16", "task.command=8", "task.jump.dwell=8", "task.jump.mpc=false")
    cfg = load(shows.ROOT / "cfg" / "flip.toml", RunCfg, items)
    task = flip_task(cfg.task, seed=3, threads=1)
    done = run(planned(cfg, task, 3), task.cost, cfg, 3)
    (tmp_path / "seed_3.json").write_text(json.dumps({"seed": 3, "steps": done.log}))
    assert len(set(done.modes)) > 1
    changed = next(k for k in range(1, 32) if done.modes[k] != done.modes[k - 1])
    for step in (0, 1, 15, changed, changed + 1, changed + 5, 30):
        planned_in, start, schedule = of_log(Args(tmp_path / "seed_3.json", step=step, set=items))
        cost = Evaluator(planned_in, planned_in.make_sim(4), start).follow(schedule)
        assert cost == pytest.approx(done.log[step]["cost"], abs=1e-4), step
        assert (start.mode is None) == (step == 0)


def test_the_noise_is_that_of_the_run(tmp_path, monkeypatch):
    """A log's search is rolled out under the log's own seed."""
    log, seeds = tmp_path / "seed_7.json", []
    entry = {"mode": "foot", "u": [0.0], "x": [0.4, -0.2], "schedule": "push1 x6"}
    log.write_text(json.dumps({"seed": 7, "steps": [{**entry, "mode": "damp"}] * 2}))

    def made(cfg, seed):
        seeds.append(seed)
        return toy_task(6)

    monkeypatch.setattr(shows, "flip_task", made)
    task, start, schedule = of_log(Args(log, step=1))
    assert seeds == [7]
    assert start.mode is not None
    assert (task.modes.names[start.mode], start.k, len(schedule)) == ("damp", 1, 6)
    with pytest.raises(ValueError, match=r"give seed_\*\.json"):
        of_log(Args())
