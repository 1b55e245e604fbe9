"""Other Go2s: their mass, balance and friction, and a flip planned on several."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from hmc import Budget, Evaluator, make_start, plan
from hmc.go2.ensemble import EnsembleCfg, make_ensemble
from hmc.go2.model import load_model, motor_torque
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import FlipCfg, JumpCfg, flip_task
from hmc.go2.variants import Variant, VariantsCfg
from hmc.rollout import roll
from hmc.sampling import SamplingCfg
from hmc.sim.mujoco import MujocoSim
from hmc.trace import roots
from hmc.worlds import Worlds
from tools.random_policy import write_random_policy


def centre_of_mass(model) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.subtree_com[0].copy()


def test_mass_and_centre_of_mass():
    nominal, other = load_model(), Variant(payload=1.5, com=(0.02, -0.01, 0.03)).model()
    total = nominal.body_mass.sum()
    assert other.body_mass.sum() == pytest.approx(total + 1.5)
    assert other.body_subtreemass[1] == pytest.approx(total + 1.5), "derived figures follow"
    trunk = nominal.body("base")
    moment = total * centre_of_mass(nominal) + 1.5 * (trunk.ipos + np.array([0.02, -0.01, 0.475]))
    moment += trunk.mass[0] * np.array([0.02, -0.01, 0.03])
    np.testing.assert_allclose(centre_of_mass(other), moment / (total + 1.5), atol=1e-12)
    same = Variant().model()
    np.testing.assert_array_equal(same.body_mass, nominal.body_mass)
    np.testing.assert_array_equal(same.geom_friction, nominal.geom_friction)


@pytest.mark.parametrize("friction", [0.3, 0.9])
def test_friction_of_the_feet_on_the_floor(friction):
    model = Variant(friction=friction).model()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.28
    data.qpos[7:] = np.tile([0.0, 0.9, -1.8], 4)
    mujoco.mj_forward(model, data)
    assert data.ncon == 4
    assert {contact.friction[0] for contact in data.contact} == {friction}


@pytest.mark.parametrize("strength", [0.9, 1.1])
def test_motors_give_so_many_times_the_torque(strength):
    """Anywhere on the torque-speed curve: driving, braking, saturated."""
    model, rng = Variant(strength=strength).model(), np.random.default_rng(0)
    data = mujoco.MjData(model)
    for _ in range(200):
        q, qd = rng.uniform(-1, 1, 12), rng.uniform(-28, 28, 12)
        target = q + rng.uniform(-1, 1, 12)
        data.qpos[:7], data.qpos[7:], data.qvel[6:], data.ctrl[:] = [0, 0, 5, 1, 0, 0, 0], q, qd, target
        mujoco.mj_forward(model, data)
        nominal = motor_torque(*(torch.tensor(each) for each in (q, qd, target))).numpy()
        np.testing.assert_allclose(data.actuator_force, strength * nominal, atol=1e-4)


def test_members_differ_and_are_the_same_for_a_seed():
    cfg = EnsembleCfg(members=3)
    ensembles = [make_ensemble(cfg, seed=seed, threads=1) for seed in (4, 4, 5)]
    x, u = FOOTSTAND.state(), torch.zeros(12, dtype=torch.float64)
    ends: list[list[torch.Tensor]] = []
    for ensemble in ensembles:
        assert ensemble is not None
        assert ensemble.size == 4
        assert ensemble.disturb is not None
        sim = ensemble.sim(1)
        sim.reset(*ensemble.disturb(x, u))
        for _ in range(5):
            sim.step(x[7:19].expand(4, -1))
        ends.append(list(sim.x()))
    for a, b, c in zip(*ends, strict=True):
        assert torch.equal(a, b)
        assert torch.equal(a, c) == (a is ends[0][0]), "only the nominal model is alike for all seeds"
    assert len({tuple(end.tolist()) for end in ends[0]}) == 4
    assert make_ensemble(EnsembleCfg()) is None


def test_all_members_have_the_planning_model_s_contacts(tmp_path):
    policy = str(write_random_policy(tmp_path / "random.onnx", hidden=(8,)))
    cfg = FlipCfg(horizon=4, foot=policy, hand=policy, ensemble=EnsembleCfg(members=2), contacts="feet")
    task = flip_task(cfg, threads=1)
    assert task.ensemble is not None
    for sim in (task.make_sim(1), task.ensemble.sim(2)):
        assert isinstance(sim, MujocoSim)
        for model in [sim.model, *(sim.batch.models or ())]:
            assert {model.geom(i).name[3:] for i in np.flatnonzero(model.geom_conaffinity)} == {"foot"}


def test_a_flip_is_planned_on_all_members(tmp_path):
    policy = str(write_random_policy(tmp_path / "random.onnx", hidden=(8,)))
    cfg = FlipCfg(horizon=4, command=2, foot=policy, hand=policy, ensemble=EnsembleCfg(members=2))
    task = flip_task(cfg, threads=1)
    x = FOOTSTAND.state()
    found = plan(task, x, u=x[7:19], samples=4, budget=Budget(draws=4))
    assert found.rollouts > 1
    assert found.control_steps % 3 == 0
    assert found.cost <= found.incumbent_cost


@pytest.mark.parametrize("threads", [1, 2])
def test_members_cost_what_each_does_alone(threads, tmp_path):
    """Bit for bit: beside the others, with its own mass, friction, motors, latency and start."""
    policy = str(write_random_policy(tmp_path / "random.onnx", hidden=(8,)))
    jump = JumpCfg(sampling=SamplingCfg(horizon=4, samples=3, knots=2, replan_every=2))
    cfg = FlipCfg(
        horizon=8, command=3, jump=jump, foot=policy, hand=policy, substeps=2, ensemble=EnsembleCfg(members=2)
    )
    task = flip_task(cfg, seed=3, threads=threads)
    ensemble, x, rows = task.ensemble, FOOTSTAND.state(), torch.randint(0, 3, (12, 8))
    rows[6:, :4] = rows[:6, :4]
    assert ensemble is not None
    sim = ensemble.sim(len(rows))
    assert isinstance(sim, MujocoSim)
    start = make_start(task, sim, x, u=x[7:19])
    worlds = Worlds(task, sim)
    with torch.no_grad():
        rolled = roll(worlds, roots(worlds, ensemble.starts(start)), rows)
    assert rolled is not None
    assert rolled.traces is not None
    for e, begin in enumerate(ensemble.starts(start)):
        late = int(sim._late[e])
        own = MujocoSim(sim.batch.models[e], len(rows), substeps=2, threads=threads, latency=late)
        alone = Evaluator(replace(task, ensemble=None), own, begin)
        assert [rolled.traces(i)[e].cost for i in range(len(rows))] == alone.costs(rows).tolist()
    both = Evaluator(task, task.make_sim(5), start)
    assert torch.equal(both.costs(rows), rolled.cost)
    bound = float(rolled.cost.median())
    pruned = Evaluator(task, task.make_sim(5), start).costs(rows, bound)
    assert torch.equal(pruned[rolled.cost <= bound], rolled.cost[rolled.cost <= bound])


def test_bad_values():
    with pytest.raises(ValueError, match=r"ensemble\.members must be >= 0, got -1"):
        EnsembleCfg(members=-1)
    with pytest.raises(ValueError, match=r"variants\.friction must be \(lowest, highest\), got 1\.0, 0\.5"):
        VariantsCfg(friction=(1.0, 0.5))
    with pytest.raises(ValueError, match=r"variants\.stiffness must be above 0, got \(0\.0, 1\.0\)"):
        VariantsCfg(stiffness=(0.0, 1.0))
    with pytest.raises(ValueError, match=r"variants\.latency must be within 0 and a control step of 0\.02 s"):
        VariantsCfg(latency=(0.0, 0.03))
