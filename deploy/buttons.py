"""Who presses the buttons in simulation: the program itself, or the keyboard."""

from __future__ import annotations

import json
import math
import os
import random
import select
import socket
import sys
import termios
import tty
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from deploy.safety import Phase

PRESS, PAUSE = 0.15, 0.6  # s that a button is held, and that follow before the next press
HOLD = 2.5  # s of the foot stand before the handstand is asked for
STAND = 4.5  # s of the handstand, then the run is over
RISEN = 120.0  # s until the foot stand: what keeps a robot from it for longer does so for good
LONGEST = 40.0  # s after asking: the planner takes its time on a busy machine
_UP = 60.0  # deg of pitch that count as upright


class Port:
    """The stand-in's port for orders."""

    def __init__(self, port: int):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))

    def press(self, *buttons: str) -> None:
        """Hold these buttons of the remote, and no others."""
        self._send(remote={"buttons": buttons})

    def push(self, force: float, direction: float, seconds: float) -> None:
        """Push the trunk with `force` [N] towards `direction` [rad] for a while."""
        self._send(push=(force * math.cos(direction), force * math.sin(direction), 0.0, seconds))

    def _send(self, **order: Any) -> None:
        with suppress(ConnectionRefusedError):  # the stand-in has ended, which the run is about to find out
            self._socket.send(json.dumps(order).encode())

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


class Presser(Protocol):
    """Who presses the buttons."""

    def see(self, status: np.ndarray) -> bool:
        """Act on the newest status; whether the run is over."""
        ...

    def close(self) -> None:
        """Nobody presses any more."""
        ...


class Operator:
    """Presses START whenever the robot waits for it, asks for the handstand, and says when all is over.

    Times are the robot's: its ticks.

    Args:
        port: the stand-in's.
        hold: of the foot stand before the handstand is asked for [s].
    """

    def __init__(self, port: Port, hold: float = HOLD):
        self._port, self._hold = port, hold
        self._pressed = False
        self._next = 0.0  # when the next action may be taken [s]
        self._since: float | None = None  # since when the robot has stood on two feet [s]
        self._asked: float | None = None

    def see(self, status: np.ndarray) -> bool:
        """Act on the newest status; whether the run is over."""
        now, phase = 0.02 * int(status["k"]), Phase(int(status["phase"]))
        if phase == Phase.DAMPING or (phase < Phase.HYBRID and now > RISEN):
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
            if stood < self._hold:
                return False
            self._asked, self._since = now, None
        self._port.press("START")
        self._pressed, self._next = True, now + PRESS
        return False

    def close(self) -> None:
        """Nothing to give back."""


KEYS = {"s": ("START",), "x": ("SELECT",), " ": ("L2", "B")}
HELP = "keys: s START, x SELECT, space L2 and B, p a push, q the end"
PUSH = 80.0, 0.1  # N and s: half a metre per second


class Keyboard:
    """Presses what is typed, see `HELP`; the run is over with q.

    Args:
        port: the stand-in's.
        terminal: descriptor of a terminal; its settings are given back by `close`.

    Raises:
        ValueError: it is no terminal.
    """

    def __init__(self, port: Port, terminal: int | None = None):
        self._terminal = sys.stdin.fileno() if terminal is None else terminal
        if not os.isatty(self._terminal):
            raise ValueError("the keyboard needs a terminal to read from: leave --keys out, or run it in one")
        self._before = termios.tcgetattr(self._terminal)
        tty.setcbreak(self._terminal)  # keys come at once, and Ctrl-C still ends the run
        self._port = port
        self._until: float | None = None  # when what is pressed is let go [s]

    def see(self, status: np.ndarray) -> bool:
        """Press what was typed since; whether the run is over."""
        now = 0.02 * int(status["k"])
        while select.select([self._terminal], [], [], 0.0)[0]:
            key = os.read(self._terminal, 1).decode(errors="replace").lower()
            if key in ("q", ""):
                return True
            if key == "p":
                self._port.push(PUSH[0], random.uniform(-math.pi, math.pi), PUSH[1])
            elif key in KEYS:
                self._port.press(*KEYS[key])
                self._until = now + PRESS
        if self._until is not None and now >= self._until:
            self._port.press()
            self._until = None
        return False

    def close(self) -> None:
        """Give the terminal its settings back."""
        termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._before)
