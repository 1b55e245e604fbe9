"""Engine warp against C MuJoCo, contact forces included, and what it says where something lacks."""

from __future__ import annotations

import copy
import subprocess
import sys
import warnings
from dataclasses import replace
from typing import Any, Literal

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from hmc import plan
from hmc.cli import one_line_errors
from hmc.go2.ensemble import EnsembleCfg
from hmc.go2.model import HOME, SUBSTEPS, load_model
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import FlipCfg, JumpCfg, flip_task
from hmc.go2.variants import Variant
from hmc.sampling import SamplingCfg
from hmc.sim import cuda, warp
from hmc.sim.make import installed, make_sim
from hmc.sim.warp import WarpSim

WORLDS, STEPS = 64, 50
TALL = torch.tensor([0.0, 0.8, -1.5] * 4)  # [rad]: the knees are well above the ground
APART, FORCE_APART = 1e-3, 0.1  # see `test_standing_robots`


def standing() -> torch.Tensor:
    """Random states on four feet anywhere on the floor, in any direction, (WORLDS, 37)."""
    generator = torch.Generator().manual_seed(5)
    x = 0.02 * torch.randn(WORLDS, 37, generator=generator)
    half = torch.pi * torch.rand(WORLDS, generator=generator)
    x[:, :2] = 4 * torch.rand(WORLDS, 2, generator=generator) - 2
    x[:, 2] = 0.333
    x[:, 3:7] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
    x[:, 7:19] += TALL
    return x


def forces(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Contact force on each geom in the state that it is in [N], (ngeom, 3), in world axes."""
    data = copy.copy(data)  # what this finds is not to warm up the next step
    mujoco.mj_forward(model, data)
    found, force = np.zeros((model.ngeom, 3)), np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, force)
        push = contact.frame.reshape(3, 3).T @ force[:3]
        found[contact.geom[1]] += push
        found[contact.geom[0]] -= push
    return found


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_standing_robots(device, request):
    """50 control steps of 64 robots on their feet against mj_step, whose float64 and float32 differ.

    Of any entry of x (m, rad, m/s, rad/s) at any step by at most 1e-3, found were 3e-4; of any component of
    the force on a foot, up to 88 N, by at most 0.1 N, found were 0.01 N.
    """
    if device == "cuda":
        request.getfixturevalue("cuda")
    model, x = load_model(), standing()
    sim = WarpSim(model, WORLDS, device=device, deterministic=True)
    u = TALL + 0.03 * torch.randn(STEPS // 5, WORLDS, 12, generator=torch.Generator().manual_seed(6))
    worlds = [mujoco.MjData(model) for _ in range(WORLDS)]
    for data, row in zip(worlds, x.double().numpy(), strict=True):
        data.qpos, data.qvel = row[:19], row[19:]
    for data in worlds:
        data.ctrl = TALL.double().numpy()
    sim.reset(x.to(device), TALL.repeat(WORLDS, 1).to(device))

    def compared() -> np.ndarray:
        found = sim.contact_forces().cpu().double().numpy()
        assert np.abs(found - np.stack([forces(model, data) for data in worlds])).max() <= FORCE_APART
        return found

    compared()  # without a step
    for k in range(STEPS):
        sim.step(u[k // 5].to(device))
        for data, target in zip(worlds, u[k // 5].double().numpy(), strict=True):
            data.ctrl = target
            mujoco.mj_step(model, data, SUBSTEPS)
        states = np.stack([np.concatenate([data.qpos, data.qvel]) for data in worlds])
        assert np.abs(sim.x().cpu().double().numpy() - states).max() <= APART
        if k % 5 == 4:
            found = compared()
    lift = found[:, 1:, 2].sum(1)
    assert lift.mean() == pytest.approx(9.81 * model.body_mass.sum(), rel=0.1), "they stand"
    assert sim.overflow() == {"constraints": 0, "contacts": 0}


@pytest.mark.parametrize("fallback", [(False, False), (True, False)])
def test_graphs_are_the_calls_that_they_recorded(monkeypatch, fallback):
    """Steps, forward passes and resets of worlds with models and latencies of their own, in workspaces of all
    sizes, made as they are needed, to the bit as where a driver has no graphs, or none with loops."""
    states, models = [], [Variant(friction=0.5 + 0.1 * i, payload=0.3 * i).model() for i in range(5)]
    for found in ((True, True), fallback):
        monkeypatch.setattr(warp, "graphs", lambda device, found=found: found)
        sim: Any = WarpSim(load_model(), 5, device="cpu", latency=(0, 1, 2, 3, 4), models=models)
        generator = torch.Generator().manual_seed(3)
        sim.reset(standing()[:5], TALL.repeat(5, 1))
        seen = []
        for n in (5, 1, 3, 5, 2, 5, 4):
            ids = torch.randperm(5, generator=generator)[:n]
            sim.step(TALL + 0.2 * torch.randn(n, 12, generator=generator), ids)
            flags = torch.rand(5, generator=generator) < 0.2
            sim.reset_flagged(flags, standing()[5:10], TALL.repeat(5, 1))
            seen += [sim.save(), sim.contact_forces(ids).flatten()[:, None]]
        states.append(torch.cat([each.flatten() for each in seen]))
        made = [each for space in sim._spaces.values() for each in (space._steps, space._looks)]
        assert [each.graph is not None for each in (*made, sim._begin)] == [found[0]] * (len(made) + 1)
    assert torch.equal(*states)
    assert states[0].isfinite().all()


def test_to_look_changes_nothing():
    """A forward pass of any worlds in any order finds what it finds of all, right after a reset or a load."""
    sim, x, u = WarpSim(load_model(), 5, device="cpu", latency=2), standing()[:5], TALL.repeat(5, 1)
    sim.reset(x, u)
    at_start = sim.contact_forces()
    sim.step(u + 0.1)
    before, found = sim.save(), sim.contact_forces()
    assert torch.equal(sim.save(), before)
    for ids in (torch.tensor([3, 1]), torch.tensor([4]), slice(1, 4), slice(2, 2)):
        assert torch.equal(sim.contact_forces(ids), found[ids])
    sim.step(u)
    after = sim.save()
    sim.load(before)
    assert torch.equal(sim.contact_forces(), found)
    sim.step(u)
    assert torch.equal(sim.save(), after)
    sim.reset(x, u)
    assert torch.equal(sim.contact_forces(), at_start)
    # of all geoms together the forces are those on the robot and their opposite on the floor
    assert found.sum(1).abs().max() <= 1e-4 * found.abs().max()


def test_flags_reset_what_indices_do():
    """To the bit, the worlds that are not flagged included, from none to all of them."""
    sims = [WarpSim(load_model(), 5, device="cpu", latency=(0, 1, 2, 3, 4)) for _ in range(2)]
    x, u = standing(), TALL.repeat(5, 1)
    for flags in ((1, 1, 1, 1, 1), (0, 1, 0, 0, 1), (0, 0, 0, 0, 0), (1, 0, 0, 0, 0)):
        flagged = torch.tensor(flags, dtype=torch.bool)
        ids = flagged.nonzero().squeeze(1)
        sims[0].reset_flagged(flagged, x[:5], u)
        sims[1].reset(x[:5][ids], u[ids], ids)
        assert not sims[0].actuator_force(ids).any(), "no torque yet"
        for sim in sims:
            sim.step(u + 0.05)
        assert torch.equal(sims[0].save(), sims[1].save())
    sims[0].load(sims[0].save(slice(0, 1)), slice(1, 2))
    assert torch.equal(*sims[0].actuator_force()[:2])


@pytest.mark.parametrize(("room", "lost", "kinds"), [("constraints", 1, (1, 0)), ("contacts", 3, (0, 3))])
def test_what_does_not_fit_has_no_forces(room, lost, kinds):
    """Of worlds that are only looked at, as of worlds that are stepped; and they are counted."""
    size = {"constraints": 16, "contacts": 1}[room]  # 12 of joint friction and 1 contact; 1 a world in a pool
    sim = WarpSim(load_model(), 3, device="cpu", substeps=1, **{room: size})
    x = standing()[:3]
    x[:, 2], x[:, 7:19] = torch.tensor([1.0, 0.25, 1.0]), HOME
    sim.reset(x, HOME.repeat(3, 1))
    counts = dict(zip(("constraints", "contacts"), kinds, strict=True))
    fits = [lost == 1, False, lost == 1]
    found = sim.contact_forces()
    assert found.isfinite().flatten(1).all(1).tolist() == fits
    assert not found[[0, 2]].nan_to_num().any(), "in the air"
    assert sim.overflow() == counts
    assert sim.x().isfinite().all(), "they have not been stepped"
    sim.step(sim.u())
    assert sim.x().isfinite().all(1).tolist() == fits
    assert sim.overflow() == counts


def test_other_models_are_checked():
    model = load_model()
    longer = load_model()
    longer.geom_size[5, 1] *= 1.1
    with pytest.raises(ValueError, match=r"differ in geom_size, .* they may in geom_friction, .*mujoco"):
        make_sim(model, 2, "warp", device="cpu", models=[model, longer])
    coarser = load_model()
    coarser.opt.iterations = 3
    with pytest.raises(ValueError, match=r"differ in opt\.iterations, "):
        make_sim(model, 2, "warp", device="cpu", models=[model, coarser])
    with pytest.raises(ValueError, match="models must be one of each of the 3 worlds, got 1"):
        make_sim(model, 3, "warp", device="cpu", models=[Variant().model()])


def test_memory_is_checked_before_it_is_taken(monkeypatch):
    """What is free decides; the number that is offered fits."""
    model, each = load_model(), 0
    one = mjw.make_data(WarpSim(model, 1, device="cpu").model, nworld=1)
    each = cuda.num_bytes(one)
    assert each > 4 * sum(np.prod(value.shape) for value in (one.qpos, one.qvel, one.efc.J))
    cuda.check_memory(one, 1000, torch.device("cpu"))
    monkeypatch.setattr(cuda, "free_memory", lambda device: 10.5 * each)
    cuda.check_memory(one, 10, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"11 worlds take at least .* GiB .*: take at most 10 worlds"):
        cuda.check_memory(one, 11, torch.device("cpu"))
    with pytest.raises(ValueError, match="4,096 worlds take at least"):
        WarpSim(model, 4096, device="cpu")


def fake_gpu(monkeypatch, *, warp: bool = True, pools: bool = True, loops: bool = True) -> torch.device:
    """A device of torch's, of which Warp says this."""
    monkeypatch.setattr(wp, "is_cuda_available", lambda: warp)
    monkeypatch.setattr(wp, "device_from_torch", lambda device: device)
    monkeypatch.setattr(wp, "is_mempool_supported", lambda device: pools)
    monkeypatch.setattr(wp, "is_conditional_graph_supported", lambda: loops)
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: (12, 2))
    return torch.device("cuda", 0)


def test_drivers(monkeypatch, capsys):
    assert cuda.graphs(torch.device("cpu")) == (True, True)
    assert cuda.graphs(fake_gpu(monkeypatch)) == (True, True)
    with pytest.warns(UserWarning, match=r"CUDA 12\.2\) lacks loops .* 12\.4; the contact solver") as said:
        assert cuda.graphs(fake_gpu(monkeypatch, loops=False)) == (True, False)
    with pytest.warns(UserWarning, match=r"lacks memory pools in CUDA graphs; each kernel starts alone"):
        assert cuda.graphs(fake_gpu(monkeypatch, pools=False)) == (False, False)
    assert "\n" not in str(said[0].message)
    with one_line_errors(), warnings.catch_warnings():
        warnings.simplefilter("always")
        cuda.graphs(fake_gpu(monkeypatch, loops=False))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "warning: engine warp is slower here: the driver of cuda:0 (CUDA 12.2) lacks loops"
    )
    with pytest.raises(ValueError, match=r"torch finds cuda:0 but Warp .* driver: .* engine mujoco"):
        cuda.graphs(fake_gpu(monkeypatch, warp=False))


def test_packages_that_lack_or_do_not_fit():
    """In a program of its own, where nothing is loaded yet."""
    program = """
import sys
from hmc.go2.model import load_model
from hmc.sim.make import make_sim
for module in (None, type(sys)("mujoco_warp")):
    sys.modules["mujoco_warp"] = module
    try:
        make_sim(load_model(), 1, "warp", device="cpu")
    except ValueError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    lacking, misfit = done.stdout.splitlines()
    assert lacking == "engine warp needs mujoco_warp: pip install 'hmc[warp]', or take mujoco"
    assert f"{installed()} do not go together (module 'mujoco_warp' has no attribute" in misfit
    assert "or take engine mujoco" in misfit


def test_determinism_is_torchs(cuda):
    """Without an argument of its own the engine is as deterministic as torch is set to be."""
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        sim: Any = WarpSim(load_model(), 1)
    finally:
        torch.use_deterministic_algorithms(False)
    assert sim._params.opt.deterministic == mjw.DeterminismType.ALL


@pytest.mark.parametrize(("mpc", "members"), [(False, 1), (True, 0)])
def test_a_flip_is_planned_on_it(mpc, members):
    """The same search as on the C engine, with policies, an ensemble, or sampling MPC that rolls out in a
    simulator of its own, at the same cost to rounding."""
    sampling = SamplingCfg(samples=3, horizon=3, knots=2, replan_every=2, worlds=4)
    guess = ((-0.2, -2.0, 3.0, -1.7), (0.2, -1.1, 1.1, -0.8))
    jump = JumpCfg(guess=guess, mpc=mpc, sampling=sampling)
    cfg = FlipCfg(horizon=3, command=2, jump=jump, ensemble=EnsembleCfg(members=members))
    x = FOOTSTAND.state()
    plans = {}
    engines: list[tuple[Literal["mujoco", "warp"], str]] = [("mujoco", ""), ("warp", "cpu")]
    for engine, device in engines:
        task = flip_task(replace(cfg, engine=engine, device=device), threads=1)
        plans[engine] = plan(task, x, u=x[7:19], solver="exhaustive", samples=18)
    assert plans["warp"].schedule == plans["mujoco"].schedule
    assert plans["warp"].cost == pytest.approx(plans["mujoco"].cost, rel=1e-3)
    assert plans["warp"].locally_optimal
