"""Engines by name: what is chosen, what is refused and in which words, and Warp's limits."""

from __future__ import annotations

import re
from importlib import metadata

import mujoco
import pytest
import torch

from hmc.go2.model import HOME, load_model
from hmc.go2.task import FlipCfg, flip_task
from hmc.sim import make
from hmc.sim.check import tell_overflow
from hmc.sim.device import find_device
from hmc.sim.make import make_sim
from hmc.sim.mujoco import MujocoSim

NO_GPU = not torch.cuda.is_available()


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load_model()


def test_auto_on_the_cpu_is_c_mujoco(model):
    assert isinstance(make_sim(model, 2, device="cpu", threads=1), MujocoSim)
    if NO_GPU:
        assert isinstance(make_sim(model, 2, threads=1), MujocoSim)


def test_auto_on_a_gpu_is_warp(model, cuda):
    assert make_sim(model, 2).device.type == "cuda"


def test_unknown_engine(model):
    with pytest.raises(ValueError, match="unknown engine 'warpp': choose one of auto, mujoco, warp"):
        make_sim(model, 2, "warpp")


@pytest.mark.skipif(not NO_GPU, reason="there is a GPU")
def test_no_gpu(model):
    with pytest.raises(
        ValueError, match=r"engine warp wants a GPU and there is only cpu .*: take engine mujoco"
    ):
        make_sim(model, 2, "warp")


def test_packages_that_are_too_old_for_each_other(model, monkeypatch):
    version = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "3.2.9" if name == "mujoco" else version(name))
    make.misfit.cache_clear()
    try:
        with pytest.raises(
            ValueError, match=r"mujoco 3\.2\.9, .* do not go together \(mujoco-warp wants muj"
        ):
            make_sim(model, 1, "warp", device="cpu")
    finally:
        make.misfit.cache_clear()
    monkeypatch.undo()
    assert make.misfit() == ""


@pytest.mark.skipif(not NO_GPU, reason="there is a GPU")
def test_a_task_says_at_once_that_its_engine_is_not_there():
    with pytest.raises(ValueError, match="engine warp wants a GPU"):
        flip_task(FlipCfg(engine="warp"))


@pytest.mark.parametrize("engine", ["auto", "mujoco", "warp"])
@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("cuda:63", "device cuda:63 does not exist, there .* cpu.*: take one of these"),
        ("tpu:0", "unknown device 'tpu:0': name one like cpu or cuda:0"),
        ("mps", "engines run on cpu or cuda devices, not on mps"),
    ],
)
def test_device_that_is_not_there(model, engine, device, message):
    with pytest.raises(ValueError, match=message) as error:
        make_sim(model, 2, engine, device=device)
    assert "\n" not in str(error.value)


def test_c_mujoco_is_no_gpu_engine(model, cuda):
    with pytest.raises(ValueError, match="engine mujoco runs on the CPU, not on cuda:0"):
        make_sim(model, 2, "mujoco", device="cuda:0")


def test_find_device_gives_an_index(cuda):
    assert find_device("cuda") == torch.device("cuda", 0)


def test_sizes(model):
    with pytest.raises(ValueError, match="num_worlds must be at least 1, got 0"):
        make_sim(model, 0, "mujoco")
    with pytest.raises(ValueError, match="substeps must be at least 1, got 0"):
        make_sim(model, 1, "mujoco", substeps=0)
    with pytest.raises(ValueError, match="num_worlds must be at least 1, got 0"):
        make_sim(model, 0, "warp", device="cpu")
    for worlds, latency in ((1, 5), (3, (0, 1)), (2, (0, -1))):
        with pytest.raises(
            ValueError, match=f"latency must be 0 to 4 .* {worlds}; got {re.escape(str(latency))}"
        ):
            MujocoSim(model, worlds, latency=latency)
    with pytest.raises(ValueError, match=r"latency must be 0 to 4 .* 2; got 5"):
        make_sim(model, 2, "warp", device="cpu", latency=5)
    with pytest.raises(ValueError, match="substeps must be at least 1, got 0"):
        make_sim(model, 1, "warp", device="cpu", substeps=0)


def test_autoreset_is_refused():
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(ValueError, match="resets diverged worlds by itself"):
        make_sim(model, 1, "mujoco")


def standing(worlds: int) -> torch.Tensor:
    """Home pose in mid-air (worlds, 37)."""
    x = torch.zeros(worlds, 37)
    x[:, 2], x[:, 3], x[:, 7:19] = 1.0, 1.0, HOME
    return x


def test_too_little_room_is_never_silent(model):
    """A world that needs more constraint rows than there are is marked lost and counted; others go on."""
    from hmc.sim.warp import WarpSim

    sim = WarpSim(model, 3, device="cpu", substeps=1, constraints=16)  # 12 of joint friction, 1 contact
    x, u = standing(3), HOME.repeat(3, 1)
    x[1, 2] = 0.25  # all feet in the ground
    sim.reset(x, u)
    sim.step(u)
    assert torch.isfinite(sim.x()).all(1).tolist() == [True, False, True]
    assert sim.overflow() == {"constraints": 1, "contacts": 0}
    assert sim.overflow() == {"constraints": 0, "contacts": 0}
    sim.step(u[1:2], torch.tensor([1]))
    tell_overflow(sim)  # a world that is lost already needs no room
    sim.reset(x, u)
    sim.step(u)
    with pytest.warns(UserWarning, match="did not fit .*: 1 by constraints; give the simulator more constr"):
        tell_overflow(sim)


def test_too_few_contacts_are_everybodys(model):
    """They are pooled, and whose are missing is not known: but only of those that stepped together."""
    from hmc.sim.warp import WarpSim

    sim = WarpSim(model, 4, device="cpu", substeps=1, contacts=1)
    x, u = standing(4), HOME.repeat(4, 1)
    x[1, 2] = 0.25  # all feet in the ground, which is more than three contacts
    sim.reset(x, u)
    sim.step(u[1:], torch.tensor([3, 1, 2]))
    assert torch.isfinite(sim.x()).all(1).tolist() == [True, False, False, False]
    with pytest.warns(UserWarning, match=r"3 by contacts; give the simulator more contacts="):
        tell_overflow(sim)


def test_default_room_is_enough(model):
    """Even folded up and sunk into the floor, which is as many contacts as the geoms can make."""
    from hmc.sim.warp import WarpSim

    sim = WarpSim(model, 2, device="cpu", substeps=1)
    x, u = standing(2), HOME.repeat(2, 1)
    x[:, 2], x[1, 3:5] = -0.5, torch.tensor([0.0, 1.0])
    sim.reset(x, u)
    sim.step(u)
    assert sim.overflow() == {"constraints": 0, "contacts": 0}
    assert torch.isfinite(sim.x()).all()
