"""The examples of the documents do what they say, as they stand there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

import hmc
from tools import search_figure
from tools.figures import search
from tools.random_policy import write_random_policy
from tools.search_figure import example


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
    search(tmp_path / "search.png", plan)
    assert (tmp_path / "search.png").stat().st_size > 5000


def test_where_no_picture_can_be_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(search_figure, "example", dict)
    with pytest.raises(SystemExit) as ended:
        search_figure.main(search_figure.Args(tmp_path))
    assert ended.value.code == 2
    assert (
        capsys.readouterr().err == f"error: cannot write {tmp_path} (it is a folder): choose another file\n"
    )


def test_a_policy_of_ones_own(tmp_path):
    """The class of docs/own_robot.md, around a network of two layers that takes state and input."""
    text = Path("docs/own_robot.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(code, names)
    path = write_random_policy(tmp_path / "policy.onnx", hidden=(4,))
    mode = names["MyPolicy"]("mine", str(path))
    x, u = torch.randn(5, 36, dtype=torch.float64), torch.randn(5, 12, dtype=torch.float64)
    action, memory = mode.act(x, u, mode.reset(x, u, torch.zeros(5)), torch.zeros(5))
    assert (mode.name, action.shape, action.dtype, memory.shape) == ("mine", (5, 12), torch.float64, (5, 0))
    one, _ = mode.act(x[2:3], u[2:3], memory[2:3], torch.zeros(1))
    assert torch.equal(one, action[2:3])
