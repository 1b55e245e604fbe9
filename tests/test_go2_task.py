"""The flip's cost term by term at states computed by hand, its timeline, its modes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from hmc.go2 import model as go2
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.go2.task import (
    CostCfg,
    FlipCfg,
    JumpCfg,
    dense_guess,
    flip_task,
    jump_mode,
    make_sim,
    policy_path,
    stance_cost,
    timeline,
)
from hmc.modes import Motion
from hmc.sampling import SamplingMpc
from tools.random_policy import write_random_policy

COMMAND = 60
CFG = CostCfg()
COST = stance_cost(CFG, timeline(COMMAND))


def stage(x, u=None, u_prev=None, k=COMMAND) -> dict[str, float]:
    """Stage terms of one state."""
    u = x[7:19] if u is None else u
    u_prev = u if u_prev is None else u_prev
    terms = COST.stage_terms(x[None], u[None], u_prev[None], torch.tensor([k]))[0]
    return dict(zip(COST.stage, terms.tolist(), strict=True))


def terminal(x, k) -> float:
    return float(COST.terminal_terms(x[None], torch.tensor([k]))[0, 0])


def test_terms_and_weights():
    """Table I of the paper."""
    assert list(COST.stage) == ["height", "orientation", "joints", "rate", "energy", "pose"]
    assert list(COST.terminal) == ["tail"]
    assert (CFG.height, CFG.orientation, CFG.joints, CFG.rate) == (1.5, 1.0, 0.5, 0.001)
    assert (CFG.energy, CFG.pose) == (0.003, 2.5e-7)
    assert COST.nonnegative


@pytest.mark.parametrize(("stance", "k"), [(FOOTSTAND, COMMAND - 1), (HANDSTAND, COMMAND)])
def test_nothing_but_the_pose_term_is_left_at_the_target(stance, k):
    terms = stage(stance.state(), k=k)
    away = float((stance.pose - go2.HOME).square().sum())
    assert terms.pop("pose") == pytest.approx(2.5e-7 * math.exp(-away), rel=1e-5)
    assert all(value == pytest.approx(0, abs=1e-12) for value in terms.values())
    assert terminal(stance.state(), k) == pytest.approx(0, abs=1e-12)


def test_the_target_changes_at_the_command():
    apart = float((FOOTSTAND.pose - HANDSTAND.pose).square().sum())
    for x, k in [(FOOTSTAND.state(), COMMAND), (HANDSTAND.state(), COMMAND - 1)]:
        terms = stage(x, k=k)
        assert terms["orientation"] == pytest.approx(4.0), "gravity along -x instead of +x: 2^2"
        assert terms["joints"] == pytest.approx(0.5 * apart)
        assert terms["height"] == pytest.approx(0, abs=1e-12)
        assert terminal(x, k) == pytest.approx(4.0 + 0.5 * apart)
    steps = torch.tensor([0, COMMAND - 1, COMMAND, 10_000])
    assert timeline(COMMAND)(steps).tolist() == [False, False, True, True]


def test_each_term_by_hand():
    x = HANDSTAND.state()
    x[2] -= 0.2
    x[7] += 0.1
    x[25], x[30] = 2.0, -4.0
    u = x[7:19].clone()
    u_prev = u.clone()
    u_prev[3:6] -= 0.2
    terms = stage(x, u, u_prev)
    assert terms["height"] == pytest.approx(1.5 * 0.04)
    assert terms["joints"] == pytest.approx(0.5 * 0.01)
    assert terms["rate"] == pytest.approx(0.001 * 3 * 0.04)
    # damping alone: torques -0.5 x 2 and -0.5 x -4, powers -2 and -8
    assert terms["energy"] == pytest.approx(0.003 * math.sqrt(4 + 64))
    assert terms["orientation"] == pytest.approx(0, abs=1e-12)
    assert terminal(x, COMMAND) == pytest.approx(1.5 * 0.04 + 0.5 * 0.01)


def test_orientation_by_hand():
    """On four legs gravity has no part along the body's x and y: distance 1 from either target."""
    x = torch.zeros(37, dtype=torch.float64)
    x[2], x[3], x[7:19] = 0.29, 1.0, go2.HOME
    for k in (0, COMMAND):
        assert stage(x, k=k)["orientation"] == pytest.approx(1.0)
        assert stage(x, k=k)["pose"] == pytest.approx(2.5e-7), "the default pose, where the term is largest"
    x[3], x[4] = math.cos(0.25), math.sin(0.25)  # rolled by 0.5 rad: gravity's y is -sin 0.5
    assert stage(x)["orientation"] == pytest.approx(1.0 + math.sin(0.5) ** 2)


def test_no_term_is_ever_negative():
    """What pruning rests on."""
    n = 500
    x, u, u_prev = (
        5 * torch.randn(n, 37).double(),
        5 * torch.randn(n, 12).double(),
        torch.randn(n, 12).double(),
    )
    x[:, 3:7] /= x[:, 3:7].norm(dim=1, keepdim=True)
    k = torch.randint(0, 2 * COMMAND, (n,))
    assert (COST.stage_terms(x, u, u_prev, k) >= 0).all()
    assert (COST.terminal_terms(x, k) >= 0).all()


@pytest.mark.parametrize("n", [1, 2, 77, 300])
@pytest.mark.parametrize("spread", [0.05, 5.0])
def test_terms_at_once_are_those_one_by_one(n, spread):
    """To the bit: what a rollout decides hangs on it."""
    x = HANDSTAND.state() + spread * torch.randn(n, 37).double()
    u = x[:, 7:19] + spread * torch.randn(n, 12).double()
    u_prev = u + spread * torch.randn(n, 12).double()
    u[0, 3] = math.nan
    given = x, u, u_prev, torch.randint(0, 2 * COMMAND, (n,))
    plain = replace(COST, on_cpu=None).stage_terms(*given)
    torch.testing.assert_close(COST.stage_terms(*given), plain, rtol=0, atol=0, equal_nan=True)
    assert plain[0].isnan().any()
    tail, differentiable = (
        COST.terminal_terms(x, given[3]),
        COST.terminal_terms(x.clone().requires_grad_(), given[3]),
    )
    torch.testing.assert_close(tail, differentiable.detach(), rtol=0, atol=0)


def test_tail():
    """The last state held for that long, and weightless where it is 0."""
    x = FOOTSTAND.state()
    k = torch.tensor([COMMAND])
    once = stance_cost(CostCfg(tail=1.0), timeline(COMMAND)).terminal_terms(x[None], k)
    double = stance_cost(CostCfg(tail=2.0), timeline(COMMAND)).terminal_terms(x[None], k)
    torch.testing.assert_close(double, 2 * once)
    assert not stance_cost(CostCfg(tail=0.0), timeline(COMMAND)).terminal_terms(x[None], k).any()


def test_one_row_or_many_is_the_same_to_the_bit():
    x, u = torch.randn(2, 40, 37, dtype=torch.float64)
    u, k = u[:, :12], torch.arange(40) + 40
    whole, last = COST.stage_terms(x, u, -u, k), COST.terminal_terms(x, k)
    for row in range(40):
        one = slice(row, row + 1)
        assert torch.equal(COST.stage_terms(x[one], u[one], -u[one], k[one]), whole[one])
        assert torch.equal(COST.terminal_terms(x[one], k[one]), last[one])


def test_dense_guess():
    points = torch.tensor([[0.0, 1.0, 2.0, 3.0], [4.0, 3.0, 2.0, 1.0]], dtype=torch.float64)
    dense = dense_guess(points, 4)
    assert dense.shape == (5, 12)
    assert dense[1].tolist() == [0, 1, 1.5, 0, 1, 1.5, 0, 2, 2.5, 0, 2, 2.5]
    assert dense[4].tolist() == [0, 4, 3, 0, 4, 3, 0, 2, 1, 0, 2, 1]


def test_jump_noise_is_mostly_symmetric():
    jump = jump_mode(JumpCfg(asymmetry=0.0), lambda n: make_sim(n, threads=1), seed=0)
    assert isinstance(jump, SamplingMpc)
    eps = jump._along_basis(jump._noise(torch.tensor([0]), 0))
    assert torch.equal(eps[..., 0:3], eps[..., 3:6])
    assert torch.equal(eps[..., 6:9], eps[..., 9:12])
    assert not eps[..., [0, 3, 6, 9]].any(), "hips do not take part in symmetric motion"
    assert eps[0, 1:, :, [1, 2, 7, 8]].std(0).min() > 0
    loose = jump_mode(JumpCfg(asymmetry=0.2), lambda n: make_sim(n, threads=1), seed=0)
    assert isinstance(loose, SamplingMpc)
    eps = loose._along_basis(loose._noise(torch.tensor([0]), 0))
    assert not torch.equal(*eps[..., [1, 4]].unbind(-1))


def test_the_jump_as_a_motion():
    """Without MPC the guess is played from the entry on, inside the joint limits, and its end is held."""
    guess = ((0.0, -1.0, 2.0, -1.5), (0.4, -9.0, 2.0, -1.5))
    jump = jump_mode(JumpCfg(guess=guess, spacing=2, mpc=False), None, 0)
    x, u = FOOTSTAND.state()[None].repeat(2, 1), torch.zeros(2, 12, dtype=torch.float64)
    k = torch.tensor([7, 40])
    memory = jump.reset(x, u, k)
    memory[1] = 1.0  # entered a step before
    for step in range(5):
        target, memory = jump.act(x, u, memory, k)
        assert target[0, 1] == pytest.approx(min(0.2 * step, 0.4))
        assert target[1, 4] == pytest.approx(min(0.2 * (step + 1), 0.4))
        assert target[:, [2, 5]].min() >= go2.Q_LOWER[2]
    assert jump.control_steps == 0
    with pytest.raises(ValueError, match=r"jump\.guess is played, but it is empty"):
        jump_mode(JumpCfg(mpc=False), None, 0)


@pytest.mark.parametrize("inputs", [torch.zeros(0, 2), torch.zeros(3), torch.tensor([[math.nan]])])
def test_a_motion_of_nothing_is_refused(inputs):
    with pytest.raises(ValueError, match=r"mode 'wave': a motion is \(G, nu\) finite inputs"):
        Motion("wave", inputs)


def test_the_task(tmp_path):
    """Modes in order, and what the policies are called here; a policy that is not there is named."""
    policy = str(write_random_policy(tmp_path / "policy.onnx", hidden=(4,)))
    task = flip_task(FlipCfg(foot=policy, hand=policy, horizon=9), threads=1)
    assert task.modes.names == ("foot", "jump", "hand")
    assert task.horizon == 9
    sim = task.make_sim(2)
    assert (sim.num_worlds, sim.nx, sim.nu, sim.dt) == (2, 37, 12, 0.02)
    with pytest.raises(ValueError, match=r"nothing\.onnx: no such file"):
        flip_task(FlipCfg(foot=policy, hand=str(tmp_path / "nothing.onnx")), threads=1)


def test_a_policy_that_is_missing_says_how_it_is_made():
    with pytest.raises(ValueError, match=r"hop\.onnx: no such file: .* train/ppo\.py --mode hop,"):
        policy_path("hop")
    with pytest.raises(
        ValueError, match=r"--mode hop, .* out/train/hop/latest\.pt .*hop_value\.onnx --value"
    ):
        policy_path("hop_value")
    assert policy_path("handstand").is_file()
    assert policy_path("handstand", "elsewhere.onnx") == Path("elsewhere.onnx")
