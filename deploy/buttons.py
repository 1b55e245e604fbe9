"""Who presses the buttons in simulation: the program itself, through the stand-in's port for orders."""

from __future__ import annotations

import json
import socket

import numpy as np

from deploy.safety import Phase

PRESS, PAUSE = 0.15, 0.6  # s that a button is held, and that follow before the next press
HOLD = 2.5  # s of the foot stand before the handstand is asked for
STAND = 4.5  # s of the handstand, then the run is over
LONGEST = 40.0  # s after asking: the planner takes its time on a busy machine
_UP = 60.0  # deg of pitch that count as upright


class Port:
    """The stand-in's port for orders."""

    def __init__(self, port: int):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))

    def press(self, *buttons: str) -> None:
        """Hold these buttons of the remote, and no others."""
        self._socket.send(json.dumps({"remote": {"buttons": buttons}}).encode())

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


class Operator:
    """Presses START whenever the robot waits for it, asks for the handstand, and says when all is over.

    Times are the robot's: its ticks.
    """

    def __init__(self, port: Port):
        self._port = port
        self._pressed = False
        self._next = 0.0  # when the next action may be taken [s]
        self._since: float | None = None  # since when the robot has stood on two feet [s]
        self._asked: float | None = None

    def see(self, status: np.ndarray) -> bool:
        """Act on the newest status; whether the run is over."""
        now, phase = 0.02 * int(status["k"]), Phase(int(status["phase"]))
        if phase == Phase.DAMPING:
            return True
        if self._pressed and now >= self._next:
            self._port.press()
            self._pressed, self._next = False, now + PAUSE
        angle = float(status["pitch"])
        wanted = angle > _UP if self._asked is not None else angle < -_UP
        self._since = (now if self._since is None else self._since) if wanted else None
        stood = 0.0 if self._since is None else now - self._since
        if self._asked is not None:
            return stood >= STAND or now - self._asked > LONGEST
        if self._pressed or now < self._next or phase == Phase.STAND:
            return False
        if phase == Phase.HYBRID:
            if stood < HOLD:
                return False
            self._asked, self._since = now, None
        self._port.press("START")
        self._pressed, self._next = True, now + PRESS
        return False
