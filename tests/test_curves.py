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
