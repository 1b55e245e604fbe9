"""The two stances and the four-legged stand, and what counts as standing in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.go2 import model as go2

MIN_HEIGHT = 0.45  # m, base
MIN_STAND = 0.22  # m, base on four legs
MAX_TILT = math.radians(20.0)
TOUCH = 0.01  # m: a foot that is nearer to the ground stands on it


@dataclass(frozen=True)
class Stance:
    """Standing on two feet with the body's x axis vertical.

    Attributes:
        name: of the mode that holds it.
        sign: +1 nose down (pitch +90 degrees), -1 nose up.
        pose: joint positions [rad], (12,), balanced over the supporting feet.
        support: legs that stand, as indices into `LEGS`.
        free: the other two.
    """

    name: str
    sign: int
    pose: Tensor
    support: tuple[int, int]
    free: tuple[int, int]

    @property
    def swing(self) -> slice:
        """The free legs as a slice of `LEGS`."""
        return slice(self.free[0], self.free[1] + 1)

    @property
    def standing(self) -> slice:
        """The supporting legs likewise."""
        return slice(self.support[0], self.support[1] + 1)

    def uprightness(self, x: Tensor) -> Tensor:
        """Cosine of the angle between the body's x axis and this stance's vertical, (n,)."""
        return -self.sign * go2.vertical(x[:, 3:7])[:, 0]

    def held(self, x: Tensor, gap: dict[str, Tensor] | None = None) -> Tensor:
        """Whether the robot stands in it for real, (n,) bool.

        On the two supporting feet only: trunk, thighs, shins and the other feet off the ground, base
        above 0.45 m, body axis within 20 degrees of vertical. A robot on its shins does not count.

        Args:
            x: state (n, 37).
            gap: `clearances` of x, if they are known.
        """
        gap = gap or go2.clearances(x)
        clear = (gap["trunk"] > 0) & (gap["thigh"] > 0).all(1) & (gap["calf"] > 0).all(1)
        clear &= (gap["foot"][:, self.swing] > 0).all(1)
        return clear & (x[:, 2] > MIN_HEIGHT) & (self.uprightness(x) > math.cos(MAX_TILT))

    def state(self) -> Tensor:
        """The balanced state at rest, (37,), float64."""
        half = self.sign * math.pi / 4
        x = torch.zeros(37, dtype=torch.float64)
        x[2] = go2.STANCE_HEIGHT
        x[3], x[5] = math.cos(half), math.sin(half)
        x[7:19] = self.pose
        return x


@dataclass(frozen=True)
class Stand:
    """Standing on all four feet.

    Attributes:
        pose: joint positions [rad], (12,).
    """

    pose: Tensor

    def held(self, x: Tensor, gap: dict[str, Tensor] | None = None) -> Tensor:
        """Whether the robot stands on its four feet, (n,) bool.

        All of them on the ground; trunk, thighs and shins off it, base above 0.22 m, within 20 degrees of
        level.

        Args:
            x: state (n, 37).
            gap: `clearances` of x, if they are known.
        """
        gap = gap or go2.clearances(x)
        clear = (gap["trunk"] > 0) & (gap["thigh"] > 0).all(1) & (gap["calf"] > 0).all(1)
        clear &= (gap["foot"] < TOUCH).all(1) & (x[:, 2] > MIN_STAND)
        return clear & (go2.vertical(x[:, 3:7])[:, 2] > math.cos(MAX_TILT))

    def state(self) -> Tensor:
        """The state at rest, (37,), float64."""
        x = torch.zeros(37, dtype=torch.float64)
        x[2], x[3] = go2.HOME_HEIGHT, 1.0
        x[7:19] = self.pose
        return x


HANDSTAND = Stance("handstand", +1, go2.HANDSTAND, go2.FRONT, go2.REAR)
FOOTSTAND = Stance("footstand", -1, go2.FOOTSTAND, go2.REAR, go2.FRONT)
STANCES = {stance.name: stance for stance in (HANDSTAND, FOOTSTAND)}
STAND = Stand(go2.HOME)
# half way between the poses of the stances, which no robot stands in
BETWEEN = Stand((go2.FOOTSTAND + go2.HANDSTAND) / 2)
# what the learned modes hold, or return to
HOLDS: dict[str, Stance | Stand] = {
    **STANCES,
    **dict.fromkeys(("stand", "getup", "walk"), STAND),
    "unified": BETWEEN,
}
