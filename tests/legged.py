"""A robot of pure kinematics for the estimator's tests: it stands still, its readings are exact or noisy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from deploy import so3
from deploy.ekf import GRAVITY
from deploy.estimate import Estimate
from deploy.estimator import Estimator
from deploy.kinematics import FOOT_RADIUS, legs
from hmc.go2 import model as go2
from hmc.go2.stances import FOOTSTAND, HANDSTAND

DT = 0.002
WEIGHT = 149.0
STANDS = {
    "home": (go2.HOME.double().numpy(), 0.0, (0, 1, 2, 3)),
    "footstand": (FOOTSTAND.pose.double().numpy(), -np.pi / 2, (2, 3)),
    "handstand": (HANDSTAND.pose.double().numpy(), np.pi / 2, (0, 1)),
}


@dataclass
class Stand:
    """Readings of a still robot, tick by tick; a test changes what it wants to.

    Attributes:
        q, pitch, feet: joints (12,), pitch [rad], legs that stand.
        gyro_bias, acc_bias: (3,).
        noise: 1 for the estimator's noise on all readings, 0 for none.
    """

    q: np.ndarray
    pitch: float
    feet: tuple[int, ...]
    gyro_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    acc_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        self.C = so3.exp(np.array([0.0, self.pitch, 0.0]))
        self.rng = np.random.default_rng(self.seed)
        self.t = 10.0  # the robot's clock does not begin with us

    @property
    def height(self) -> float:
        """Of the base [m]."""
        foot = legs(self.q).foot[list(self.feet)] @ self.C[2]
        return float(FOOT_RADIUS - foot.mean())

    def readings(self) -> dict[str, np.ndarray]:
        """The next tick's, as keyword arguments of the estimator."""
        self.t += DT
        force, up = np.zeros(4), self.C[2]
        force[list(self.feet)] = WEIGHT / len(self.feet)
        tau = -(legs(self.q).jacobian.transpose(0, 2, 1) @ (force[:, None] * up)[:, :, None]).reshape(12)
        clean = {
            "gyro": self.gyro_bias,
            "acc": GRAVITY * up + self.acc_bias,
            "q": self.q,
            "qd": np.zeros(12),
            "tau": tau,
            "force": force,
        }
        sigma = {"gyro": 0.01, "acc": 0.1, "q": 1e-4, "qd": 0.05, "tau": 0.2, "force": 1.5}
        return {
            key: value + self.noise * sigma[key] * self.rng.normal(size=len(value))
            for key, value in clean.items()
        }

    def run(self, estimator: Estimator, seconds: float, **changed: np.ndarray) -> Estimate:
        """Feed so many seconds, with some readings replaced; the last estimate."""
        last = None
        for _ in range(round(seconds / DT)):
            last = estimator.update(**{"t": self.t + DT, **self.readings(), **changed})
        assert last is not None, "the estimator has begun"
        return last


def stand(name: str, **settings: object) -> Stand:
    """A still stand by name."""
    return Stand(*STANDS[name], **settings)
