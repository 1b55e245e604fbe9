"""Learning curves: when a run first comes to a success, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tiny import make_runner
from tools import curves
from tools.curves import Curves, reached
from train import ppo

STANCE = "/success/stance"


def test_when_a_level_is_first_reached():
    at = np.arange(5)
    lines = {
        STANCE: (at[1:], np.array([0.1, 0.92, 0.5, 0.95])),  # nothing was known of the first iteration
        "Perf/collection_time": (at, np.array([60.0, 30.0, 30.0, 1e6, 1e6])),
        "Perf/learning_time": (at, np.array([6.0, 6.0, 6.0, 1e6, 1e6])),
    }
    run = Curves("handstand", 500_000, lines)
    assert reached(run, STANCE, 0.9) == pytest.approx((1.5, (120 + 18) / 60))
    assert reached(run, STANCE, 0.96) is None


def test_steps_are_those_that_were_logged():
    """By other worlds after iteration 1, and by two processes; older logs do not say."""
    at = np.arange(4)
    counted = {curves.STEPS: (at[1:], np.array([3e6, 9e6, 15e6]))}
    assert Curves("walk", 500_000, counted).millions(at).tolist() == [0.5, 3.0, 9.0, 15.0]
    assert Curves("walk", 500_000, {}).millions(at).tolist() == [0.5, 1.0, 1.5, 2.0]


def test_a_run_logs_its_steps(tmp_path):
    folder = tmp_path / "run"
    runner = make_runner(folder)
    runner.last_iteration = 2
    runner.logger.tot_timesteps = 1000  # of an earlier start with other worlds
    ppo.train(runner, folder)
    assert curves.read(folder).lines[curves.STEPS][1].tolist() == [1048, 1096]


def test_no_runs(capsys):
    with pytest.raises(SystemExit):
        curves.main(curves.Args(()))
    assert "no runs are given" in capsys.readouterr().err


def test_the_program(tmp_path, capsys):
    runner = make_runner(tmp_path / "run")
    runner.last_iteration = 2
    ppo.train(runner, tmp_path / "run")
    curves.main(curves.Args((tmp_path / "run",) * 2, level=0.0, out=tmp_path / "new" / "curves.png"))
    said = capsys.readouterr().out.splitlines()
    assert (tmp_path / "new" / "curves.png").stat().st_size > 0
    first = [line for line in said if line.startswith("handstand, held from the stance 0: ")]
    assert len(first) == 2
    assert first[0].endswith("0.00 million steps, 0.0 minutes")
