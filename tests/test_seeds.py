"""Training seeds as a study: stopped in the middle, gone on with, and nothing learned or counted twice."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hmc.go2.network import Network
from tools import seeds, study
from tools.random_policy import write_random_policy
from tools.seeds import Args, Row
from train.env import Go2Env
from train.runner import read_checkpoint

WORLDS, STEPS, ITERATIONS = 8, 6, 3
TINY = (
    *(f"env.worlds={WORLDS}", "env.episode_steps=20", f"ppo.iterations={ITERATIONS}", f"ppo.steps={STEPS}"),
    *("ppo.epochs=1", "ppo.minibatches=2", "ppo.hidden=[16, 8]"),
)


@pytest.fixture
def trained(tmp_path, monkeypatch) -> Callable[..., tuple[int, int]]:
    """Runs the program, here instead of in processes; what it returns, and steps of environments it made.

    Policies are not the learned ones, which take seconds to export.
    """
    step, made = Go2Env.step, [0]
    monkeypatch.setattr(seeds, "export", lambda _, out: write_random_policy(out, hidden=(4,)))
    monkeypatch.setattr(study, "run_all", lambda do, todo, *_: map(do, todo))

    def run(stop: int = -1, **changed: Any) -> tuple[int, int]:
        made[0] = 0

        def counted(env: Go2Env, actions: Any) -> Any:
            if made[0] == stop:
                raise KeyboardInterrupt
            made[0] += 1
            return step(env, actions)

        monkeypatch.setattr(Go2Env, "step", counted)
        return seeds.main(Args(**{"seeds": 2, "episodes": 2, "out": tmp_path, "set": TINY, **changed})), made[
            0
        ]

    return run


def test_stopped_and_gone_on_with(trained, tmp_path, capsys):
    whole = STEPS * ITERATIONS
    assert trained(stop=whole + STEPS + 2) == (1, whole + STEPS + 2), "in the second seed's second iteration"
    assert "stopped with 1 of 2 done: the same command goes on from there" in capsys.readouterr().out
    assert list(json.loads((tmp_path / "seeds.json").read_text())["seeds"]) == ["1"], "what there is so far"
    assert [row.job.seed for row in study.read(tmp_path / "seeds.csv", Row)] == [1]
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert read_checkpoint(folder / "seed_2" / "latest.pt")["iter"] == 0

    assert trained() == (0, 2 * STEPS), "the rest of the second seed alone"
    rows = study.read(tmp_path / "seeds.csv", Row)
    assert [row.job.seed for row in rows] == [1, 2]
    assert [row.environment_steps for row in rows] == [whole * WORLDS] * 2
    summary = json.loads((tmp_path / "seeds.json").read_text())
    assert summary["success_mean"] == sum(row.success for row in rows) / 4
    assert 0 == summary["success_min"] < summary["seeds"]["2"]["high"] < 1
    for row in rows:
        name = f"seed_{row.job.seed}"
        meta = read_checkpoint(folder / name / "latest.pt")["infos"]["meta"]
        assert meta["seed"] == str(row.job.seed)
        assert meta["command"].startswith("python train/ppo.py --mode=handstand --engine=mujoco --threads=1")
        assert Network(folder / f"{name}.onnx").mode == "handstand"
        curve = seeds.curve_of(folder, row)
        assert curve.batch == WORLDS * STEPS
        assert curve.title == f"handstand, seed {row.job.seed}"
        assert curve.lines["/success/stance"][0].tolist() == list(range(ITERATIONS)), "each iteration once"
    assert (tmp_path / "curves.png").stat().st_size > 0

    assert trained() == (0, 0), "nothing is left to do"
    assert study.read(tmp_path / "seeds.csv", Row) == rows
    assert trained(seeds=1, resume=False) == (0, whole), "anew"


def refused(capsys: pytest.CaptureFixture[str], **given: Any) -> str:
    with pytest.raises(SystemExit) as ended:
        seeds.main(Args(**given))
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_bad_input_is_one_line(capsys, tmp_path: Path):
    line = refused(capsys, mode="handstnd", out=tmp_path)
    assert "unknown mode 'handstnd': expected one of handstand, footstand, stand, getup, walk" in line
    assert line.endswith("did you mean 'handstand'?")
    assert "seeds must be at least 1, got 0" in refused(capsys, seeds=0, out=tmp_path)
    assert "episodes must be at least 1, got -3" in refused(capsys, episodes=-3, out=tmp_path)
    assert "unknown key env.wrlds; did you mean worlds?" in refused(
        capsys, set=("env.wrlds=2",), out=tmp_path
    )
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    line = refused(capsys, out=tmp_path / "file" / "seeds")
    assert "cannot write into" in line
    assert "choose another folder with --out" in line
