"""The picture of a search: every switch's cost at its place, and a run's log read back."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from hmc import Evaluator, Schedule, Switch, make_start
from tests.toy import slow_cost, toy_task
from tools.landscape import draw, landscape, parse, read

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
    assert sum(found.terms[0].values()) == pytest.approx(found.cost)
    draw(tmp_path / "picture.png", found, "toy")
    assert (tmp_path / "picture.png").stat().st_size > 5000


def test_a_compact_line_is_read_back():
    schedule = Schedule((0, 0, 0, 1, 2, 2), NAMES)
    assert parse(str(schedule), NAMES) == schedule


def test_steps_that_cannot_be_shown(tmp_path):
    log = tmp_path / "seed_0.json"
    steps = [{"mode": mode, "u": [0.0]} for mode in ("foot", "jump", "hand", "hand")]
    log.write_text(json.dumps({"steps": steps}))
    assert read(log, 3)["before"]["mode"] == "hand"
    with pytest.raises(ValueError, match="has steps 0 to 3, got --step 4"):
        read(log, 4)
    for step in (1, 2):
        with pytest.raises(ValueError, match=f"step {step} is in the jump"):
            read(log, step)
