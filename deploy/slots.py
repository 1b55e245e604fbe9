"""Latest-value slots between processes: one writer, any readers, no locks, nothing left behind.

The memory is an anonymous file that children inherit by its descriptor: it has no name, so the kernel frees
it with the last process that holds it, however that ended. A slot has two buffers that are written in turn,
and a number that says which one is the newer. A reader copies it and believes what the checksum confirms; a
writer that is killed half way leaves the value before.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Mapping

import numpy as np

TEXT = 160  # octets of a reason
COUNTS = 320  # octets of counts in words

# Times are those of the monotonic clock, which all processes of a machine share [s]; ticks are control steps
# since the control process started.
HEART = np.dtype(
    # of the watchdog's the time is 0 until it has begun to look
    [("t", "f8"), ("pid", "i8"), ("commanding", "u1"), ("latched", "u1"), ("reason", f"S{TEXT}")]
)
STATE = np.dtype(
    [
        ("t", "f8"),
        ("k", "i8"),  # tick that this is the state at
        ("x", "f8", 37),  # estimate, as deploy.estimate.Estimate.x
        ("u", "f8", 12),  # joint targets commanded before it [rad]
        ("mode", "i4"),  # index of the mode that ran before it; -1: none yet
        ("entered", "i8"),  # tick at which it was entered
        ("anchor", "f8", 4),  # and where, see deploy.observe
        ("plan", "i8"),  # number of the plan that runs; 0: none
        ("asked", "i8"),  # tick at which the handstand was asked for; -1: not yet
        ("running", "u1"),  # whether modes run at all
    ]
)
STEPS = 128  # of a plan, at most
PLAN = np.dtype(
    [
        ("t", "f8"),  # when it was ready; a planner that has no plan sends number 0 to say that it is there
        ("number", "i8"),
        ("base", "i8"),  # tick of the state it was made from
        ("begin", "i8"),  # tick of its first step
        ("steps", "i4"),
        ("running", "i4"),  # index of the mode that it takes to run before its first step; -1: none
        ("modes", "i1", STEPS),  # index of each step's mode
        ("u", "f4", (STEPS, 12)),  # joint targets predicted for each step [rad]; the jump's are played
        ("cost", "f8"),
        ("seconds", "f8"),  # that it took
    ]
)
BINS = 12
STATUS = np.dtype(
    [
        ("t", "f8"),
        ("k", "i8"),
        ("phase", "u1"),
        ("mode", "i4"),
        ("plan_age", "i8"),  # ticks since the state that the running plan was made from; -1: no plan
        ("ticks", "i8"),
        ("missed", "i8"),
        ("late", "i8", BINS),  # ticks by lateness, see deploy.timing
        ("faults", f"S{COUNTS}"),  # by kind, see `tally`
        ("plans", "i8"),
        ("late_plans", "i8"),
        ("pitch", "f4"),  # deg
        ("height", "f4"),  # m
        ("charge", "u1"),  # %
        ("reason", f"S{TEXT}"),
    ]
)

_TURN = 8  # octets of the number of the newer buffer's value
_HEAD = struct.Struct("<QI4x")  # number of the value, checksum of number and value
_TRIES = 8


class Slot:
    """One value of a fixed layout, the newest that was written.

    Args:
        memory: what it lies in.
        offset: where [octets].
        kind: layout.
    """

    def __init__(self, memory: mmap.mmap, offset: int, kind: np.dtype[np.void]):
        self.kind = kind
        self._memory, self._offset = memory, offset
        # stored and loaded in one piece: struct puts zeros there first, octet by octet, for a reader to find
        self._turn = memoryview(memory)[offset : offset + _TURN].cast("Q")
        self._stride = _HEAD.size + kind.itemsize

    @staticmethod
    def size(kind: np.dtype[np.void]) -> int:
        """Octets that a slot of this layout takes, a multiple of 64."""
        return -(-(_TURN + 2 * (_HEAD.size + kind.itemsize)) // 64) * 64

    def blank(self) -> np.ndarray:
        """A value of zeros to fill in, shape ()."""
        return np.zeros((), self.kind)

    def write(self, value: np.ndarray) -> None:
        """Replace the value. Only one process may."""
        octets = value.tobytes()
        if len(octets) != self.kind.itemsize:
            raise ValueError(f"a value of {self.kind.itemsize} octets is expected here, got {len(octets)}")
        number = self.count + 1
        check = zlib.crc32(octets, number & 0xFFFFFFFF)
        at = self._at(number)
        _HEAD.pack_into(self._memory, at, number, check)
        self._memory[at + _HEAD.size : at + self._stride] = octets
        self._turn[0] = number

    def read(self) -> np.ndarray | None:
        """The newest whole value, shape (), the reader's own; None before the first."""
        for _ in range(_TRIES):
            number = self.count
            if number == 0:
                return None
            at = self._at(number)
            octets = self._memory[at : at + self._stride]
            found, check = _HEAD.unpack_from(octets)
            if found == number and zlib.crc32(octets[_HEAD.size :], number & 0xFFFFFFFF) == check:
                return np.frombuffer(octets, self.kind, 1, _HEAD.size)[0].copy()
        return None

    @property
    def count(self) -> int:
        """How many values were written; it tells whether there is a new one."""
        return self._turn[0]

    def close(self) -> None:
        """Let go of the memory."""
        self._turn.release()

    def _at(self, number: int) -> int:
        return self._offset + _TURN + (number & 1) * self._stride


class Board:
    """All slots of a run; each has one writer.

    Attributes:
        heart: control process to watchdog: that it lives, and whether it commands.
        guard: watchdog to control process: that it lives, and whether it has latched the damping.
        state: control process to planner.
        plan: planner to control process.
        status: control process to the view.

    Args:
        descriptor: of a board that a parent made; -1 makes a new one.
    """

    _LAYOUT = (("heart", HEART), ("guard", HEART), ("state", STATE), ("plan", PLAN), ("status", STATUS))

    def __init__(self, descriptor: int = -1):
        size = sum(Slot.size(kind) for _, kind in self._LAYOUT)
        if descriptor < 0:
            descriptor = os.memfd_create("hmc")
            os.truncate(descriptor, size)
        self.descriptor = descriptor
        self._memory = mmap.mmap(descriptor, size)
        slots, offset = [], 0
        for _, kind in self._LAYOUT:
            slots.append(Slot(self._memory, offset, kind))
            offset += Slot.size(kind)
        self.heart, self.guard, self.state, self.plan, self.status = self._slots = slots

    def close(self) -> None:
        """Give the memory back."""
        for slot in self._slots:
            slot.close()
        self._memory.close()
        os.close(self.descriptor)


def said(reason: object) -> str:
    """The words in a slot's value."""
    return reason.decode(errors="replace") if isinstance(reason, bytes) else ""


def text(reason: str) -> bytes:
    """A reason as it goes into a slot."""
    return reason.encode()[:TEXT]


def tally(counts: Mapping[str, int]) -> bytes:
    """Counts by kind in words as they go into a slot, the largest first; what is 0 is left out."""
    found = sorted(((count, kind) for kind, count in counts.items() if count), reverse=True)
    return ", ".join(f"{kind} {count}" for count, kind in found).encode()[:COUNTS]
