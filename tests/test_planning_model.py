"""Coarser planning models: what differs between them, what is counted, and the program in a tiny setting."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from hmc.cfg import load
from hmc.go2.model import load_model
from hmc.sim.mujoco import MujocoSim
from tests.test_flip import SHORT
from tools import planning_model, study
from tools.closed_loop import RunCfg, study_cfg
from tools.planning_model import Job, ModelCfg, Row, StudyCfg, jobs, rolled_out, settings, speeds, table, work
from tools.random_policy import write_random_policy

MODELS = (
    ModelCfg("own"),
    ModelCfg("coarse", ("task.substeps=1", "task.iterations=1")),
    ModelCfg("feet", ("task.contacts=feet",)),
)


@pytest.fixture(scope="module")
def cfg(tmp_path_factory) -> StudyCfg:
    path = write_random_policy(tmp_path_factory.mktemp("policies") / "random.onnx", hidden=(8,))
    base = (*SHORT, "task.jump.mpc=false", f"task.foot={path}", f"task.hand={path}")
    made = StudyCfg(trials=2, first_seed=7, worlds=8, repeats=1, base=base, models=MODELS)
    return replace(made, flip=load(planning_model.ROOT / "cfg" / "flip.toml", RunCfg, base))


def test_the_committed_study_can_be_read():
    cfg = study_cfg(planning_model.ROOT / "cfg" / "planning_model.toml", StudyCfg, ())
    own, *others = (settings(cfg, model.name).task for model in cfg.models)
    assert (own.substeps, own.iterations, own.contacts) == (4, None, "all"), "ratios are to the robot's own"
    assert len({own, *others}) == len(cfg.models)
    assert len(jobs(cfg)) == len(set(jobs(cfg))) == cfg.trials * len(cfg.models)


def test_what_is_set_of_the_flip_holds_on_every_model():
    items = ("flip.start.joints=0.01",)
    cfg = study_cfg(planning_model.ROOT / "cfg" / "planning_model.toml", StudyCfg, items)
    assert {settings(cfg, model.name).start.joints for model in cfg.models} == {0.01}


def test_the_robot_stays_as_it_is(cfg, monkeypatch):
    """Worlds of one robot are its own; what is planned in has the model's settings."""
    made = []
    init = MujocoSim.__init__

    def note(self, model, num_worlds, **options):
        made.append((model.opt.timestep, model.opt.iterations, int((model.geom_conaffinity != 0).sum())))
        init(self, model, num_worlds, **options)

    monkeypatch.setattr(MujocoSim, "__init__", note)
    robot = load_model()
    whole = robot.opt.timestep, robot.opt.iterations, robot.ngeom - 1
    for name, planned in (("own", whole), ("coarse", (0.02, 1, whole[2])), ("feet", (*whole[:2], 4))):
        made.clear()
        work(cfg, Job(name, 7))
        assert set(made) == {whole, planned}, name


def test_speed_is_of_the_same_steps(cfg):
    """A fraction of the physics steps takes a fraction of the time, from snapshots of one engine."""
    steps = rolled_out(cfg)
    horizon = cfg.flip.task.horizon
    assert sum(len(u) for _, _, u in steps) <= cfg.worlds * horizon
    found = speeds(replace(cfg, repeats=5))
    assert found["own"] == 1.0
    assert found["coarse"] > 1.5


def test_a_table_by_hand(cfg):
    rows = [
        Row(Job(name, seed), True, True, seed != 8 or name == "own", float(seed), 10.0 * seed, 5.0)
        for name in ("own", "coarse", "feet")
        for seed in (7, 8)
    ]
    fast = {"own": 1.0, "coarse": 3.5, "feet": 1.1}
    cells = [list(column.cells) for column in table(cfg, rows, fast).columns]
    assert cells[1] == ["1.00", "3.50", "1.10"]
    assert cells[2] == ["2 of 2", "1 of 2", "1 of 2"]
    assert cells[5] == ["2", "1", "1"]
    assert cells[6] == ["7.50", "7.00", "7.00"], "cost is of the flips that succeed"


def test_the_program(cfg, tmp_path, monkeypatch, capsys):
    """Stopped after some runs it goes on with the others; nothing is measured twice."""
    done: list[Job] = []

    def some(do, todo, *_):
        first = not done
        for job in todo:
            if first and len(done) == 4:
                raise KeyboardInterrupt
            done.append(job)
            yield do(job)

    measured = []
    fast = dict.fromkeys(("own", "coarse", "feet"), 1.0)

    def timed(_):
        measured.append(1)
        return fast

    monkeypatch.setattr(planning_model, "speeds", timed)
    monkeypatch.setattr(study, "run_all", some)
    monkeypatch.setattr(planning_model, "study_cfg", lambda *_: cfg)
    args = planning_model.Args(out=tmp_path)
    assert planning_model.main(args) == 1
    assert len(done) == 4
    assert planning_model.main(args) == 0
    assert (sorted(done, key=str), measured) == (sorted(jobs(cfg), key=str), [1])
    assert [row.job for row in study.read(tmp_path / "planning_model.csv", Row)] == jobs(cfg)
    (speed,) = tmp_path.glob("*/speed.json")
    assert json.loads(speed.read_text(encoding="utf-8")) == fast
    assert "0 of 2" in capsys.readouterr().out
