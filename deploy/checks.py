"""What comes in from the robot: which frames are believed, and when there are too few of them."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from deploy.codec import FrameError, RobotState, decode_state
from deploy.remote import ABSENT
from deploy.settings import InputCfg
from deploy.timing import Silence
from hmc.go2.network import LOWER, UPPER

_WRAP = 2**32
_LOOK = 0.01  # s between two looks for frames, at most, while the machine does not stand still
_RESTART = 1000  # ms that the robot's clock may seem to go back before the robot has restarted
# numbers of a state, in order, and where each ends among all
_NAMES = ("attitude", "angles", "gyroscope", "accelerometer", "joints", "joint speeds", "torques")
_SIZES = (4, 3, 3, 3, 12, 12, 12)
_ENDS = np.cumsum(_SIZES)
_TURN = 2 * math.pi  # rad, more than an angle of roll, pitch and yaw has


class StateChecks:
    """Judges state frames one by one: a bad one is dropped and counted, too many in a row are a fault.

    Attributes:
        counts: frames by what was wrong with them, and "gap" for the frames that never came.
        ms: the robot's clock at the last good frame, without its overflow [ms].

    Args:
        cfg: limits.
    """

    def __init__(self, cfg: InputCfg):
        self.cfg = cfg
        self.counts: Counter[str] = Counter()
        self.ms = 0
        self._silence = Silence(cfg.max_age, cfg.stall, _LOOK)
        self._fault = ""
        self._last = ""
        self._imu, self._moved = b"", 0  # its last readings, and ms of the first frame with them
        self._remote: int | None = None  # ms of the last frame with a remote, or of the first frame
        margin = (UPPER - LOWER) / 2 + cfg.joint_margin
        speed, torque = np.full(12, cfg.joint_speed), np.full(12, cfg.torque)
        angles = np.full(4, 1.1), np.full(3, _TURN)
        self._width = np.concatenate(
            (*angles, np.full(3, cfg.gyro), np.full(3, cfg.acc), margin, speed, torque)
        )
        self._middle = np.zeros(len(self._width))
        self._middle[13:25] = (UPPER + LOWER) / 2

    @property
    def heard(self) -> float:
        """When the last good frame came [s]; -inf before the first."""
        return self._silence.heard

    def take(self, frame: bytes, now: float) -> RobotState | None:
        """The state in a frame that came `now` [s], or None if it is not believed."""
        try:
            state = decode_state(frame)
        except FrameError:
            self._refuse("no LowState frame")
            return None
        ahead = (state.tick - self.ms + _WRAP // 2) % _WRAP - _WRAP // 2
        first = not math.isfinite(self.heard)
        wrong = "" if state.crc_ok else "checksum"
        if wrong := wrong or self._range(state) or ("" if first else self._order(ahead)):
            self._refuse(wrong)
            return None
        if first:
            self.ms = state.tick
        else:
            self.counts["gap"] += max(0, ahead // 2 - 1)  # steps of 1 and 3 ms lose nothing
            self.ms += ahead
        self._silence.hear(now)
        if state.remote != ABSENT or self._remote is None:
            self._remote = self.ms
        imu = state.gyro.tobytes() + state.acc.tobytes()
        if imu != self._imu:
            self._imu, self._moved = imu, self.ms
        elif self.ms - self._moved > 1000 * self.cfg.frozen:
            self._fault = f"the IMU has told the same for {self.ms - self._moved} ms: is it broken?"
        if (hottest := int(state.temperature.max())) > self.cfg.temperature:
            self._fault = f"a motor has {hottest} deg C, allowed are {self.cfg.temperature:g}: let it cool"
        return state

    def fault(self, now: float) -> str:
        """Why the robot cannot be believed any more; "" while it can."""
        if self._fault:
            return self._fault
        if not self._silence.too_long(now):
            alone = 0.001 * (self.ms - (self.ms if self._remote is None else self._remote))
            if alone <= self.cfg.remote:
                return ""
            return f"no remote for {alone:.1f} s: turn it on and go near, it is what stops the robot"
        age = f"for {1e3 * (now - self.heard):.0f} ms" if math.isfinite(self.heard) else "yet"
        last = f" (the last one refused: {self._last})" if self._last else ""
        return f"no good state frame {age}{last}"

    def _refuse(self, reason: str) -> None:
        self.counts[reason] += 1
        self._last = reason

    def _order(self, ahead: int) -> str:
        """What is wrong with a frame so many ms after the last good one."""
        if ahead < -_RESTART:
            self._fault = f"the robot's clock went back by {-ahead} ms: it restarted"
        return "repeated" if ahead == 0 else "out of order" if ahead < 0 else ""

    def _range(self, state: RobotState) -> str:
        """What of a frame cannot be; comparisons are written so that NaN fails them."""
        # one comparison for all numbers: most frames are good, and what is wrong can be found out afterwards
        numbers = np.concatenate((state.quat, state.rpy, state.gyro, state.acc, state.q, state.dq, state.tau))
        fits = np.abs(numbers - self._middle) <= self._width
        if fits.all() and 0.9 < float(state.quat @ state.quat) < 1.1:
            return ""
        if not np.isfinite(numbers).all():
            return "not a number"
        wrong = np.flatnonzero(~fits)
        what = int(np.searchsorted(_ENDS, wrong[0], side="right")) if len(wrong) else 0
        return f"range of the {_NAMES[what]}"
