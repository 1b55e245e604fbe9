"""What a run may go on from, and what it keeps of it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from tests.tiny import CFG, make_runner
from train import ppo
from train.config import StanceTraining
from train.runner import read_checkpoint


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> str:
    """Of a run that has not learned yet."""
    path = tmp_path_factory.mktemp("run") / "model_0.pt"
    make_runner(path.parent).save(str(path))
    return str(path)


def test_a_checkpoint_of_other_networks(checkpoint, tmp_path):
    bigger = StanceTraining(CFG.env, ppo=type(CFG.ppo)(hidden=(4,)))
    runner = make_runner(tmp_path, bigger)
    with pytest.raises(ValueError, match=r"do not fit .* hidden layers are \[4\]: set ppo\.hidden"):
        runner.resume(checkpoint)


def test_a_checkpoint_of_another_mode_or_way(checkpoint, tmp_path):
    other = make_runner(tmp_path, StanceTraining(replace(CFG.env, mode="footstand"), CFG.ppo))
    for begin in (other.resume, other.begin_with):
        with pytest.raises(ValueError, match=r"model_0\.pt: it is of mode handstand; expected footstand"):
            begin(checkpoint)
    starts = replace(CFG.env.starts, furthest=0.5)
    shorter = make_runner(tmp_path, StanceTraining(replace(CFG.env, starts=starts), CFG.ppo))
    with pytest.raises(ValueError, match=r"model_0\.pt: .* to the handstand begin at -1\.0; expected 0\.5"):
        shorter.resume(checkpoint)


def drawn_robots(runner) -> torch.Tensor:
    """The errors of their joints' zeros, which differ from robot to robot [rad]."""
    return runner.env._zeros.clone()


def test_a_run_that_goes_on_keeps_its_seed(tmp_path, capsys):
    """Its robots are drawn by it: another seed would go on with others, and export that one."""
    small = ("env.worlds=2", "ppo.steps=4", "ppo.minibatches=1", "env.conditions.variants.zeros=0.01")
    begun = ppo.Args("handstand", engine="mujoco", threads=1, seed=5, out=tmp_path, iterations=1, set=small)
    ppo.main(begun)
    meta = read_checkpoint(tmp_path / "latest.pt")["infos"]["meta"]
    assert (meta["seed"], json.loads(meta["config"])["ppo"]["iterations"]) == ("5", 1)
    first = drawn_robots(ppo.set_up(begun))
    going = replace(begun, seed=None, iterations=2, resume=True)
    runner = ppo.set_up(going)
    assert runner.meta["seed"] == "5"
    assert torch.equal(drawn_robots(runner), first)
    assert not torch.equal(drawn_robots(ppo.set_up(replace(begun, seed=1))), first)
    assert ppo.seed_of(replace(going, seed=5), tmp_path / "latest.pt") == 5
    with pytest.raises(ValueError, match=r"--seed 6: the run of .*latest\.pt has the seed 5"):
        ppo.set_up(replace(going, seed=6))
    capsys.readouterr()
    ppo.main(replace(going, iterations=0))
    assert "1 iterations are done already" in capsys.readouterr().out
