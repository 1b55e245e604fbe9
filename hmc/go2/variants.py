"""Other Go2s that the robot might be: the nominal one with other friction, mass, motors and latency."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import mujoco
import torch
from torch import Tensor

from hmc.go2.model import DT, SUBSTEPS, Contacts, load_model


@dataclass(frozen=True)
class VariantsCfg:
    """How far robots may be from the nominal one, each value uniform in its range; by default not at all.

    Attributes:
        friction: of the feet, lowest and highest.
        payload: added to the trunk, least and most [kg].
        com: half width of the shift of the trunk's centre of mass along each axis [m].
        strength: of the motors: their torque over that of the nominal one.
        stiffness: kp over the nominal one.
        damping: kd over the nominal one.
        latency: by which an action comes late [s], at most a control step; rounded to physics steps.
        zeros: half width of the error of each joint's zero [rad]: the robot measures and obeys it.
    """

    friction: tuple[float, float] = (0.8, 0.8)
    payload: tuple[float, float] = (0.0, 0.0)
    com: float = 0.0
    strength: tuple[float, float] = (1.0, 1.0)
    stiffness: tuple[float, float] = (1.0, 1.0)
    damping: tuple[float, float] = (1.0, 1.0)
    latency: tuple[float, float] = (0.0, 0.0)
    zeros: float = 0.0

    def __post_init__(self) -> None:
        for name in ("friction", "payload", "strength", "stiffness", "damping", "latency"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"variants.{name} must be (lowest, highest), got {low}, {high}")
        for name in ("friction", "strength", "stiffness", "damping"):
            if getattr(self, name)[0] <= 0:
                raise ValueError(f"variants.{name} must be above 0, got {getattr(self, name)}")
        if min(self.latency) < 0 or max(self.latency) > DT:
            raise ValueError(
                f"variants.latency must be within 0 and a control step of {DT} s, got {self.latency}"
            )

    @property
    def nominal(self) -> bool:
        """Whether all robots are the nominal one."""
        return self == VariantsCfg()


@dataclass(frozen=True)
class Variant:
    """One Go2; the attributes are those of `VariantsCfg`.

    Attributes:
        com: shift of the trunk's centre of mass [m].
        zeros: what is to be added to each joint's true position for the measured one [rad].
    """

    friction: float = 0.8
    payload: float = 0.0
    com: tuple[float, ...] = (0.0, 0.0, 0.0)
    strength: float = 1.0
    stiffness: float = 1.0
    damping: float = 1.0
    latency: float = 0.0
    zeros: tuple[float, ...] = (0.0,) * 12

    def model(
        self, substeps: int = SUBSTEPS, iterations: int | None = None, contacts: Contacts = "all"
    ) -> mujoco.MjModel:
        """Its compiled model; arguments as of `load_model`. Latency and zeros are not part of it.

        The motors give `strength` times the torque, and their limits are as many times the nominal ones.
        """
        model = load_model(substeps, iterations, contacts)
        feet = [i for i in range(model.ngeom) if model.geom_priority[i] == 1]
        model.geom_friction[feet, 0] = self.friction
        base = model.body("base").id
        heavier = 1.0 + self.payload / model.body_mass[base]
        model.body_mass[base] *= heavier
        model.body_inertia[base] *= heavier
        model.body_ipos[base] += self.com
        # a DC motor's resistance, its controller's gains, and the limit of its torque
        model.actuator_gainprm[:, 0] /= self.strength
        model.actuator_gainprm[:, 4] *= self.strength * self.stiffness
        model.actuator_gainprm[:, 6] *= self.strength * self.damping
        model.actuator_forcerange *= self.strength
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def late(self, substeps: int = SUBSTEPS) -> int:
        """Its latency in physics steps."""
        return round(self.latency / DT * substeps)


def draw(cfg: VariantsCfg, n: int, generator: torch.Generator) -> list[Variant]:
    """n robots at random; each takes the same number of random values, whatever is drawn."""
    return [_one(cfg, torch.rand(21, generator=generator, dtype=torch.float64)) for _ in range(n)]


def _one(cfg: VariantsCfg, share: Tensor) -> Variant:
    """The robot at these shares (21,) of the ranges."""
    sides = (2 * share - 1).tolist()
    values: dict[str, Any] = {}
    for i, name in enumerate(
        field.name for field in fields(VariantsCfg) if field.name not in ("com", "zeros")
    ):
        low, high = getattr(cfg, name)
        values[name] = low + (high - low) * float(share[i])
    values["com"] = tuple(cfg.com * side for side in sides[6:9])
    values["zeros"] = tuple(cfg.zeros * side for side in sides[9:21])
    return Variant(**values)
