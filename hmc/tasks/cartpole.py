"""Cartpole swing-up, the paper's first experiment: the modes are constant forces."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hmc.cost import Cost
from hmc.modes import ConstantInput, ModeSet
from hmc.sim.cartpole import CartpoleParams, CartpoleSim
from hmc.task import Task


@dataclass(frozen=True)
class CartpoleCfg:
    """Values of the swing-up task; weights as printed in the paper, section V, the rest is ours.

    Attributes:
        horizon: T [control steps].
        dt: control step [s].
        substeps: integration steps a control step.
        num_modes: inputs, uniformly spaced over -1 to 1 (times `CartpoleParams.gear`, in N).
        angle: start angle from upright [rad]; pi hangs. The paper's text says pi / 2.
        weight_angle: on (cos(theta) - 1)^2.
        weight_position: on p^2, p in m.
        weight_velocity: on theta_dot^2 + p_dot^2, in rad/s and m/s.
        weight_input: on u^2, u in units of the gear.
        weight_final: on (cos(theta) - 1)^2 at the end.
        params: masses, lengths and force limit.
    """

    horizon: int = 100
    dt: float = 0.02
    substeps: int = 1
    num_modes: int = 5
    angle: float = math.pi
    weight_angle: float = 4.0
    weight_position: float = 0.1
    weight_velocity: float = 0.1
    weight_input: float = 1.0
    weight_final: float = 4.0
    params: CartpoleParams = field(default_factory=CartpoleParams)

    def __post_init__(self) -> None:
        if self.num_modes < 2:
            raise ValueError(f"cartpole num_modes must be at least 2 inputs, got {self.num_modes}")


def cartpole(cfg: CartpoleCfg | None = None) -> Task:
    r"""The swing-up task.

    l(x, u) = 4 (cos(theta) - 1)^2 + 0.1 p^2 + 0.1 (theta_dot^2 + p_dot^2) + u^2 and
    c_f(x) = 4 (cos(theta) - 1)^2.
    """
    cfg = cfg or CartpoleCfg()
    levels = torch.linspace(-1.0, 1.0, cfg.num_modes, dtype=torch.float64).tolist()
    return Task(
        name="cartpole",
        modes=ModeSet([ConstantInput(f"{cfg.params.gear * level:.3g} N", level) for level in levels]),
        cost=Cost(
            stage={
                "angle": lambda x, u, u_prev, k: cfg.weight_angle * (x[:, 0].cos() - 1).square(),
                "position": lambda x, u, u_prev, k: cfg.weight_position * x[:, 1].square(),
                "velocity": lambda x, u, u_prev, k: (
                    cfg.weight_velocity * (x[:, 2].square() + x[:, 3].square())
                ),
                "input": lambda x, u, u_prev, k: cfg.weight_input * u[:, 0].square(),
            },
            terminal={"final angle": lambda x, k: cfg.weight_final * (x[:, 0].cos() - 1).square()},
            nonnegative=True,
            on_cpu=partial(_in_numpy, cfg),
        ),
        horizon=cfg.horizon,
        make_sim=lambda n: CartpoleSim(n, cfg.params, dt=cfg.dt, substeps=cfg.substeps),
    )


def _in_numpy(cfg: CartpoleCfg, x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor) -> Tensor:
    """The stage terms of `cartpole`, (n, 4): the same to the bit, in place."""
    terms = np.empty((4, len(x)))
    angle, position, velocity, effort = terms
    theta, p, theta_dot, p_dot = x.numpy().T
    torch.cos(torch.from_numpy(theta), out=torch.from_numpy(angle))
    angle -= 1
    for rates, term in ((angle, angle), (p, position), (theta_dot, velocity), (p_dot, effort)):
        np.multiply(rates, rates, out=term)
    velocity += effort
    force = u[:, 0].numpy()
    np.multiply(force, force, out=effort)
    weights = cfg.weight_angle, cfg.weight_position, cfg.weight_velocity, cfg.weight_input
    for term, weight in zip((angle, position, velocity, effort), weights, strict=True):
        term *= weight
    return torch.from_numpy(terms).T


def initial_state(cfg: CartpoleCfg | None = None) -> Tensor:
    """At rest in the middle of the rail with the pole at the start angle, (4,)."""
    return torch.tensor([(cfg or CartpoleCfg()).angle, 0.0, 0.0, 0.0], dtype=torch.float64)
