"""The harder test in a tiny setting: whose robot meets what, what is written, and why a run failed."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from hmc.go2.conditions import NoiseCfg
from hmc.go2.stances import HANDSTAND
from tests.test_flip import SHORT
from tools import robustness, study
from tools.closed_loop import MODEL, study_cfg
from tools.random_policy import write_random_policy
from tools.robustness_study import Job, RobustnessCfg, Row, conditions_of, jobs, pushes_of, story

FILE = robustness.ROOT / "cfg" / "robustness.toml"
TINY = (
    *("trials=2", "sweep_trials=1", "seconds=0.2", "command=0.1", "foot_push=[0.02, 0.06]"),
    *("hand_push=[0.02, 0.06]", "ensemble.members=1"),
)


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> tuple[str, ...]:
    path = write_random_policy(tmp_path_factory.mktemp("policies") / "random.onnx", hidden=(8,))
    flip = (*SHORT, f"task.foot={path}", f"task.hand={path}")
    return (*TINY, *(f"flip.{item}" for item in flip))


@pytest.fixture(scope="module")
def cfg(settings) -> RobustnessCfg:
    return study_cfg(FILE, RobustnessCfg, settings)


def test_one_factor_at_a_time(cfg):
    """A sweep's robot is the planner's model but for its factor, whose name is one of the settings'."""
    assert {job.factor for job in jobs(cfg)} == {"all", *vars(cfg.sweep)}
    for job in jobs(cfg):
        found = conditions_of(cfg, job)
        if job.factor == "all":
            assert found == cfg.conditions
        elif job.factor == "push":
            assert found == replace(MODEL, push=job.value)
        elif job.factor == "noise":
            assert found.variants.nominal
            assert found.noise.velocity == pytest.approx(job.value * cfg.conditions.noise.velocity)
            assert found.noise.lasting == cfg.conditions.noise.lasting or job.value == 0
        else:
            assert found == replace(MODEL, variants=found.variants)
            values = vars(found.variants)
            assert [name for name, value in values.items() if value != vars(VARIANTS)[name]] == [job.factor]


VARIANTS = MODEL.variants


def test_pushes_come_within_their_windows_one_in_each_stance():
    cfg = study_cfg(FILE, RobustnessCfg, ())
    assert cfg.conditions.push == 0.5
    speeds = []
    for seed in range(200):
        (first, (speed, _)), (second, (other, direction)) = pushes_of(
            cfg, Job("nominal", "all", 0.0, seed)
        ).items()
        assert 0.4 <= first * 0.02 <= 1.2
        assert 1.2 <= second * 0.02 - cfg.command <= 2.2
        assert 0 <= direction <= 6.2832
        speeds += [speed, other]
    assert 0 <= min(speeds) < 0.05 < 0.45 < max(speeds) <= 0.5
    alone = pushes_of(cfg, Job("nominal", "push", 0.75, 3))
    assert [speed for speed, _ in alone.values()] == [0.75, 0.75]
    assert pushes_of(cfg, Job("nominal", "friction", 0.3, 3)) == {}


def test_the_program(cfg, settings, tmp_path, monkeypatch, capsys):
    few = [Job("nominal", "all", 0.0, 1), Job("ensemble", "all", 0.0, 1), Job("nominal", "latency", 0.01, 1)]
    monkeypatch.setattr(robustness, "jobs", lambda _: few)
    monkeypatch.setattr(study, "run_all", lambda do, todo, *_: map(do, todo))
    assert robustness.main(robustness.Args(out=tmp_path, set=settings)) == 0
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert (summary["trials"], summary["success_nominal"], summary["success_ensemble"]) == (1, 0, 0)
    assert summary["sweeps"] == {"latency": {"0.01": [0, 1]}}
    rows = study.read(tmp_path / "results.csv", Row)
    assert [row.job for row in rows] == few
    assert rows[1].control_steps > rows[0].control_steps, "two models"
    assert rows[0].story == summary["failures_nominal"]["1"] != ""
    assert (tmp_path / "sweeps.png").stat().st_size > 0
    assert "nominal seed 1: " in capsys.readouterr().out


def test_stories():
    x = HANDSTAND.state().repeat(101, 1)
    done = SimpleNamespace(x=x, modes=["hand"] * 100)
    assert story(done, {}) == "no fall; the handstand was held for 2.0 s"
    x = x.clone()
    x[60:, 2] -= 0.5
    done = SimpleNamespace(x=x, modes=["foot"] * 40 + ["hand"] * 60)
    assert story(done, {}) == "fell at 1.20 s in hand, pitch +90"
    pushed = story(done, {50: (0.4, torch.pi / 2)})
    assert pushed == "fell at 1.20 s in hand, pitch +90, 0.20 s after a push of 0.40 m/s towards 90 degrees"
    assert "push" not in story(done, {61: (0.4, 0.0)})


def test_scaled_noise():
    noise = NoiseCfg(lasting=0.3).scaled(2.0)
    assert noise == NoiseCfg(0.04, 0.04, 0.1, 0.2, 0.02, 0.6, lasting=0.3)
