"""The example of docs/planner.md does what it says, as it stands there."""

from __future__ import annotations

import hmc
from tools.search_figure import draw, example


def test_the_example_swings_up(tmp_path, capsys):
    names = example()
    plan, task = names["plan"], names["task"]
    assert plan.cost < 0.05 * plan.incumbent_cost
    sim = task.make_sim(1)
    end = hmc.Evaluator(task, sim, hmc.make_start(task, sim, [0.0, 0.0])).trace(plan.schedule).x[-1]
    assert abs(float(names["from_upright"](end[None])[0])) < 0.1, "upright"
    assert abs(float(end[1])) < 0.5, "and nearly at rest"
    assert set(plan.schedule.names) == {"pump", "balance"}
    assert "of 22,650 switches" in capsys.readouterr().out
    draw(plan, tmp_path / "search.png")
    assert (tmp_path / "search.png").stat().st_size > 5000
