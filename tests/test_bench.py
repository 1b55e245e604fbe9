"""Benchmarks in a tiny setting: the figures have their names, are finite, and reach the file whole."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.tiny import CFG, make_env, make_runner
from tools.bench import main
from tools.benchmarks import learning
from tools.benchmarks.deployed import Deployed
from tools.benchmarks.engine import Engine
from tools.benchmarks.estimator import Estimator
from tools.benchmarks.figures import AT_LEAST, AT_MOST, Common, Figures
from tools.benchmarks.gpu import Gpu
from tools.benchmarks.growth import Growth
from tools.benchmarks.planner import Planner
from tools.benchmarks.train import Train
from tools.benchmarks.wire import Wire
from tools.random_policy import write_random_policy
from train import ppo
from train.runner import read_checkpoint

SMALL = {
    "engine": (
        Engine(threads=1, worlds=4, steps=2, repeats=2),
        {
            "sim_open_loop_efficiency",
            "sim_open_loop_steps_per_s",
            "sim_open_loop_bare_steps_per_s",
            "sim_open_loop_us_per_step",
            "sim_policy_efficiency",
            "sim_policy_steps_per_s",
        },
    ),
    "train": (
        Train(
            threads=1,
            warm_up=1,
            iterations=2,
            set=("env.worlds=8", "ppo.steps=4", "ppo.hidden=[16]", "ppo.minibatches=2"),
        ),
        {"train_steps_per_s", "collect_share", "physics_share", "learn_share"},
    ),
    "planner": (
        Planner(threads=1, horizon=6, cartpole_horizon=10, samples=16, few=4, ticks=1, repeats=1),
        {"us_per_candidate", "cartpole_exact_ms", "cartpole_converged_ms"},
    ),
    "gpu": (
        Gpu(threads=1),
        {
            "step_4_efficiency",
            "step_4_bare_steps_per_s",
            "arrays_4_kb",
            "env_4_efficiency",
            "train_4_steps_per_s",
            "train_4_minutes",
            "train_4_msteps",
            "exact_t3_ms",
            "exact_t3_efficiency",
            "exact_t3_candidates_per_s",
            "exact_t3_c1_ms",
            "batch_2_ms",
            "batch_2_c1_ms",
            "mppi_4x6_ms",
        },
    ),
    "growth": (
        Growth(threads=1, horizons=(3, 4), modes=(2,), samples=(4,), worlds=(2,), repeats=1),
        {
            *("exact_t3_control_steps", "exact_t4_ms", "exact_m2_ms", "batch_4_ms"),
            "worlds_2_steps_per_s",
        },
    ),
    "wire": (
        Wire(threads=1, repeats=20, messages=20),
        {"crc_us", "state_decode_us", "robot_share", "round_trip_ms_p50", "answered"},
    ),
    "deployed": (
        Deployed(threads=1, seconds=0.2, plans=1),
        {"frame_share", "tick_us", *(f"plan_{name}_ms" for name in ("wait", "first", "search", "hand"))},
    ),
    "estimator": (
        Estimator(threads=1, seconds=1.0, repeats=1),
        {"estimator_step_us", "estimator_ahead_us", "estimator_step_four_us", "estimator_ahead_four_us"},
    ),
}


@pytest.mark.parametrize("name", SMALL)
def test_figures(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if name in ("wire", "deployed"):
        pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")
    if name == "gpu" and torch.cuda.is_available():
        pytest.skip("sizes for Warp's CPU device, and there is a GPU")
    args, expected = SMALL[name]
    out = tmp_path / "new" / "figures.json"
    if name == "planner":  # with policies that have learned nothing, so that the Go2's part runs everywhere
        policy = write_random_policy(tmp_path / "random.onnx", hidden=(8,))
        names = (
            f'task.foot="{policy}"',
            f'task.hand="{policy}"',
            "task.horizon=8",
            "search.control_steps=16",
        )
        small = (
            "task.jump.sampling.samples=2",
            "task.jump.sampling.horizon=20",
            "task.jump.sampling.worlds=4",
        )
        args = Planner(**{**vars(args), "set": names + small})
        expected = expected | {"shared_fraction", "pruned_fraction", "mppi_overhead"}
        expected = expected | {"policy_efficiency", "open_loop_efficiency"}
        expected = expected | {"policy_few_efficiency", "open_loop_few_efficiency"}
        expected = expected | {"go2_tick_ms_p50", "go2_tick_ms_p99", "go2_control_steps_fraction"}
        expected = expected | {"ensemble_3_fraction", "ensemble_5_fraction"}

    if name == "gpu":  # beside a run of another engine
        runner = make_runner(tmp_path / "cpu")
        runner.last_iteration = 1
        ppo.train(runner, tmp_path / "cpu")
        args = Gpu(**{**vars(args), "out": tmp_path / "runs", "cpu": tmp_path / "cpu"})
        expected = expected | {"train_cpu_minutes", "train_cpu_msteps"}

    assert main(type(args)(**{**vars(args), "json": out})) == 0

    written = json.loads(out.read_text())
    assert expected <= set(written)
    figures = {key: value for key, value in written.items() if isinstance(value, float)}
    assert all(math.isfinite(value) and value > 0 for value in figures.values()), figures
    assert {"cpu", "cores", "threads", "torch", "mujoco"} <= set(written["machine"])
    assert [path.name for path in out.parent.iterdir()] == ["figures.json"]
    said = " ".join(capsys.readouterr().out.split())
    assert f"bench {name}" in said
    if name == "growth":  # the incumbent, and from each start the tails of each duration
        assert written["exact_t4_control_steps"] == 4 + 2 * (4 + 3 * 2 + 2 * 3 + 1 * 4)
    if name == "gpu":
        assert "there is only cpu" in said
        assert "what ran instead is a tiny size on Warp's CPU device" in said
        targets = {name for name in (*AT_LEAST, *AT_MOST) if re.search(r"_(4096|8192|t75)", name)}
        missing = {name for name, value in written.items() if value == "not measured"}
        assert len(targets) == 6
        assert (tmp_path / "runs" / "learning.png").stat().st_size > 0
        assert targets | {"step_8192_bare_steps_per_s", "crossover_c1_switches"} <= missing
        assert said.count("not measured") == len(missing)


@pytest.mark.parametrize(("level", "iterations"), [(0.0, 1), (1.1, 3)])
def test_training_ends_with_its_success(level: float, iterations: int, tmp_path: Path) -> None:
    """Or with its last iteration; a run that was there before does not count."""
    cfg = replace(CFG, ppo=replace(CFG.ppo, iterations=3))
    for _ in range(2):
        run = learning.train_until(level, cfg, make_env(), tmp_path / "run", ["--mode", "handstand"])
    assert read_checkpoint(tmp_path / "run" / "latest.pt")["iter"] == iterations - 1
    assert run.lines[learning.TAG][0].tolist() == list(range(iterations))
    figures = Figures()
    learning.tell(figures, "train", run, level)
    if level > 1:
        assert figures.notes == {"train_minutes": "train: 110% held from the stance was not reached"}
        return
    assert figures.values["train_msteps"] == pytest.approx(run.batch / 1e6)
    assert 0 < figures.values["train_minutes"] < 1


def test_a_share_of_the_time_is_a_share(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    args, _ = SMALL["train"]
    main(Train(**{**vars(args), "json": out}))
    found = json.loads(out.read_text())
    assert found["physics_share"] <= found["collect_share"]
    assert found["collect_share"] + found["learn_share"] <= 1.0


def test_targets_are_printed_as_met_or_not() -> None:
    figures = Figures()
    figures.add("policy_efficiency", 0.81, "of which [us]")
    figures.add("open_loop_efficiency", 0.5, "")
    figures.add("us_per_candidate", 1.9, "")
    figures.add("shared_fraction", 0.31, "")
    cells = [[str(cell) for cell in column.cells] for column in figures.table("bench").columns]
    assert ["not met" in text for text in cells[2]] == [False, True, False, True]
    assert "us" in cells[3][0]


@pytest.mark.parametrize(
    ("kind", "given", "line"),
    [
        (Engine, {"steps": 0}, "steps must be at least 1, got 0"),
        (Engine, {"repeats": 0}, "repeats must be at least 1, got 0"),
        (Engine, {"threads": -1}, "threads must be at least 0, got -1"),
        (Train, {"iterations": 0}, "iterations must be at least 1, got 0"),
        (Growth, {"horizons": ()}, "horizons must be at least 1, got none"),
        (Growth, {"samples": (4, 0)}, r"samples must be at least 1, got \(4, 0\)"),
    ],
)
def test_nothing_to_measure(kind: type[Common], given: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        kind(**given)


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (Engine(json=Path()), "cannot write . (it is a folder): choose another file"),
        (
            Engine(threads=1, worlds=2, steps=1, repeats=1, policy=Path("none.onnx")),
            "none.onnx: no such file",
        ),
        (Train(mode="sit"), "sit.toml: no such file"),
        (Planner(threads=1, horizon=3, cartpole_horizon=3, seeds=1, set=("tsak=1",)), "unknown key tsak"),
        (
            Growth(threads=1, horizons=(3,), samples=(19,)),
            "samples must be at most 18, all switches of T 3, M 3",
        ),
        (Gpu(tiny=False, horizon=3), "batches must be at most 18, all switches of T 3, M 3, got 4096"),
        (Estimator(seconds=0.5), "seconds must be at least 1, since it begins with a stand, got 0.5"),
        (Deployed(seconds=0.01), "seconds must be at least 0.1, or there is no tick in them, got 0.01"),
    ],
    ids=["folder", "policy", "mode", "set", "samples", "batches", "estimator", "deployed"],
)
def test_what_cannot_be_measured_is_a_line(args: Any, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(args)
    assert ended.value.code == 2
    assert line in capsys.readouterr().err


def test_threads_default_to_all_cores() -> None:
    assert Common().threads == 0
