"""One set of properties for every engine: C MuJoCo, MuJoCo Warp, and the closed-form cartpole.

Tolerance between engines: C MuJoCo computes in float64, Warp in float32. From a stand on four feet with
targets around it, only feet touch, and the difference does not grow: over 50 control steps of 122 worlds the
largest of any entry of x (m, rad, m/s, rad/s) was 2e-4, and 1e-3 is asked for. Where a knee drags,
the engines differ for good: both use friction pyramids, but turn that of a capsule differently about the
normal (up to 0.09 rad/s in one substep). Hard landings are chaotic besides. No test compares those.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import pytest
import torch
from torch import Tensor

from hmc.go2.model import clearances, load_model
from hmc.sim.base import Sim, rollout
from hmc.sim.cartpole import CartpoleSim
from hmc.sim.make import make_sim
from hmc.sim.mujoco import MujocoSim

W = 5  # worlds
TALL = torch.tensor([0.0, 0.8, -1.5] * 4)  # [rad]: the knees are well above the ground
TOLERANCE = {"mujoco-1": 0.0, "mujoco-2": 0.0, "warp-cpu": 1e-3, "warp-cuda": 1e-3}


def warp_sim(device: str) -> Sim:
    from hmc.sim.warp import WarpSim

    return WarpSim(load_model(), W, device=device, deterministic=True)


ENGINES: dict[str, Callable[[], Sim]] = {
    "mujoco-1": lambda: make_sim(load_model(), W, "mujoco", threads=1),
    "mujoco-2": lambda: make_sim(load_model(), W, "mujoco", threads=2),
    "warp-cpu": lambda: warp_sim("cpu"),
    "warp-cuda": lambda: warp_sim("cuda"),
    "cartpole": lambda: CartpoleSim(W),
}
GO2 = [name for name in ENGINES if name != "cartpole"]
_made: dict[str, Sim] = {}


def made(name: str) -> Sim:
    """One sim an engine for all tests, each of which begins with a reset: Warp takes a while to start."""
    if name == "warp-cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    if name not in _made:
        _made[name] = ENGINES[name]()
    return _made[name]


@pytest.fixture(params=list(ENGINES))
def sim(request: pytest.FixtureRequest) -> Sim:
    """An engine whose worlds are fresh, each in another state."""
    sim = made(request.param)
    restart(sim)
    return sim


def restart(sim: Sim) -> None:
    sim.reset(start(sim), rest(sim))


def start(sim: Sim) -> Tensor:
    """States (W, nx): the Go2 with its feet near the ground, or a cartpole near its top."""
    generator = torch.Generator().manual_seed(1)
    x = 0.02 * torch.randn(W, sim.nx, generator=generator)
    if sim.nx == 37:
        x[:, :3] = torch.tensor([0.0, 0.0, 0.333])
        x[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        x[:, 7:19] += TALL
    return x.to(sim.device, sim.dtype)


def rest(sim: Sim) -> Tensor:
    """Inputs (W, nu) that keep a world where it is."""
    u = TALL if sim.nu == 12 else torch.zeros(sim.nu)
    return u.repeat(W, 1).to(sim.device, sim.dtype)


def inputs(sim: Sim, steps: int, seed: int = 2) -> Tensor:
    """Small inputs around rest (steps, W, nu), a new one every 5 steps."""
    draws = torch.randn(steps // 5 + 1, W, sim.nu, generator=torch.Generator().manual_seed(seed))
    return rest(sim) + 0.03 * draws.repeat_interleave(5, 0)[:steps].to(sim.device, sim.dtype)


def run(sim: Sim, u: Tensor, ids: Tensor | None = None) -> Tensor:
    """States after each step of inputs (T, n, nu), (T, n, nx)."""
    out = []
    for u_k in u:
        sim.step(u_k, ids)
        out.append(sim.x(ids))
    return torch.stack(out)


def same(found: Tensor, expected: Tensor) -> bool:
    """Whether what an engine steps to is the same, bit for bit; on a GPU but for the order in which threads
    finish, which mujoco_warp's option for determinism does not rule out yet."""
    if found.device.type == "cpu":
        return torch.equal(found, expected)
    return bool((found - expected).abs().max() <= TOLERANCE["warp-cuda"] * expected.abs().max().clamp(min=1))


def index(sim: Sim, *ids: int) -> Tensor:
    return torch.tensor(ids, dtype=torch.long, device=sim.device)


def test_protocol(sim):
    assert isinstance(sim, Sim)
    assert sim.num_worlds == W
    assert sim.dt == pytest.approx(0.02)
    for tensor, width in ((sim.x(), sim.nx), (sim.u(), sim.nu)):
        assert tensor.shape == (W, width)
        assert tensor.dtype == sim.dtype
        assert tensor.device == sim.device
    ids = index(sim, 3, 0)
    assert torch.equal(sim.x(ids), sim.x()[ids])
    assert torch.equal(sim.u(ids), sim.u()[ids])
    assert torch.equal(sim.save(ids), sim.save()[ids])


def test_reset_sets_what_was_asked(sim):
    assert torch.equal(sim.x(), start(sim))
    assert torch.equal(sim.u(), rest(sim))


def test_a_step_applies_its_input(sim):
    u = inputs(sim, 1)[0]
    before = sim.x()
    sim.step(u)
    assert torch.equal(sim.u(), u)
    assert (sim.x() != before).any(1).all()


def test_results_are_copies(sim):
    before = sim.save()
    for tensor in (sim.x(), sim.u(), sim.save(), sim.x(index(sim, 1)), sim.save(index(sim, 1))):
        tensor.fill_(7.0)
    assert torch.equal(sim.save(), before)


def test_reset_forgets(sim):
    """Bit for bit the same from a used sim as from a new one: no warm start, no input, no time is left."""
    u = inputs(sim, 5)
    first = run(sim, u)
    first_rows = sim.save()
    restart(sim)
    assert same(run(sim, u), first)
    assert same(sim.save(), first_rows)


def test_reset_of_some_worlds(sim):
    run(sim, inputs(sim, 3))
    before, ids = sim.save(), index(sim, 4, 1)
    sim.reset(start(sim)[ids], rest(sim)[ids], ids)
    others = index(sim, 0, 2, 3)
    assert torch.equal(sim.x(ids), start(sim)[ids])
    assert torch.equal(sim.save(others), before[others])


def test_load_continues_bit_for_bit(sim):
    """From the middle of a motion, with a warm solver and feet on the ground."""
    run(sim, inputs(sim, 6))
    rows, u = sim.save(), inputs(sim, 5, seed=3)
    first = run(sim, u)
    first_rows = sim.save()
    sim.load(rows)
    assert torch.equal(sim.save(), rows)
    assert same(run(sim, u), first)
    assert same(sim.save(), first_rows)


def test_branches_go_the_way_of_their_parent(sim):
    """Rows loaded into other worlds, and into some of the worlds only, step to the same bits."""
    run(sim, inputs(sim, 6))
    rows, u = sim.save(), inputs(sim, 5, seed=3)
    whole = run(sim, u)

    order = index(sim, 3, 4, 0, 2, 1)
    sim.load(rows[order])
    assert same(run(sim, u[:, order]), whole[:, order])

    ids, parents = index(sim, 4, 0, 2), index(sim, 1, 1, 3)
    sim.load(rows[parents], ids)
    assert same(run(sim, u[:, parents], ids), whole[:, parents])


def test_a_step_of_some_leaves_the_others(sim):
    """The chosen worlds, in any order, do what they do among all; the others keep every bit."""
    u = inputs(sim, 4)
    whole = run(sim, u)
    restart(sim)
    before = sim.save()
    ids, others = index(sim, 3, 1), index(sim, 0, 2, 4)
    assert same(run(sim, u[:, ids], ids), whole[:, ids])
    assert torch.equal(sim.save(others), before[others])
    assert same(run(sim, u[:, others], others), whole[:, others])


def test_a_slice_is_its_indices(sim):
    """Reading, loading, restarting and stepping; the worlds outside keep every bit."""
    u, part, ids, others = inputs(sim, 4), slice(1, 4), index(sim, 1, 2, 3), index(sim, 0, 4)
    for read in (sim.x, sim.u, sim.save):
        assert torch.equal(read(part), read(ids))
    whole = run(sim, u)
    restart(sim)
    before = sim.save()
    assert same(run(sim, u[:, ids], part), whole[:, ids])
    assert torch.equal(sim.save(others), before[others])
    after = sim.save()
    sim.load(before[ids], part)
    assert torch.equal(sim.save(), torch.cat([after[:1], before[1:4], after[4:]]))
    sim.reset(start(sim)[ids], rest(sim)[ids], part)
    assert torch.equal(sim.x(part), start(sim)[ids])
    with pytest.raises(ValueError, match=r"u must be \(3, "):
        sim.step(u[0], part)


def test_a_rollout_is_its_steps(sim):
    """In one call or step by step: the same states, inputs and snapshots, in the order of the ids."""
    u, ids = inputs(sim, 6), index(sim, 3, 0, 4)
    states = rollout(sim, u[:, ids].transpose(0, 1), ids)
    reached = sim.save()
    restart(sim)
    assert same(states.transpose(0, 1), run(sim, u[:, ids], ids))
    assert same(sim.save(), reached)


@pytest.mark.parametrize("latency", [0, 1, 3, 4])
def test_inputs_come_late(latency):
    """As many physics steps, each by itself, with the inputs of a control step shifted by the latency."""
    late = MujocoSim(load_model(), W, threads=1, latency=latency)
    single = MujocoSim(load_model(), W, substeps=1, threads=1)
    u = 4 * inputs(late, 6) - 3 * rest(late)
    for sim in (late, single):
        restart(sim)
    held = torch.cat([rest(late)[None].expand(latency, -1, -1), u.repeat_interleave(4, 0)])[:24]
    reached = run(single, held)[3::4]
    assert torch.equal(run(late, u), reached)
    assert torch.equal(late.u(), u[-1]), "what was asked for last"
    after = late.save()
    restart(late)
    ids = index(late, 3, 0, 4)
    assert torch.equal(rollout(late, u[:, ids].transpose(0, 1), ids).transpose(0, 1), reached[:, ids])
    assert torch.equal(late.save(ids), after[ids])


def test_a_rollout_that_is_given_up_is_not_a_number():
    """The engine stops a world that moves too fast, whose state is finite still."""
    sim = made("mujoco-1")
    restart(sim)
    u = inputs(sim, 4).transpose(0, 1)
    whole = rollout(sim, u, index(sim, 0, 1, 2, 3, 4))
    x, others = start(sim), index(sim, 0, 1, 3, 4)
    x[2, 20] = 1e12
    sim.reset(x, rest(sim))
    states = rollout(sim, u, index(sim, 0, 1, 2, 3, 4))
    assert states[2].isnan().any()
    assert torch.equal(states[others], whole[others])


def test_a_step_of_none_does_nothing(sim):
    before = sim.save()
    sim.step(inputs(sim, 1)[0, :0], index(sim))
    assert torch.equal(sim.save(), before)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_lost_world_stays_alone(sim, bad):
    """A world that is not finite stays lost, and no other one notices; reset brings it back."""
    u = inputs(sim, 4)
    whole = run(sim, u)
    restart(sim)
    x, lost, others = start(sim), index(sim, 2), index(sim, 0, 1, 3, 4)
    x[lost, -1] = bad
    sim.reset(x, rest(sim))
    after = run(sim, u)
    assert not torch.isfinite(after[-1, lost]).all()
    assert same(after[:, others], whole[:, others])

    sim.reset(start(sim)[lost], rest(sim)[lost], lost)
    assert same(run(sim, u[:, lost], lost), whole[:, lost])


def test_wrong_arguments(sim):
    x, u, row = start(sim), rest(sim), sim.save()
    before = sim.save()
    wrong: list[tuple[str, Callable[[], None]]] = [
        ("u must be", lambda: sim.step(u[:, :-1])),
        ("u must be", lambda: sim.step(u[:1])),
        ("u must be", lambda: sim.step(u[0])),
        ("u must be", lambda: sim.step(u, index(sim, 0, 1))),
        ("x must be", lambda: sim.reset(x[:, 1:], u)),
        ("u must be", lambda: sim.reset(x, u[:2])),
        ("rows must be", lambda: sim.load(row[:, 1:])),
        ("rows must be", lambda: sim.load(row[:1], index(sim, 0, 1))),
        ("ids must be", lambda: sim.step(u, torch.ones(W, dtype=torch.bool, device=sim.device))),
    ]
    if sim.device.type == "cpu":
        wrong += [
            ("ids must be", lambda: sim.step(u[:1], index(sim, W))),
            ("ids must be", lambda: sim.step(u[:1], index(sim, -1))),
        ]
    for message, call in wrong:
        with pytest.raises(ValueError, match=message):
            call()
    assert torch.equal(sim.save(), before)


@pytest.mark.parametrize("name", GO2[1:])
def test_engines_agree(name):
    """50 control steps (200 physics steps) of landing and standing: see the tolerance in the header."""
    reference, other = made("mujoco-1"), made(name)
    for sim in (reference, other):
        restart(sim)
    # float32 start and inputs for both, so that rounding them is not counted
    x, u = start(reference).float(), inputs(reference, 50).float()
    reference.reset(x.double(), rest(reference))
    other.reset(x.to(other.device), rest(other))
    for u_k in u:
        reference.step(u_k)
        other.step(u_k.to(other.device))
        apart = (other.x().cpu().double() - reference.x()).abs().max()
        assert apart <= TOLERANCE[name]
        touch = clearances(reference.x())
        assert torch.stack([touch["thigh"], touch["calf"]]).min() > 0, "meant for robots on their feet"


@pytest.mark.parametrize("name", GO2)
def test_motor_torque(name):
    """The engine's motor torque in the last substep, against C MuJoCo's [N m]."""
    reference: Any = made("mujoco-1")  # not in the protocol: what the critic of a policy wants besides
    other: Any = made(name)
    for sim in (reference, other):
        restart(sim)
        run(sim, inputs(sim, 3))
    ids = torch.tensor([4, 1])
    torque = other.actuator_force(ids.to(other.device)).cpu().double()
    assert torch.equal(torque, other.actuator_force().cpu().double()[ids])
    assert (torque - reference.actuator_force(ids)).abs().max() <= 20 * TOLERANCE[name]
    assert torque.abs().max() > 1.0


CARTPOLE_XML = """
<mujoco><option timestep="0.02" integrator="RK4"><flag contact="disable" autoreset="disable"/></option>
<worldbody><body><joint name="p" type="slide" axis="1 0 0"/>
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  <body><joint name="theta" type="hinge" axis="0 1 0"/>
    <inertial pos="0 0 0.5" mass="0.1" diaginertia="1e-9 1e-9 1e-9"/></body>
</body></worldbody><actuator><motor joint="p" gear="10"/></actuator></mujoco>
"""


def test_cartpole_agrees_with_mujoco():
    """Its closed form against MuJoCo's multibody dynamics, both by RK4, 50 steps of a swinging pole."""
    reference = MujocoSim(mujoco.MjModel.from_xml_string(CARTPOLE_XML), W, substeps=1, threads=1)
    sim = made("cartpole")
    order = torch.tensor([1, 0, 3, 2])  # MuJoCo's joints come cart first
    x, u = start(sim), inputs(sim, 50)
    x[:, 0] += torch.linspace(0, torch.pi, W)
    sim.reset(x, rest(sim))
    reference.reset(x[:, order], rest(sim))
    assert (run(sim, u) - run(reference, u)[:, :, order]).abs().max() < 1e-6
