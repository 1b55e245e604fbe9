"""The estimators' study: stopped in the middle and gone on with, no log twice; refusals in a line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest

from tools import cartpole, estimator_study, growth, robustness, seeds, study, table2
from tools.estimator_study import Args, StudyCfg, jobs
from tools.estimators.measure import Job, Score

STUDIES = (cartpole, estimator_study, growth, robustness, seeds, table2)


def test_stopped_and_gone_on_with(tmp_path, monkeypatch, capsys):
    made: list[Job] = []

    def here(work: Callable[[Job], Score], todo: Sequence[Job], *_: Any) -> Iterator[Score]:
        for job in todo:
            if len(made) == 2:
                made.append(job)
                raise KeyboardInterrupt
            made.append(job)
            yield work(job)

    monkeypatch.setattr(study, "run_all", here)
    monkeypatch.setattr(estimator_study, "draw", lambda *given: None)
    args = Args(seeds=2, seconds=1.5, motions=("stand",), filters=("ours", "cheetah"), out=tmp_path)
    assert estimator_study.main(args) == 1
    assert "stopped with 2 of 4 done" in capsys.readouterr().out
    assert estimator_study.main(args) == 0
    todo = jobs(args)
    assert made == [*todo[:3], *todo[2:]], "the third one, which was stopped, again"
    scores = study.read(tmp_path / "scores.csv", Score)
    assert [score.job for score in scores] == todo
    again = estimator_study.work(StudyCfg(), todo[0])
    assert (again.velocity, again.nees_biases) == (scores[0].velocity, scores[0].nees_biases)
    ours, cheetah = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert ours["seeds"] == cheetah["seeds"] == 2
    assert 0 < ours["velocity"] < cheetah["velocity"]
    assert "nees_velocity" in ours
    assert "nees_velocity" not in cheetah


def test_a_motion_that_is_given_twice(tmp_path, monkeypatch):
    """Is no second robot."""
    monkeypatch.setattr(study, "run_all", lambda work, todo, *_: map(work, todo))
    args = Args(seeds=1, seconds=1.1, motions=("stand", "stand"), filters=("ours",), out=tmp_path)
    assert estimator_study.main(args) == 0
    (row,) = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert row["seeds"] == 1


def test_a_motion_that_is_not_there(tmp_path, capsys):
    with pytest.raises(SystemExit):
        estimator_study.main(Args(motions=("swim",), out=tmp_path))
    assert capsys.readouterr().err.startswith("error: 'swim': expected one of ")


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"first_seed": -1}, "first_seed must be at least 0, got -1"),
        (
            {"seconds": 1.01},
            "seconds must be at least 1.1, of which no figure counts in the first 1, got 1.01",
        ),
        ({"seconds": math.inf}, "seconds must be at least 1.1"),
        ({"filters": ()}, "--motions and --filters take one or more each"),
    ],
)
def test_nothing_to_measure(tmp_path, capsys, given, line):
    with pytest.raises(SystemExit):
        estimator_study.main(Args(**given, out=tmp_path))
    assert line in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", STUDIES, ids=lambda module: module.__name__)
def test_every_study_takes_ray_and_goes_on(module):
    args = module.Args()
    assert isinstance(args, study.Workers)
    assert args.resume
    assert args.ray is None
