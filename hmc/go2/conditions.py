"""Conditions of a robot that is not the model: other bodies, noisy estimates, pushes."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from hmc.go2.variants import VariantsCfg


@dataclass(frozen=True)
class NoiseCfg:
    """Half widths of the uniform noise on what the robot knows of itself.

    Attributes:
        gravity: of its direction in the body frame (unit vector).
        position: of the base [m].
        velocity: of the base [m/s].
        gyro: [rad/s].
        joint: [rad].
        joint_speed: [rad/s].
        lasting: share of the noise that stays the same over an episode; the rest is drawn at every step.
    """

    gravity: float = 0.02
    position: float = 0.02
    velocity: float = 0.05
    gyro: float = 0.1
    joint: float = 0.01
    joint_speed: float = 0.3
    lasting: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.lasting <= 1:
            raise ValueError(f"noise.lasting is a share, 0 to 1, got {self.lasting}")

    def widths(self) -> Tensor:
        """Half width of each entry of an observation (48,), see `hmc.go2.observe`."""
        body = [self.gravity] * 3 + [self.position] * 3 + [self.velocity] * 3 + [self.gyro] * 3
        return torch.tensor(body + [self.joint] * 12 + [self.joint_speed] * 12 + [0.0] * 12)


@dataclass(frozen=True)
class Conditions:
    """What a robot meets that its planner and its policies do not know.

    Attributes:
        variants: of the robot itself.
        noise: on its estimate of its state.
        push: highest speed that a push gives the base, in any horizontal direction [m/s].
        push_every: mean time between two pushes while the stance is held [s].
    """

    variants: VariantsCfg = field(default_factory=VariantsCfg)
    noise: NoiseCfg = field(default_factory=NoiseCfg)
    push: float = 0.0
    push_every: float = 3.0

    def __post_init__(self) -> None:
        if self.push < 0 or self.push_every <= 0:
            raise ValueError(
                f"push must be >= 0 m/s and push_every > 0 s, got {self.push} and {self.push_every}"
            )


def pushed(x: Tensor, speed: Tensor, direction: Tensor) -> Tensor:
    """States x (n, 37) whose base has been given `speed` [m/s] towards `direction` [rad], (n,) each."""
    x = x.clone()
    x[:, 19] += (speed * direction.cos()).to(x)
    x[:, 20] += (speed * direction.sin()).to(x)
    return x
