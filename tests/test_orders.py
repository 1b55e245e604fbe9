"""The comparison of orders: equal control steps, what is counted, and the program in a tiny setting."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hmc.cfg import load, override
from hmc.solvers import ORDERS
from tests.test_flip import SHORT
from tools import cartpole_study, orders, study
from tools.closed_loop import RunCfg
from tools.orders import Job, OrdersCfg, Row, jobs, table, work
from tools.random_policy import write_random_policy

CARTPOLE = ("horizons=[8]", "compare=[]", "rollouts=60", "loop.steps=2", "loop.rollouts=10", "task.horizon=8",
            "schedules.samples=16", "schedules.max_samples=16")  # fmt: skip


@pytest.fixture(scope="module")
def cfg(tmp_path_factory) -> OrdersCfg:
    path = write_random_policy(tmp_path_factory.mktemp("policies") / "random.onnx", hidden=(8,))
    base = (*SHORT, "task.jump.mpc=false", f"task.foot={path}", f"task.hand={path}")
    flip = load(orders.ROOT / "cfg" / "flip.toml", RunCfg, base)
    return OrdersCfg(
        2, (8,), control_steps=40, flip=flip, cartpole=override(cartpole_study.StudyCfg(), CARTPOLE)
    )


def test_every_order_runs_on_every_system():
    cfg = load(orders.ROOT / "cfg" / "orders.toml", OrdersCfg)
    found = jobs(cfg)
    assert len(found) == len(set(found)) == cfg.seeds * (2 * len(cfg.horizons) + 1) * len(ORDERS)
    assert {job.order for job in found} == set(ORDERS)


def test_settings_of_both_systems():
    """Those of the cartpole were dropped."""
    cfg = orders.settings(("seeds=2", "cartpole.rollouts=10", "flip.search.moves=3"))
    assert (cfg.seeds, cfg.cartpole.rollouts, cfg.flip.search.moves) == (2, 10, 3)


@pytest.mark.parametrize("item", ["control_steps=0", "horizons=[40, 0]", "first_flip=-1"])
def test_settings_that_no_run_can_have(item, tmp_path, capsys):
    with pytest.raises(SystemExit):
        orders.main(orders.Args(out=tmp_path, set=(item,)))
    assert f"with {item}: OrdersCfg: {item.partition('=')[0]} must be at least" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_all_spend_the_same(cfg):
    for part, limit in (("solve", 60 * 8), ("loop", 2 * 10 * 8), ("flip", 40)):
        horizon = cfg.flip.task.horizon if part == "flip" else 8
        rows = [work(cfg, Job(part, horizon, order, 0)) for order in ORDERS]
        for row in rows:
            assert 0.5 * limit < row.control_steps <= 1.3 * limit, (
                "a batch may begin below the limit and exceed it"
            )
        assert work(cfg, rows[0].job) == rows[0]
        with pytest.raises(ValueError, match=r"order .*'tailz'"):  # it is the search's
            work(cfg, Job(part, horizon, "tailz", 0))


def test_the_program(cfg, tmp_path, monkeypatch, capsys):
    made = []
    found = [Row(job, float(job.seed), 7.0, job.order == "tails") for job in jobs(cfg)]

    def some(do, todo, *_):
        made.extend(todo)
        yield from (row for row in found if row.job in todo)

    monkeypatch.setattr(study, "run_all", some)
    monkeypatch.setattr(orders, "settings", lambda *_: cfg)
    assert orders.main(orders.Args(out=tmp_path)) == 0
    assert orders.main(orders.Args(out=tmp_path)) == 0
    assert len(made) == len(found), "nothing is run twice"
    assert study.read(tmp_path / "orders.csv", Row) == found
    monkeypatch.setattr(orders, "settings", lambda *_: replace(cfg, seeds=3))
    more = [Row(Job("flip", 6, order, 2), 4.0, 7.0, True) for order in ORDERS]
    monkeypatch.setattr(
        study, "run_all", lambda do, todo, *_: iter([replace(more[0], job=job) for job in todo])
    )
    assert orders.main(orders.Args(out=tmp_path)) == 0
    assert len(study.read(tmp_path / "orders.csv", Row)) == len(jobs(replace(cfg, seeds=3)))
    view = table([row for row in found if row.job.part == "flip"])
    cells = dict(
        zip(["", "T", *ORDERS, "steps"], (next(iter(each.cells)) for each in view.columns), strict=True)
    )
    assert cells["tails"] == "2 of 2: 0.50 ± 0.50"
    assert str(cells["uniform"]).startswith("0 of 2")
    assert "orders of the draws" in capsys.readouterr().out
