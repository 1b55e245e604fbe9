"""Conditions of a robot that is not the model: other bodies, noisy estimates, pushes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor

from hmc.go2.model import load_model, product
from hmc.go2.variants import VariantsCfg, draw
from hmc.sim.mujoco import MujocoSim


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

    @classmethod
    def none(cls) -> NoiseCfg:
        """No noise at all."""
        return cls(gravity=0.0, position=0.0, velocity=0.0, gyro=0.0, joint=0.0, joint_speed=0.0)

    def scaled(self, by: float) -> NoiseCfg:
        """So many times the noise."""
        parts = {each.name: by * getattr(self, each.name) for each in fields(self) if each.name != "lasting"}
        return replace(self, **parts)

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


class Robots:
    """n Go2s in the simulator, told apart from what they know of themselves.

    What one measures is noisy and shifted by its zeros; it obeys late, and with its own motors.

    Attributes:
        variants: which they are.
        sim: where they are, a world each; the targets there are what the motors make of the commanded ones.

    Args:
        conditions: where they are drawn from; of pushes the caller decides, see `push`.
        x: true states, (n, 37).
        u: last inputs as commanded, (n, 12).
        seed: of the robots and of their noise.
        threads: of the engine; 0 for all cores.
    """

    def __init__(self, conditions: Conditions, x: Tensor, u: Tensor, *, seed: int = 0, threads: int = 1):
        n = len(x)
        self._generator = torch.Generator().manual_seed(seed)
        self.variants = draw(conditions.variants, n, self._generator)
        self._zeros = torch.tensor([each.zeros for each in self.variants], dtype=torch.float64)
        self._widths, self._share = conditions.noise.widths()[:36].double(), conditions.noise.lasting
        self._lasting = self._uniform(n)
        self.sim = MujocoSim(
            load_model(),
            n,
            threads=threads,
            latency=[each.late() for each in self.variants],
            models=None if conditions.variants.nominal else [each.model() for each in self.variants],
        )
        self.sim.reset(x, u - self._zeros)

    @property
    def x(self) -> Tensor:
        """True states, (n, 37)."""
        return self.sim.x()

    @property
    def u(self) -> Tensor:
        """Inputs commanded last, (n, 12)."""
        return self.sim.u() + self._zeros

    def estimate(self) -> Tensor:
        """What they believe their states to be, (n, 37); each call draws new noise."""
        x = self.x
        error = self._widths * (self._share * self._lasting + (1 - self._share) * self._uniform(len(x)))
        turn = torch.cat([x.new_ones(len(x), 1), error[:, :3] / 2], 1)
        x[:, 3:7] = product(x[:, 3:7], turn / turn.norm(dim=1, keepdim=True))
        x[:, :3] += error[:, 3:6]
        x[:, 19:22] += error[:, 6:9]
        x[:, 22:25] += error[:, 9:12]
        x[:, 7:19] += error[:, 12:24] + self._zeros
        x[:, 25:37] += error[:, 24:36]
        return x

    def step(self, u: Tensor) -> None:
        """Obey the joint targets u (n, 12) for a control step."""
        self.sim.step(u - self._zeros)

    def push(self, speed: Tensor, direction: Tensor) -> None:
        """Give the bases `speed` [m/s] towards `direction` [rad], (n,) each."""
        self.sim.reset(pushed(self.sim.x(), speed, direction), self.sim.u())

    def _uniform(self, n: int) -> Tensor:
        return 2 * torch.rand(n, 36, generator=self._generator, dtype=torch.float64) - 1
