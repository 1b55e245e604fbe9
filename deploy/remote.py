"""The hand-held remote: the 40 octets that every LowState frame carries of it.

Source: the xRockerBtnDataStruct of unitree_sdk2: buttons as 16 bits from octet 2, then the sticks.
"""

from __future__ import annotations

import struct
from enum import IntFlag
from typing import NamedTuple

SIZE = 40
ABSENT = bytes(SIZE)  # what a robot tells that has no remote near
_HEAD = 0x5155  # of ours: some octet of a remote that is near is not zero
_LAYOUT = struct.Struct("<HH3f4xf16x")  # head, buttons, lx, rx, ry, (analogue L2,) ly


class Button(IntFlag):
    """Buttons of the remote, a bit each."""

    R1 = 1 << 0
    L1 = 1 << 1
    START = 1 << 2
    SELECT = 1 << 3
    R2 = 1 << 4
    L2 = 1 << 5
    F1 = 1 << 6
    F3 = 1 << 7
    A = 1 << 8
    B = 1 << 9
    X = 1 << 10
    Y = 1 << 11
    UP = 1 << 12
    RIGHT = 1 << 13
    DOWN = 1 << 14
    LEFT = 1 << 15


class Remote(NamedTuple):
    """Pressed buttons, and the sticks from -1 to 1: x to the right, y forward."""

    buttons: Button = Button(0)
    lx: float = 0.0
    ly: float = 0.0
    rx: float = 0.0
    ry: float = 0.0


def pack(remote: Remote) -> bytes:
    """The octets that carry the remote, (40)."""
    return _LAYOUT.pack(_HEAD, remote.buttons, remote.lx, remote.rx, remote.ry, remote.ly)


def unpack(octets: bytes) -> Remote:
    """The remote in its octets; ValueError if they are not 40. One that is not near presses nothing."""
    if len(octets) != SIZE:
        raise ValueError(f"the remote's part of a LowState frame has {SIZE} octets, got {len(octets)}")
    _, buttons, lx, rx, ry, ly = _LAYOUT.unpack(octets)
    return Remote(Button(buttons), lx, ly, rx, ry)
