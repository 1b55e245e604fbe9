"""Other Go2s that the robot might be: models and starts for robust planning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hmc.ensemble import Ensemble
from hmc.go2.model import SUBSTEPS, Contacts, load_model
from hmc.go2.variants import VariantsCfg, draw
from hmc.sim.base import Sim
from hmc.sim.make import make_sim


@dataclass(frozen=True)
class EnsembleCfg:
    """How the planner's models differ from the nominal one.

    Attributes:
        members: models beside the nominal one; 0 plans on that alone.
        tail: share of the worst members that counts, see `hmc.Ensemble`.
        variants: the robots that they are; `zeros` are part of the error of the joint positions.
        joints: half width of an error of the estimated joint positions [rad].
        velocity: half width of an error of the estimated base velocity [m/s].
    """

    members: int = 0
    tail: float = 1.0
    variants: VariantsCfg = field(
        default_factory=lambda: VariantsCfg(
            friction=(0.6, 1.0), payload=(-0.5, 1.0), com=0.02, strength=(0.9, 1.1), latency=(0.0, 0.02)
        )
    )
    joints: float = 0.01
    velocity: float = 0.1

    def __post_init__(self) -> None:
        if self.members < 0:
            raise ValueError(f"ensemble.members must be >= 0, got {self.members}")


def make_ensemble(
    cfg: EnsembleCfg,
    *,
    seed: int = 0,
    substeps: int = SUBSTEPS,
    iterations: int | None = None,
    contacts: Contacts = "all",
    threads: int = 0,
    engine: str = "mujoco",
    device: str = "",
) -> Ensemble | None:
    """The nominal Go2 and `cfg.members` others, engine as of `hmc.go2.task.make_sim`; None for no others."""
    if cfg.members == 0:
        return None
    generator = torch.Generator().manual_seed(seed)

    def uniform(width: float, n: int) -> Tensor:
        return width * (2 * torch.rand(n, generator=generator, dtype=torch.float64) - 1)

    coarse = substeps, iterations, contacts
    models, late, errors = [load_model(*coarse)], [0], [torch.zeros(37, dtype=torch.float64)]
    for variant in draw(cfg.variants, cfg.members, generator):
        error = torch.zeros(37, dtype=torch.float64)
        # the robot is where it measures itself less the error of its zeros
        error[7:19] = uniform(cfg.joints, 12) - torch.tensor(variant.zeros, dtype=torch.float64)
        error[19:22] = uniform(cfg.velocity, 3)
        models.append(variant.model(*coarse))
        late.append(variant.late(substeps))
        errors.append(error)

    def sim(members: Sequence[int]) -> Sim:
        return make_sim(
            models[0],
            len(members),
            engine,
            device=device or None,
            substeps=substeps,
            threads=threads,
            latency=[late[i] for i in members],
            models=[models[i] for i in members],
        )

    def disturb(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + torch.stack(errors).to(x), u.expand(len(errors), -1)

    return Ensemble(len(models), sim, disturb=disturb, tail=cfg.tail)
