"""Cartpole swing-up, the paper's first experiment: the modes are constant forces."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hmc.cost import Cost
from hmc.modes import ConstantInput, Mode, ModeSet
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
        tail_bound=TailBound(cfg),
    )


class TailBound:
    r"""What the swing-up costs at least while one force F acts to the end of the horizon.

    On a cart that is pushed evenly the pole swings as in a field of gravity that leans: with
    a = F / (M + m) and mu = m / (M + m),

        H = l / 2 (1 - mu cos(theta)^2) theta_dot^2 + g cos(theta) + a sin(theta)

    stays what it is. The first term is not negative, so the pole keeps out of an arc about the direction
    phi = atan(a / g): cos(theta - phi) <= H / sqrt(g^2 + a^2), and what is left of the horizon costs at
    least what the edge of the arc that is nearer to upright costs, and the input. The Runge-Kutta steps
    do not keep H quite: the most that one of them adds, anywhere where H bounds something, is looked for
    on a grid and allowed for twice.
    """

    def __init__(self, cfg: CartpoleCfg):
        self._cfg, self._sim = cfg, CartpoleSim(1, cfg.params, dt=cfg.dt, substeps=cfg.substeps)
        c = cfg.params
        self._share = c.pole_mass / (c.cart_mass + c.pole_mass)
        self._fields: dict[float, tuple[float, float, float]] = {}  # by input, once it was asked for

    def __call__(self, mode: Mode, x: Tensor, k: Tensor, steps: int) -> Tensor | None:
        """Of states x (n, 4) with `steps` to go, (n,); None for modes that are no constant input."""
        if type(mode) is not ConstantInput:
            return None
        cfg, u = self._cfg, mode.value
        if u not in self._fields:
            self._fields[u] = self._field(u)
        pull, lean, drift = self._fields[u]
        reach = (self._kept(x, pull, lean).add_(steps * drift)).div_(pull)
        fall = reach.clamp_(-1, 1).acos_().sub_(abs(lean)).clamp_(min=0).cos_().sub_(1).square_()
        time = steps * cfg.dt
        fall *= cfg.weight_angle * time + cfg.weight_final
        return fall.add_(cfg.weight_input * u * u * time)

    def _kept(self, x: Tensor, pull: float, lean: float) -> Tensor:
        """H of states x (n, 4) [m/s^2], (n,)."""
        theta, half = x[:, 0], self._cfg.params.pole_length / 2
        swing = theta.cos().square_().mul_(-half * self._share).add_(half).mul_(x[:, 2].square())
        return swing.add_((theta - lean).cos_(), alpha=pull)

    def _field(self, u: float) -> tuple[float, float, float]:
        """Under input u: strength of the leaning gravity [m/s^2], its angle from upright [rad], and twice the
        most that one control step adds to H [m/s^2], where it is below its bound."""
        c = self._cfg.params
        sideways = c.gear * u / (c.cart_mass + c.pole_mass)
        pull, lean = math.hypot(c.gravity, sideways), math.atan2(sideways, c.gravity)
        theta, share = torch.meshgrid(
            torch.linspace(-math.pi, math.pi, 181, dtype=torch.float64),
            torch.linspace(-1, 1, 101, dtype=torch.float64),
            indexing="ij",
        )
        heavy = c.pole_length / 2 * (1 - self._share * theta.cos().square())
        fastest = (pull * (1 - (theta - lean).cos()) / heavy).sqrt()
        x = torch.zeros(theta.numel(), 4, dtype=torch.float64)
        x[:, 0], x[:, 2] = theta.flatten(), (share * fastest).flatten()
        after = self._sim.advance(x, torch.full((len(x), 1), u, dtype=torch.float64))
        added = float((self._kept(after, pull, lean) - self._kept(x, pull, lean)).max())
        return pull, lean, 2 * max(0.0, added)


def _in_numpy(cfg: CartpoleCfg, x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor) -> Tensor:
    """The stage terms of `cartpole`, (n, 4): the same to the bit, in place."""
    terms = np.empty((4, len(x)))
    angle, position, velocity, effort = terms
    theta, p, theta_dot, p_dot = x.numpy().T
    torch.cos(torch.from_numpy(theta), out=torch.from_numpy(angle))
    angle -= 1
    force = u[:, 0].numpy()
    weights = cfg.weight_angle, cfg.weight_position, cfg.weight_velocity, cfg.weight_input
    with np.errstate(over="ignore", invalid="ignore"):  # who asks counts what diverged
        for rates, term in ((angle, angle), (p, position), (theta_dot, velocity), (p_dot, effort)):
            np.multiply(rates, rates, out=term)
        velocity += effort
        np.multiply(force, force, out=effort)
        for term, weight in zip((angle, position, velocity, effort), weights, strict=True):
            term *= weight
    return torch.from_numpy(terms).T


def initial_state(cfg: CartpoleCfg | None = None) -> Tensor:
    """At rest in the middle of the rail with the pole at the start angle, (4,)."""
    return torch.tensor([(cfg or CartpoleCfg()).angle, 0.0, 0.0, 0.0], dtype=torch.float64)
