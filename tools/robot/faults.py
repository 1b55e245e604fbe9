"""What happens to frames on their way: delay, loss, repetition, damage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.codec import COMMAND_NUMBERS, COMMAND_SIZE, STATE_NUMBERS, seal


@dataclass(frozen=True)
class Faults:
    """Probability of each fault, for each frame on its own.

    Attributes:
        drop: it never arrives.
        duplicate: it arrives twice.
        late: it arrives `stall` later than it should, behind frames sent after it.
        stall: how much later [s].
        corrupt: some of its octets are others.
        nan: one of its numbers is not a number, under a good checksum.
    """

    drop: float = 0.0
    duplicate: float = 0.0
    late: float = 0.0
    stall: float = 0.01
    corrupt: float = 0.0
    nan: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value <= 1:
                raise ValueError(f"{name} of frames must be 0 to 1, got {value}")


class Way:
    """A way of frames in one direction.

    Args:
        faults: may be replaced at any time.
        delay: of every frame, in steps.
        step: time between two calls of `send` [s].
        rng: of the faults.
    """

    def __init__(self, faults: Faults, delay: int, step: float, rng: np.random.Generator):
        self.faults = faults
        self._delay, self._step, self._rng = delay, step, rng
        (self._damage,) = rng.spawn(1)
        self._now = 0
        self._going: list[tuple[int, bytes]] = []

    def send(self, frames: list[bytes]) -> list[bytes]:
        """Send frames; what arrives in this step, oldest first."""
        for frame in frames:
            # as many draws for every frame: one fault's probability does not change the others' pattern
            drop, duplicate, late, corrupt, nan = self._rng.random(5).tolist()
            faults = self.faults
            if drop < faults.drop:
                continue
            frame = self._not_a_number(frame) if nan < faults.nan else frame
            frame = self._corrupted(frame) if corrupt < faults.corrupt else frame
            stall = round(faults.stall / self._step) if late < faults.late else 0
            times = 2 if duplicate < faults.duplicate else 1
            self._going += [(self._now + self._delay + stall, frame)] * times
        arrived = [frame for due, frame in self._going if due <= self._now]
        self._going = [(due, frame) for due, frame in self._going if due > self._now]
        self._now += 1
        return arrived

    def _corrupted(self, frame: bytes) -> bytes:
        octets = bytearray(frame)
        for at in self._damage.integers(4, len(octets), 3):
            octets[at] ^= int(self._damage.integers(1, 256))
        return bytes(octets)

    def _not_a_number(self, frame: bytes) -> bytes:
        octets = bytearray(frame)
        words = COMMAND_NUMBERS if len(octets) == COMMAND_SIZE else STATE_NUMBERS
        np.frombuffer(octets, "<f4")[self._damage.choice(words)] = np.nan
        return seal(octets)
