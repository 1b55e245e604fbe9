"""The three stages of the flip, judged from pose and contacts of a recorded run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.observe import pitch
from hmc.go2.stances import FOOTSTAND, HANDSTAND

FOOT_HOLD = 1.0  # s
HAND_REACH = 3.0  # s after the last entry of the hand mode that led to it
HAND_HOLD = 3.0  # s
FLIP_FROM, FLIP_TO = -math.radians(60), math.radians(60)
UPSIDE_DOWN = math.radians(150)  # beyond, the robot went over backwards


@dataclass(frozen=True)
class Stages:
    """What a run reached.

    Attributes:
        foot_stand: the foot stand was held for at least 1 s without a break.
        jump_flip: pitch passed from -60 to +60 degrees with neither trunk nor thigh nor shin on the ground.
        handstand: reached within 3 s of the switch into the hand mode, then held for at least 3 s.
    """

    foot_stand: bool
    jump_flip: bool
    handstand: bool

    @property
    def success(self) -> bool:
        """All three."""
        return self.foot_stand and self.jump_flip and self.handstand


def judge(x: Tensor, modes: Tensor, dt: float, hand: int) -> Stages:
    """Judge a run.

    Args:
        x: states (n + 1, 37), before each of n steps and after the last.
        modes: mode of each step (n,).
        dt: control step [s].
        hand: index of the hand mode.
    """
    x = x.double()
    foot, held = FOOTSTAND.held(x), HANDSTAND.held(x)
    gap = go2.clearances(x)
    clean = (gap["trunk"] > 0) & (gap["thigh"] > 0).all(1) & (gap["calf"] > 0).all(1)
    return Stages(
        foot_stand=_longest(foot) * dt >= FOOT_HOLD,
        jump_flip=_flipped(pitch(x), clean),
        handstand=_reached(held, modes == hand, dt),
    )


def _longest(true: Tensor) -> int:
    """Length of the longest run of steps between true states."""
    best = run = 0
    for value in true.tolist():
        run = run + 1 if value else 0
        best = max(best, run)
    return max(best - 1, 0)


def _flipped(angle: Tensor, clean: Tensor) -> bool:
    """Whether the pitch passes from below -60 to above +60 degrees over 0, clean all the way."""
    armed = False
    for value, ok in zip(angle.tolist(), clean.tolist(), strict=True):
        if not ok or abs(value) > UPSIDE_DOWN:
            armed = False
        elif value <= FLIP_FROM:
            armed = True
        elif armed and value >= FLIP_TO:
            return True
    return False


def _reached(held: Tensor, in_hand: Tensor, dt: float) -> bool:
    """Whether some entry into the hand mode is followed by a hold of 3 s that begins within 3 s."""
    entered = in_hand & ~torch.cat([in_hand.new_zeros(1), in_hand[:-1]])
    need, reach = round(HAND_HOLD / dt), round(HAND_REACH / dt)
    for entry in entered.nonzero().flatten().tolist():
        run = 0
        for step in range(entry, len(held)):
            run = run + 1 if held[step] else 0
            if run > need:
                return True
            if run == 0 and step - entry >= reach:
                break
    return False
