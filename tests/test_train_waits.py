"""What waits for a GPU, found without one: on torch's meta device, whose tensors have no numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Self

import pytest
import torch
from rsl_rl.utils.logger import Logger
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hmc.go2.conditions import Conditions, NoiseCfg
from hmc.go2.model import load_model
from hmc.go2.task import CostCfg, FlipCfg, JumpCfg, flip_task
from hmc.go2.variants import Variant
from hmc.sim.cuda import Recorded
from hmc.sim.ids import Ids
from hmc.sim.warp import WarpSim
from tests.tiny import CFG, make_env, make_legs, make_runner
from train import env as env_module
from train import fallen, legs
from train import starts as starts_module
from train.chosen import choose, pick, put, reset
from train.config import rsl_config
from train.env import AHEAD, Go2Env, Start
from train.make import make_env as make_any
from train.runner import Runner
from train.starts import StartsCfg
from train.unified import UnifiedCfg

META = torch.device("meta")
KINDS = ("stance", "walk", "getup", "unified")


class Given(TorchFunctionMode):
    """Notes what makes a tensor elsewhere of Python's numbers, and what picks by a list of them: a copy, too,
    but of a tensor that never shows."""

    MAKERS = (torch.tensor, torch.as_tensor, Tensor.new_tensor)
    PICKERS = (Tensor.__getitem__, Tensor.__setitem__)

    def __init__(self, found: list[str]) -> None:
        super().__init__()
        self.found = found

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        picked = args[1] if func in self.PICKERS and isinstance(args[1], tuple) else args[1:2]
        given = func in self.PICKERS and any(isinstance(each, list) for each in picked)
        where = args[0] if given else out if func in self.MAKERS else None
        if where is not None and where.device.type != "cpu":
            self.found.append(func.__name__)
        return out


class Copies(TorchDispatchMode):
    """Notes what takes a tensor of the CPU to one elsewhere: torch waits in each of them."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self._given = Given(self.found)

    def __enter__(self) -> Self:
        self._given.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._given.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        given, made = (
            [each for each in tree_leaves(part) if isinstance(each, Tensor)]
            for part in ((args, kwargs or {}), out)
        )
        # numbers () are handed to a kernel by value, but where they are copied as such
        copied = func.overloadpacket.__name__ in ("_to_copy", "copy_")
        here = any(each.device.type == "cpu" and (each.ndim > 0 or copied) for each in given)
        if here and any(each.device.type != "cpu" for each in (*given, *made)):
            self.found.append(str(func))
        return out


class Nowhere:
    """A simulator of so many Go2s on the meta device, in which nothing has a value."""

    nx, nu, dt, device, dtype = 37, 12, 0.02, META, torch.float32

    def __init__(self, num_worlds: int):
        self.num_worlds = num_worlds

    def x(self, ids: Ids = None) -> Tensor:
        return torch.zeros(self.num_worlds, 37, device=META)

    u = save = x

    def step(self, u: Tensor, ids: Ids = None) -> None:
        assert u.shape == (self.num_worlds, 12)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        assert ids is None

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        assert ids is None


def moved(thing: Any) -> None:
    """Move all tensors that an object of ours has to the meta device, and those of its parts."""
    for name, value in vars(thing).items():
        if name == "_ahead":  # starts drawn before that
            setattr(thing, name, None)
        elif isinstance(value, Tensor):
            setattr(thing, name, value.to(META))
        elif isinstance(value, dict) and all(isinstance(each, Tensor) for each in value.values()):
            setattr(thing, name, {key: each.to(META) for key, each in value.items()})
        elif isinstance(value, torch.device):
            setattr(thing, name, META)
        for part in value if isinstance(value, list | tuple) else [value]:
            if type(part).__module__.startswith("train.") and hasattr(part, "draw"):
                moved(part)


def environment(kind: str) -> Go2Env:
    """One of a kind, with all that there is to it."""
    if kind in ("walk", "getup"):
        return make_legs(kind)
    conditions = Conditions(push=0.5, noise=NoiseCfg(lasting=0.5))
    starts = StartsCfg(0.3, 0.3, 0.2, 0.2, -1.0, records="train/flips.pt")
    if kind == "stance":
        return make_env(replace(CFG.env, starts=starts, conditions=conditions))
    cfg = UnifiedCfg("unified", worlds=8, footstand=starts, handstand=starts)
    return make_any(cfg, "mujoco", threads=1)


@pytest.mark.parametrize("kind", KINDS)
def test_no_step_waits(kind, tmp_path):
    """A step of training: neither for numbers, which would be an error on the meta device, nor in a copy."""
    env = environment(kind)
    moved(env)
    env.sim = Nowhere(env.num_envs)
    runner = Runner(env, rsl_config(CFG.ppo), str(tmp_path), "meta", {})
    runner.logger.writer = object()
    obs = env.get_observations()

    def step() -> None:
        nonlocal obs
        obs, rewards, dones, extras = env.step(runner.alg.act(obs))
        runner.alg.process_env_step(obs, rewards, dones, extras)
        runner.logger.process_env_step(rewards, dones, extras)

    with torch.inference_mode():
        step()  # constants are copied once
        runner.alg.storage.clear()
        with Copies() as copies:
            for _ in range(CFG.ppo.steps):
                step()
    assert not copies.found


def test_no_call_of_engine_warp_waits():
    """But for the graphs themselves, whose launch never does: of worlds by index, as a stretch, all of them
    and by flags, in workspaces of each size."""
    sim: Any = WarpSim(load_model(), 6, device="cpu", latency=(0, 1, 2, 3, 4, 4))
    for n in (6, 3, 2):
        sim.step(sim.u(slice(0, n)), torch.arange(n))
        sim.contact_forces(slice(0, n))
    sim.reset_flagged(torch.zeros(6, dtype=torch.bool), sim.x(), sim.u())
    for thing in (sim, *sim._spaces.values()):
        for name, value in vars(thing).items():
            if isinstance(value, Tensor):
                setattr(thing, name, value.to(META))
            elif isinstance(value, Recorded):
                setattr(thing, name, lambda: None)
    sim._device = META
    with Copies() as copies:
        for ids in (None, slice(0, 3), torch.zeros(2, dtype=torch.long, device=META)):
            x, u = sim.x(ids), sim.u(ids)
            sim.reset(x, u, ids)
            sim.step(u, ids)
            sim.load(sim.save(ids), ids)
            assert sim.actuator_force(ids).device == META
            assert sim.contact_forces(ids).device == META
        reset(sim, torch.zeros(6, dtype=torch.bool, device=META), sim.x(), sim.u())
    assert not copies.found
    assert len(sim._spaces) == 3


class Starts(TorchDispatchMode):
    """Counts what a GPU would start a kernel for: operations that are neither views nor make room."""

    FREE = ("slice", "select", "view", "_unsafe_view", "expand", "unsqueeze", "alias", "detach", "empty")

    def __init__(self) -> None:
        super().__init__()
        self.number = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += func.overloadpacket.__name__ not in self.FREE
        return func(*args, **(kwargs or {}))


def test_what_engine_warp_starts_beside_its_graphs():
    """Which worlds, how many, and what they are given: whatever a world is made of, nobody copies that."""
    models = [Variant(friction=0.5 + 0.1 * i).model() for i in range(4)]
    sim = WarpSim(load_model(), 4, device="cpu", latency=(0, 1, 2, 3), models=models)
    x, u, ids, flags = sim.x(), sim.u(), torch.tensor([2, 0]), torch.tensor([True, False, True, False])
    calls: list[Callable[[], Any]] = [
        lambda: sim.step(u),
        lambda: sim.step(u[:2], ids),
        lambda: sim.contact_forces(),
        lambda: sim.reset_flagged(flags, x, u),
    ]
    for call in calls:
        call()  # is recorded
        with Starts() as starts:
            call()
        assert starts.number == 3


@torch.no_grad()
def test_no_policy_cost_or_critic_waits():
    """Of those that plan the flip, either; with the critic of its target in the end."""
    task = flip_task(
        FlipCfg(jump=JumpCfg(guess=((0.0,) * 4,) * 2, mpc=False), cost=CostCfg(value=1.0)), threads=1
    )
    x, u = torch.zeros(5, 37, device=META), torch.zeros(5, 12, device=META)
    k = torch.zeros(5, dtype=torch.long, device=META)

    def step() -> None:
        for mode in task.modes:
            mode.act(x, u, mode.reset(x, u, k), k)
        task.cost.stage_terms(x, u, u, k)
        task.cost.terminal_terms(x, k)

    step()
    with Copies() as copies:
        step()
    assert not copies.found


@pytest.mark.parametrize("shape", [(8,), (8, 3)])
def test_flags_choose_what_indices_do(shape):
    values, rows, flags = torch.rand(shape), torch.rand(shape), torch.rand(8) < 0.5
    ids = choose(flags)
    assert ids.tolist() == flags.nonzero().flatten().tolist()
    by_flags, by_ids = values.clone(), values.clone()
    put(by_flags, flags, rows)
    put(by_ids, ids, pick(rows, ids))
    assert torch.equal(by_flags, by_ids)
    assert pick(values, flags) is values
    put(by_flags, flags, 7.0)
    assert ((by_flags == 7.0).flatten(1).all(1) if len(shape) > 1 else by_flags == 7.0).equal(flags)


def test_flags_reset_what_indices_do():
    """The others go on to the bit, with all that the engine remembers of them."""
    flags, sims = torch.arange(8) % 3 == 0, [make_env().sim for _ in range(2)]
    rows, x, u = sims[0].save(), sims[0].x() + 0.01, sims[0].u()
    for sim, chosen in zip(sims, (flags, choose(flags)), strict=True):
        sim.load(rows)
        sim.step(u)
        reset(sim, chosen, pick(x, chosen), pick(u, chosen))
        sim.step(u)
    assert torch.equal(sims[0].save(), sims[1].save())


@pytest.mark.parametrize("kind", KINDS)
def test_episodes_under_flags(kind, monkeypatch):
    """As on a GPU: the engine goes along, what ended begins anew, and starts are drawn now and then."""
    for module in (env_module, legs, fallen, starts_module):
        monkeypatch.setattr(module, "choose", lambda flags: flags)
    env = environment(kind)
    draws, draw, ends = [], env.starts.draw, 0

    def counted(n: int) -> Start:
        draws.append(n)
        return draw(n)

    monkeypatch.setattr(env.starts, "draw", counted)
    for _ in range(4 * AHEAD):
        before = env.episode_length_buf.clone()
        _, reward, done, _ = env.step(torch.randn(env.num_envs, 12))
        assert torch.equal(env.episode_length_buf, torch.where(done, 0, before + 1))
        assert torch.equal(env.sim.x().float()[done], env._x[done])
        assert reward.isfinite().all()
        ends += int(done.sum())
    assert ends > 0
    assert draws == [env.num_envs] * 4


def test_returns_are_those_of_rsl_rl(tmp_path):
    """Taken down on the device, the logger's episodes are those that it would have taken down itself."""
    runner, torch_generator = make_runner(tmp_path), torch.Generator().manual_seed(1)
    own = Logger(None, runner.cfg, {}, 8, False, 1, 0, "cpu")
    own.writer = runner.logger.writer = object()
    for _ in range(3):
        for _ in range(6):
            rewards = torch.rand(8, generator=torch_generator)
            dones = torch.rand(8, generator=torch_generator) < 0.3
            for logger in (own, runner.logger):
                logger.process_env_step(
                    rewards, dones, {"log": {"/a": rewards.mean(), "/b": torch.tensor(math.nan)}}
                )
        runner._read_off()
        (found,) = runner.logger.ep_extras
        expected = torch.stack([entry["/a"] for entry in own.ep_extras]).mean()
        assert found == {"/a": pytest.approx(float(expected))}, "what never is a number is left out"
        own.ep_extras.clear()
        runner.logger.ep_extras = []
    assert len(own.rewbuffer) > 20
    assert (runner.logger.rewbuffer, runner.logger.lenbuffer) == (own.rewbuffer, own.lenbuffer)
