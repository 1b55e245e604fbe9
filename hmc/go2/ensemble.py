"""Other Go2s that the robot might be: models and starts for robust planning."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import mujoco
import torch
from torch import Tensor

from hmc.ensemble import Ensemble, Member
from hmc.go2.model import DT, SUBSTEPS, load_model
from hmc.sim.mujoco import MujocoSim


@dataclass(frozen=True)
class EnsembleCfg:
    """How the planner's models differ from the nominal one, each value uniform in its range.

    Attributes:
        members: models beside the nominal one; 0 plans on that alone.
        tail: share of the worst members that counts, see `hmc.Ensemble`.
        friction: of the feet, lowest and highest.
        payload: added to the trunk, least and most [kg].
        com: half width of the shift of the trunk's centre of mass along each axis [m].
        strength: of the motors: their torque over that of the nominal one.
        latency: by which an action comes late [s], at most a control step, in whole physics steps.
        joints: half width of an error of the estimated joint positions [rad].
        velocity: half width of an error of the estimated base velocity [m/s].
    """

    members: int = 0
    tail: float = 1.0
    friction: tuple[float, float] = (0.6, 1.0)
    payload: tuple[float, float] = (-0.5, 1.0)
    com: float = 0.02
    strength: tuple[float, float] = (0.9, 1.1)
    latency: tuple[float, float] = (0.0, 0.02)
    joints: float = 0.01
    velocity: float = 0.1

    def __post_init__(self) -> None:
        if self.members < 0:
            raise ValueError(f"ensemble.members must be >= 0, got {self.members}")
        for name in ("friction", "payload", "strength", "latency"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"ensemble.{name} must be (lowest, highest), got {low}, {high}")
        if min(self.latency) < 0 or max(self.latency) > DT:
            raise ValueError(
                f"ensemble.latency must be within 0 and a control step of {DT} s, got {self.latency}"
            )


def perturbed_model(
    friction: float = 0.8,
    payload: float = 0.0,
    com: tuple[float, float, float] = (0.0, 0.0, 0.0),
    strength: float = 1.0,
    *,
    substeps: int = SUBSTEPS,
    iterations: int | None = None,
) -> mujoco.MjModel:
    """The Go2 with another foot friction, a payload in the trunk [kg], its centre of mass shifted [m].

    The motors give `strength` times the torque, and their limits are as many times the nominal ones.
    """
    model = load_model(substeps, iterations)
    feet = [i for i in range(model.ngeom) if model.geom_priority[i] == 1]
    model.geom_friction[feet, 0] = friction
    base = model.body("base").id
    heavier = 1.0 + payload / model.body_mass[base]
    model.body_mass[base] *= heavier
    model.body_inertia[base] *= heavier
    model.body_ipos[base] += com
    # a DC motor's resistance, its controller's gains, and the limit of its torque
    model.actuator_gainprm[:, 0] /= strength
    model.actuator_gainprm[:, [4, 6]] *= strength
    model.actuator_forcerange *= strength
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def make_ensemble(
    cfg: EnsembleCfg,
    *,
    seed: int = 0,
    substeps: int = SUBSTEPS,
    iterations: int | None = None,
    threads: int = 0,
) -> Ensemble | None:
    """The nominal Go2 and `cfg.members` others; None where there are none."""
    if cfg.members == 0:
        return None
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, n: int = 1) -> Tensor:
        return low + (high - low) * torch.rand(n, generator=generator, dtype=torch.float64)

    found = [Member(partial(MujocoSim, load_model(substeps, iterations), substeps=substeps, threads=threads))]
    for _ in range(cfg.members):
        shift = uniform(-cfg.com, cfg.com, 3).tolist()
        model = perturbed_model(
            float(uniform(*cfg.friction)),
            float(uniform(*cfg.payload)),
            tuple(shift),
            float(uniform(*cfg.strength)),
            substeps=substeps,
            iterations=iterations,
        )
        error = torch.zeros(37, dtype=torch.float64)
        error[7:19], error[19:22] = (
            uniform(-cfg.joints, cfg.joints, 12),
            uniform(-cfg.velocity, cfg.velocity, 3),
        )
        late = round(float(uniform(*cfg.latency)) / model.opt.timestep)
        make_sim = partial(MujocoSim, model, substeps=substeps, threads=threads, latency=late)
        found.append(Member(make_sim, partial(_beside, error=error)))
    return Ensemble(found, cfg.tail)


def _beside(x: Tensor, u: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
    return x + error.to(x), u
