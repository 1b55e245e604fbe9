"""How the flip grows: what each factor changes, what is counted, and the program in a tiny setting."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from hmc.cfg import load
from tests.test_flip import SHORT
from tools import growth, study
from tools.closed_loop import RunCfg, study_cfg
from tools.growth import FactorCfg, GrowthCfg, Job, Row, jobs, points, settings, work
from tools.random_policy import write_random_policy

FACTORS = (
    FactorCfg("horizon", "steps", "task.horizon", (4, 6), ("task.cost.tail=0.0",)),
    FactorCfg("modes", "modes", "task.idle", (3, 5)),
    FactorCfg("time", "s", "search.seconds", (0.002,), ("search.draws=100",)),
)


@pytest.fixture(scope="module")
def cfg(tmp_path_factory) -> GrowthCfg:
    path = write_random_policy(tmp_path_factory.mktemp("policies") / "random.onnx", hidden=(8,))
    base = (*SHORT, "task.jump.mpc=false", f"task.foot={path}", f"task.hand={path}")
    made = GrowthCfg(trials=2, first_seed=7, base=base, factors=FACTORS)
    return replace(made, flip=load(growth.ROOT / "cfg" / "flip.toml", RunCfg, base))


def test_the_committed_study_can_be_read():
    cfg = study_cfg(growth.ROOT / "cfg" / "growth.toml", GrowthCfg, ())
    for factor in cfg.factors:
        for value in factor.values:
            settings(cfg, Job(factor.name, value, 0))
    assert len(jobs(cfg)) == len(set(jobs(cfg))) == cfg.trials * sum(len(each.values) for each in cfg.factors)


def test_a_factor_changes_one_thing(cfg):
    long, short = (settings(cfg, Job("horizon", value, 0)) for value in (6, 4))
    assert (long.task.horizon, short.task.horizon) == (6, 4)
    assert replace(long.task, horizon=4) == short.task
    assert long.task.cost.tail == 0.0
    three, five = (settings(cfg, Job("modes", value, 0)) for value in (3, 5))
    assert three.task.idle == ()
    assert five.task.idle == ("stand", "getup")
    assert three.task.cost.tail == five.task.cost.tail != 0.0
    timed = settings(cfg, Job("time", 0.002, 0)).search
    assert (timed.seconds, timed.draws) == (0.002, 100)


def test_what_is_set_of_the_flip_holds_in_every_run():
    """It changed the cost that runs are judged by, and not the runs; a factor still has the last word."""
    items = ("flip.start.joints=0.01", "flip.task.cost.height=2.0", "flip.task.horizon=9")
    found = study_cfg(growth.ROOT / "cfg" / "growth.toml", GrowthCfg, items)
    modes, horizon = (settings(found, Job(name, 25, 0)) for name in ("draws", "horizon"))
    for each in (modes, horizon):
        assert (each.start.joints, each.task.cost.height) == (0.01, 2.0)
    assert (modes.task.horizon, horizon.task.horizon) == (9, 25)


def test_a_run_has_more_to_choose_from_with_more_modes(cfg):
    """Where nothing better is found, coverage is a tick's 2 draws over all M T (T + 1) / 2 switches."""
    three, five = (work(cfg, Job("modes", value, 11)) for value in (3, 5))
    assert (three.coverage, five.coverage) == pytest.approx((2 / 63, 2 / 105))
    assert math.isfinite(three.cost)


def test_points_by_hand(cfg):
    def row(value: float, seed: int, success: bool, cost: float) -> Row:
        return Row(Job("horizon", value, seed), success, cost, 10.0 * seed, 20.0, 5.0, 0.5)

    rows = [row(4, 7, True, 2.0), row(4, 8, False, 90.0), row(6, 7, True, 2.0), row(6, 8, True, 4.0)]
    low, high = points(replace(cfg, factors=FACTORS[:1]), rows)["horizon"]
    assert (low["success"], low["runs"], low["cost"], low["spread"]) == (1, 2, 2.0, 0.0)
    assert (high["success"], high["cost"], high["spread"], high["plan_ms"]) == (2, 3.0, 1.0, 75.0)


def test_the_program(cfg, tmp_path, monkeypatch, capsys):
    """Stopped after some runs it goes on with the others; nothing runs twice."""
    done: list[Job] = []

    def some(do, todo, *_):
        first = not done
        for job in todo:
            if first and len(done) == 3:
                raise KeyboardInterrupt
            done.append(job)
            yield do(job)

    monkeypatch.setattr(study, "run_all", some)
    monkeypatch.setattr(growth, "study_cfg", lambda *_: cfg)
    args = growth.Args(out=tmp_path)
    assert growth.main(args) == 1
    assert len(done) == 3
    assert growth.main(args) == 0
    assert sorted(done, key=str) == sorted(jobs(cfg), key=str)
    found = json.loads((tmp_path / "growth.json").read_text(encoding="utf-8"))
    assert {name: [point["value"] for point in values] for name, values in found.items()} == {
        "horizon": [4, 6],
        "modes": [3, 5],
        "time": [0.002],
    }
    assert all(point["runs"] == 2 for values in found.values() for point in values)
    assert (tmp_path / "growth.png").stat().st_size > 0
    assert "coverage" in capsys.readouterr().out


def test_an_unknown_key_is_named(cfg, monkeypatch, capsys, tmp_path):
    wrong = replace(cfg, factors=(FactorCfg("speed", "m/s", "task.speed", (1.0,)),))
    monkeypatch.setattr(growth, "study_cfg", lambda *_: wrong)
    with pytest.raises(SystemExit):
        growth.main(growth.Args(out=tmp_path))
    assert "task.speed" in capsys.readouterr().err
