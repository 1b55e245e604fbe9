"""Training: iterations run, checkpoints hold everything, and what the user gets wrong is one line."""

from __future__ import annotations

import json
import math
import os
import random
import re
import subprocess
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hmc.cli import one_line_errors
from tests.tiny import CFG, make_runner
from tools.random_policy import write_random_policy
from tools.render import EVERY, strip_steps
from train import play, ppo
from train.config import read_training, rsl_config
from train.runner import read_checkpoint
from train.starts import Starts
from train.unified import UnifiedCfg


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Two iterations: the folder and the runner."""
    torch.manual_seed(3)
    folder = tmp_path_factory.mktemp("run")
    runner = make_runner(folder)
    before = {key: value.clone() for key, value in runner.alg.actor.state_dict().items()}
    runner.last_iteration = 2
    ppo.train(runner, folder)
    return folder, runner, before


def test_two_iterations(trained):
    folder, runner, before = trained
    assert runner.updates == 2
    assert runner.logger.tot_timesteps == 2 * 6 * 8
    after = runner.alg.actor.state_dict()
    assert any(not torch.equal(after[key], before[key]) for key in after)
    assert all(value.isfinite().all() for value in after.values())
    names = {path.name for path in folder.iterdir()}
    assert {"latest.pt", "model_0.pt", "model_1.pt"} <= names
    assert not [name for name in names if "partial" in name]
    (events,) = folder.glob("events.out.tfevents*")
    assert not [thread for thread in threading.enumerate() if "_AsyncWriter" in type(thread).__name__]
    log = EventAccumulator(str(events)).Reload()
    assert [entry.step for entry in log.Scalars("Loss/learning_rate")] == [0, 1], "to the last iteration"


def test_the_learning_rate_falls_at_the_end(tmp_path):
    runner = make_runner(tmp_path)
    runner.last_iteration, runner.anneal = 200, 0.25
    full = runner.cfg["algorithm"]["learning_rate"]
    for iteration, share in [(0, 1.0), (150, 1.0), (175, 0.5), (190, 0.2), (200, 0.01)]:
        runner.set_learning_rate(iteration)
        assert runner.alg.learning_rate == pytest.approx(share * full)
        assert [g["lr"] for g in runner.alg.optimizer.param_groups] == [runner.alg.learning_rate]


def test_the_noise_falls_or_is_learned(tmp_path):
    cfg = replace(CFG, ppo=replace(CFG.ppo, init_std=0.8, final_std=0.1))
    runner = make_runner(tmp_path, cfg)
    runner.last_iteration, runner.final_std, runner.settle = 200, 0.1, 0.5
    for iteration, std in ((0, 0.8), (100, 0.8), (150, math.sqrt(0.08)), (200, 0.1), (250, 0.1)):
        runner.set_noise(iteration)
        found = runner.alg.actor.distribution.log_std_param
        torch.testing.assert_close(found.exp(), torch.full((12,), std))
        assert not found.requires_grad
    learned = make_runner(tmp_path)
    before = learned.alg.actor.distribution.log_std_param.clone()
    learned.set_noise(150)
    assert torch.equal(learned.alg.actor.distribution.log_std_param, before), "its own to learn"


def test_a_checkpoint_says_how_it_was_made(trained):
    folder, *_ = trained
    infos = read_checkpoint(folder / "latest.pt")["infos"]
    assert infos["meta"]["seed"] == "7"
    assert json.loads(infos["meta"]["config"])["ppo"]["steps"] == 6
    assert infos["steps"] == 96


def test_resume_goes_on_where_it_was(trained):
    folder, runner, _ = trained
    starts = runner.env.starts
    assert isinstance(starts, Starts)
    starts.success[3, 2] = 0.4
    runner.env.starts.rates[0] = 0.7
    runner.save(str(folder / "model_1.pt"))
    expected = torch.rand(3), np.random.rand(), random.random()  # noqa: NPY002
    torch.manual_seed(99)
    other = make_runner(folder)
    other.resume(str(folder / "latest.pt"))
    assert other.current_learning_iteration == 2
    assert other.logger.tot_timesteps == 96
    assert isinstance(other.env.starts, Starts)
    assert torch.equal(other.env.starts.success, starts.success)
    assert torch.equal(other.env.starts.rates, runner.env.starts.rates)
    for ours, theirs in ((other.alg.actor, runner.alg.actor), (other.alg.critic, runner.alg.critic)):
        theirs = theirs.state_dict()
        assert all(torch.equal(value, theirs[key]) for key, value in ours.state_dict().items())
    drawn = torch.rand(3), np.random.rand(), random.random()  # noqa: NPY002
    assert torch.equal(drawn[0], expected[0])
    assert drawn[1:] == expected[1:]
    other.last_iteration = 3
    ppo.train(other, folder)
    assert other.updates == 1
    assert read_checkpoint(folder / "latest.pt")["iter"] == 2


def test_a_stage_begins_with_what_was_learned(trained, tmp_path):
    """Networks and curriculum, not the optimiser's moments nor the count of iterations."""
    folder, runner, _ = trained
    runner.env.starts.rates[0] = 0.7
    runner.save(str(folder / "model_1.pt"))
    other = make_runner(tmp_path)
    other.begin_with(str(folder / "latest.pt"))
    assert other.current_learning_iteration == 0
    assert other.logger.tot_timesteps == 96, "of all stages"
    assert torch.equal(other.env.starts.rates, runner.env.starts.rates)
    theirs = runner.alg.actor.state_dict()
    assert all(torch.equal(value, theirs[key]) for key, value in other.alg.actor.state_dict().items())
    assert not other.alg.optimizer.state_dict()["state"]


def test_the_same_seed_learns_the_same(tmp_path):
    weights = []
    for name in ("a", "b"):
        torch.manual_seed(11)
        runner = make_runner(tmp_path / name)
        runner.last_iteration = 1
        ppo.train(runner, tmp_path / name)
        weights.append(runner.alg.actor.state_dict())
    assert all(torch.equal(value, weights[1][key]) for key, value in weights[0].items())


def test_deterministic_is_asked_of_torch(tmp_path, monkeypatch):
    """Which the engine follows; operations that have no such version only warn."""
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", "")
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG")
    args = ppo.Args("handstand", engine="mujoco", threads=1, out=tmp_path, set=("env.worlds=2",))
    ppo.set_up(args, [])
    assert not torch.are_deterministic_algorithms_enabled()
    try:
        ppo.set_up(replace(args, deterministic=True), [])
        assert torch.are_deterministic_algorithms_enabled()
        assert torch.is_deterministic_algorithms_warn_only_enabled()
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
    finally:
        torch.use_deterministic_algorithms(False)


def test_nothing_left_to_do(trained, capsys):
    folder, *_ = trained
    runner = make_runner(folder)
    runner.resume(str(folder / "model_1.pt"))
    runner.last_iteration = 2
    ppo.train(runner, folder)
    assert "2 iterations are done already: ask for more with --iterations" in capsys.readouterr().out
    assert runner.updates == 0


@pytest.mark.parametrize(("steps", "done"), [(3, 0), (8, 1)])
def test_ctrl_c_leaves_a_checkpoint(tmp_path, monkeypatch, capsys, steps, done):
    """What was learned so far is kept; nothing is written where that is nothing."""
    runner = make_runner(tmp_path)
    runner.last_iteration = 5
    step, count = runner.env.step, iter(range(1000))

    def interrupted(actions):
        if next(count) == steps:
            raise KeyboardInterrupt
        return step(actions)

    monkeypatch.setattr(runner.env, "step", interrupted)
    ppo.train(runner, tmp_path)
    assert (tmp_path / "latest.pt").exists() == bool(done)
    assert ("go on with --resume" if done else "nothing was learned yet") in capsys.readouterr().out
    if done:
        other = make_runner(tmp_path)
        other.resume(str(tmp_path / "latest.pt"))
        assert other.current_learning_iteration == done


def test_an_interrupted_save_leaves_the_old_file(trained, monkeypatch):
    folder, runner, _ = trained
    before = (folder / "latest.pt").read_bytes()

    def cut_short(data, path):
        with open(path, "wb") as file:
            file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", cut_short)
    with pytest.raises(KeyboardInterrupt):
        runner.save(str(folder / "model_9.pt"))
    assert (folder / "latest.pt").read_bytes() == before
    assert not (folder / "model_9.pt").exists()


def test_a_checkpoint_that_cannot_be_read(trained, tmp_path):
    folder, *_ = trained
    with pytest.raises(ValueError, match=r"checkpoint .*gone\.pt: no such file"):
        read_checkpoint(tmp_path / "gone.pt")
    data = (folder / "model_1.pt").read_bytes()
    for size in (0, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "short.pt").write_bytes(data[:size])
        with pytest.raises(
            ValueError, match=rf"short\.pt: cannot be read .*{size} bytes.*resume from an older"
        ):
            read_checkpoint(tmp_path / "short.pt")
    torch.save({"weights": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match=r"other\.pt: lacks actor_state_dict, .* written by train/ppo\.py"):
        read_checkpoint(tmp_path / "other.pt")


def refused(capsys, **given) -> str:
    """The one line with which setting up a training run ends."""
    with pytest.raises(SystemExit) as ended:
        ppo.main(ppo.Args("handstand", threads=1, **{"set": ("env.worlds=2",), **given}))
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_bad_input_is_one_line(capsys, tmp_path):
    assert "unknown key env.wrlds; did you mean worlds?" in refused(capsys, set=("env.wrlds=2",))
    assert "device cuda:63 does not exist" in refused(capsys, device="cuda:63")
    assert "unknown device 'gpu'" in refused(capsys, device="gpu")
    if not torch.cuda.is_available():
        line = refused(capsys, engine="warp")
        assert "engine warp wants a GPU and there is only cpu" in line
        assert "take engine mujoco" in line
    assert "latest.pt: no such file" in refused(capsys, resume=True, out=tmp_path)
    assert "gone.pt: no such file" in refused(capsys, checkpoint=tmp_path / "gone.pt", out=tmp_path)
    assert "gone.pt: no such file" in refused(capsys, play=tmp_path / "gone.pt", out=tmp_path)
    line = refused(capsys, stage="finer")
    assert "handstand_finer.toml: no such file" in line
    assert "handstand_robust.toml" in line
    line = refused(capsys, stage="robust", checkpoint=tmp_path / "gone.pt", set=("env.worlds=2",))
    assert "gone.pt: no such file" in line
    assert not list(tmp_path.iterdir())


def test_play_wants_its_own_mode(trained, capsys):
    folder, *_ = trained
    with pytest.raises(SystemExit):
        ppo.main(ppo.Args("footstand", play=folder / "model_1.pt"))
    assert "trained for handstand, not for footstand" in capsys.readouterr().err


def test_play(trained, tmp_path, monkeypatch):
    """An episode of the policy as it would be exported, recorded and drawn by another program."""
    folder, *_ = trained
    drawn = []

    def draw(command, **_):
        drawn.append(command[1:])
        return subprocess.CompletedProcess(command, 0, "no video: OpenGL is missing here\n", "")

    monkeypatch.setattr(play, "export", lambda _, out: write_random_policy(out, hidden=(4,)))
    monkeypatch.setattr("train.play.subprocess.run", draw)
    said = play.play(folder / "model_1.pt", "handstand", tmp_path, seconds=0.2, threads=1).splitlines()
    assert said[0].startswith("handstand: held for ")
    assert said[1] == "no video: OpenGL is missing here"
    steps = json.loads((tmp_path / "play.json").read_text(encoding="utf-8"))["steps"]
    assert len(steps) == 10
    assert all(step["mode"] == "handstand" and len(step["x"]) == 37 for step in steps)
    assert drawn == [[str(play.RENDER), str(tmp_path / "play.json")]]
    assert play.RENDER.is_file()


def test_pictures_of_a_strip():
    flip = ["foot"] * 40 + ["jump"] * 10 + ["hand"] * 50
    assert strip_steps(flip, 9)[0] == 40 - 6 // EVERY
    assert len(strip_steps(flip, 9)) == 9
    assert max(strip_steps(flip[:45], 9)) == 44
    assert strip_steps(["handstand"] * 101, 5) == [0, 25, 50, 75, 100]
    assert strip_steps(["getup"] * 50 + ["foot"] * 51, 5) == [0, 25, 50, 75, 100]


@pytest.mark.parametrize(
    "words",
    [
        "CUDA out of memory. Tried to allocate 2 GiB",
        "Failed to allocate 64 bytes on device 'cuda:0'",
        "other",
    ],
)
def test_memory_that_is_used_up(tmp_path, monkeypatch, words):
    """What learning takes is known only then; other errors stay what they are."""
    runner = make_runner(tmp_path)
    runner.last_iteration = 1

    def used_up(actions):
        raise RuntimeError(words)

    monkeypatch.setattr(runner.env, "step", used_up)
    if words == "other":
        with pytest.raises(RuntimeError, match="other"):
            ppo.train(runner, tmp_path)
        return
    with pytest.raises(
        SystemExit, match=r"^error: cpu has no memory left for 8 worlds .* env\.worlds=4, with"
    ):
        ppo.train(runner, tmp_path)


def test_what_trains_is_said(capsys, monkeypatch, tmp_path):
    """And why it is the CPU's, where nobody asked for that."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(ppo, "set_up", lambda args: make_runner(tmp_path))
    monkeypatch.setattr(ppo, "train", lambda runner, folder: None)
    for given, rest in (
        ({}, r": there is only cpu \(.*\)"),
        ({"engine": "mujoco"}, ""),
        ({"device": "cpu"}, ""),
    ):
        ppo.main(ppo.Args("handstand", **given))
        said = capsys.readouterr().out.strip()
        assert re.fullmatch("engine mujoco, 8 worlds on cpu" + rest, said)


def test_torchrun_without_a_gpu(capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "torchrun starts one process a GPU and there is none here" in refused(capsys)


def test_experiment_files():
    kinds = ("stance", "way", "home", "recorded", "standing", "fallen", "stances")
    stances = ("handstand", "footstand", "handstand_robust", "footstand_robust")
    for name in (*stances, "stand", "getup", "walk", "unified"):
        cfg = read_training(mode := name.removesuffix("_robust"), name)
        assert cfg.env.mode == mode
        env = cfg.env
        for starts in (env.footstand, env.handstand) if isinstance(env, UnifiedCfg) else (env.starts,):
            assert sum(getattr(starts, kind, 0.0) for kind in kinds) == pytest.approx(1)
        assert rsl_config(cfg.ppo)["algorithm"]["learning_rate"] == cfg.ppo.learning_rate


def test_one_line_errors(capsys, monkeypatch):
    with pytest.raises(SystemExit), one_line_errors():
        raise ValueError("two\n  lines")
    assert capsys.readouterr().err == "error: two lines\n"
    with pytest.raises(ZeroDivisionError), one_line_errors():
        _ = 1 / 0
    monkeypatch.setenv("HMC_TRACEBACK", "1")
    with pytest.raises(ValueError, match="seen"), one_line_errors():
        raise ValueError("seen")
