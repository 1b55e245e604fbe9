"""The comparison of controllers in a tiny setting: rules, tuning, every controller's run, what is written."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from rich.console import Console

from hmc.go2.network import Network
from hmc.go2.observe import anchor_of
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.go2.task import flip_task
from tests.test_flip import SHORT
from tools import study, table2
from tools.closed_loop import chosen, run, study_cfg
from tools.random_policy import write_random_policy
from tools.table2_study import (
    CONTROLLERS,
    FOOT,
    HAND,
    JUMP,
    Job,
    Row,
    Rule,
    Sequencer,
    Table2Cfg,
    controller,
    executed_costs,
    jobs,
    orders,
    sequences,
    told,
    tune,
    work,
)

FILE = table2.ROOT / "cfg" / "table2.toml"
TINY = (
    *(
        "trials=1",
        "tuning_seeds=[7]",
        "early=[3, 1]",
        "durations=[2, 4]",
        "thresholds=[-95.0, 30.0]",
        "untuned=2",
    ),
    *(
        "sampling.horizon=4",
        "sampling.knots=2",
        "sampling.samples=3",
        "sampling.worlds=3",
        "sampling.elites=2",
    ),
)


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> tuple[str, ...]:
    folder = tmp_path_factory.mktemp("policies")
    path = write_random_policy(folder / "random.onnx", hidden=(8,))
    one = write_random_policy(folder / "unified.onnx", hidden=(8,), mode="unified")
    flip = (*SHORT, f"task.foot={path}", f"task.hand={path}")
    return (*TINY, f"unified={one}", *(f"flip.{item}" for item in flip))


@pytest.fixture(scope="module")
def cfg(settings) -> Table2Cfg:
    return study_cfg(FILE, Table2Cfg, settings)


def test_rules_by_hand():
    """Pitch -90 in the foot stand, +90 in the handstand; the command comes at step 5."""
    rules = [Rule(2, 3), Rule(0, 2), Rule(1, threshold=0.0), Rule(-9, 3)]
    follow, seen = Sequencer(rules, 5), []
    for k in range(9):
        x = (FOOTSTAND if k < 7 else HANDSTAND).state().expand(4, -1)
        seen.append(follow(x, k).tolist())
    foot, jump, hand = FOOT, JUMP, HAND
    columns = list(zip(*seen, strict=True))
    assert columns[0] == (*[foot] * 3, *[jump] * 3, *[hand] * 3)
    assert columns[1] == (*[foot] * 5, *[jump] * 2, *[hand] * 2)
    assert columns[2] == (*[foot] * 4, *[jump] * 3, *[hand] * 2), "over the threshold from step 7 on"
    assert columns[3] == (foot,) * 9


def test_tuning_costs_are_those_of_a_run(cfg):
    """All rules at once in one simulator, or one by one in closed loop: the same cost."""
    rules = [Rule(3, 2), Rule(1, 4), Rule(2, threshold=-95.0)]
    costs = executed_costs(flip_task(cfg.flip.task, seed=7, threads=1), cfg.flip, rules, 7)
    for rule, cost in zip(rules, costs.tolist(), strict=True):
        task, follow = flip_task(cfg.flip.task, seed=7, threads=1), Sequencer([rule], cfg.flip.task.command)

        def choose(x: torch.Tensor, k: int, task=task, follow=follow) -> str:
            return str(task.modes.names[int(follow(x[None], k))])

        control = chosen(task.modes, choose)
        assert run(control, task.cost, cfg.flip, 7).cost == pytest.approx(cost, rel=1e-9)
    for rule in orders(cfg):
        control, task = controller(cfg, {"ppo": rule}, Job("ppo", 7))
        cost = tune(replace(cfg, tuning_seeds=(7,)), [rule], told(cfg))[1]
        assert run(control, task.cost, cfg.flip, 7).cost == pytest.approx(cost, rel=1e-9)
    best, cost = tune(cfg, rules)
    assert best == rules[int(costs.argmin())]
    assert cost == pytest.approx(float(costs.min()))


def test_one_policy_is_told_what_the_moment_wants(cfg):
    """The same network does something else from the command on, and nothing else does."""
    foot, hand = told(cfg)
    x = FOOTSTAND.state()[None]
    u, k = x[:, 7:19], torch.zeros(1, dtype=torch.long)
    acts = [mode.act(x, u, mode.reset(x, u, k), k)[0] for mode in (foot, hand)]
    assert not torch.equal(*acts)
    network = Network(cfg.unified)
    for action, wanted in zip(acts, (-1.0, 1.0), strict=True):
        expected = network.act(x.numpy(), u.numpy(), anchor_of(x).numpy(), np.array([[wanted]]))
        assert action.numpy() == pytest.approx(expected)
    control, _ = controller(cfg, {"ppo": Rule(2)}, Job("ppo", 7))
    told_at = [control(x[0], u[0], None).mode for _ in range(6)]
    command = cfg.flip.task.command
    assert told_at == ["told foot" if k < command - 2 else "told hand" for k in range(6)]


def test_bad_settings():
    with pytest.raises(
        ValueError, match=r"tuning_seeds \(101,\) must not be among the trials' own, 100 to 104"
    ):
        Table2Cfg(tuning_seeds=(101,))


def test_the_program(cfg, settings, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "run_all", lambda do, todo, *_: map(do, todo))
    assert table2.main(table2.Args(out=tmp_path, set=settings)) == 0
    found = json.loads((tmp_path / "table2.json").read_text(encoding="utf-8"))
    assert list(found) == list(CONTROLLERS)
    for values in found.values():
        assert (values["trials"], values["handstand"]) == (1, 0)
        assert math.isfinite(values["cost_mean"])
        assert values["cost_std"] == 0
    assert found["mppi"]["control_steps"] == 3 * 4, "a re-plan at every step"
    assert (
        found["untuned"]["control_steps"]
        <= found["sequence"]["control_steps"]
        < found["ours"]["control_steps"]
    )
    rows = study.read(tmp_path / "table2.csv", Row)
    assert [row.job for row in rows] == jobs(cfg)
    for name in ("visited", "modes", "cost"):
        assert (tmp_path / f"table2_{name}.png").stat().st_size > 0
    assert len((tmp_path / "table2.md").read_text(encoding="utf-8").splitlines()) == 2 + len(CONTROLLERS)
    assert CONTROLLERS["pitch"] in capsys.readouterr().out
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    rules = table2.tuned(cfg, folder / "rules.json", Console())
    assert rules["untuned"] == Rule(0, 2)
    kept, grids = dict(rules), list[int]()
    (folder / "rules.json").write_text(json.dumps({"pitch": asdict(rules["pitch"])}))

    def stops(_, grid, modes):
        grids.append(len(grid))
        if modes is not None:
            raise KeyboardInterrupt
        return kept["sequence"], 1.0

    monkeypatch.setattr(table2, "tune", stops)
    assert table2.main(table2.Args(out=tmp_path, set=settings)) == 1
    assert "stopped: the same command goes on from there" in capsys.readouterr().err
    assert grids == [len(sequences(cfg)), len(orders(cfg))], "that of the pitch was known"
    assert set(json.loads((folder / "rules.json").read_text())) == {"untuned", "sequence", "pitch"}
    again, _ = work(cfg, rules, Job("sequence", 100))
    before = next(row for row in rows if row.job == again.job)
    assert (again.cost, again.control_steps) == (before.cost, before.control_steps)
