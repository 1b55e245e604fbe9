"""Who presses the buttons in simulation."""

from __future__ import annotations

import json
import os
import socket
import termios
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from deploy.buttons import HOLD, PAUSE, PRESS, RISEN, STAND, Keyboard, Operator, Port
from deploy.safety import Phase
from deploy.slots import STATUS


class Desk:
    """Where the orders come in."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(2.0)
        self.port = Port(self.socket.getsockname()[1])

    def order(self) -> Any:
        return json.loads(self.socket.recv(4096))

    def none(self) -> bool:
        self.socket.setblocking(False)
        try:
            self.socket.recv(4096)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(2.0)
        return False


@pytest.fixture
def desk() -> Iterator[Desk]:
    made = Desk()
    yield made
    made.port.close()
    made.socket.close()


def status(seconds: float, phase: Phase = Phase.HYBRID, pitch: float = 0.0) -> np.ndarray:
    made = np.zeros((), STATUS)
    made["k"], made["phase"], made["pitch"] = round(seconds / 0.02), phase, pitch
    return made


def test_the_keyboard(desk):
    ours, theirs = os.openpty()
    before = termios.tcgetattr(theirs)
    keys = Keyboard(desk.port, theirs)
    assert not keys.see(status(1.0))
    assert desk.none()
    os.write(ours, b"S")
    assert not keys.see(status(1.0))
    assert desk.order() == {"remote": {"buttons": ["START"]}}
    assert not keys.see(status(1.0 + PRESS - 0.03))
    assert desk.none()
    assert not keys.see(status(1.02 + PRESS))
    assert desk.order() == {"remote": {"buttons": []}}
    os.write(ours, b"?x p")
    assert not keys.see(status(2.0))
    assert desk.order() == {"remote": {"buttons": ["SELECT"]}}
    assert desk.order() == {"remote": {"buttons": ["L2", "B"]}}
    *force, up, seconds = desk.order()["push"]
    assert np.hypot(*force) * seconds == pytest.approx(8.0)  # N s
    assert up == 0.0
    os.write(ours, b"q")
    assert keys.see(status(2.1))
    keys.close()
    assert termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)


def test_a_keyboard_that_is_none(desk, tmp_path):
    with (tmp_path / "no").open("w+") as file, pytest.raises(ValueError, match="needs a terminal"):
        Keyboard(desk.port, file.fileno())


def test_the_operator_goes_all_the_way(desk):
    it = Operator(desk.port)
    assert not it.see(status(1.0, Phase.PASSIVE))
    assert desk.order() == {"remote": {"buttons": ["START"]}}
    assert not it.see(status(1.02 + PRESS, Phase.LIE))
    assert desk.order() == {"remote": {"buttons": []}}
    assert not it.see(status(1.0 + PRESS + PAUSE - 0.04, Phase.LIE))
    assert not it.see(status(3.0, Phase.STAND))
    assert desk.none()
    assert not it.see(status(4.0, pitch=-90))
    assert not it.see(status(4.0 + HOLD - 0.1, pitch=-90))
    assert desk.none()
    assert not it.see(status(4.0 + HOLD, pitch=-90))
    assert desk.order() == {"remote": {"buttons": ["START"]}}
    assert not it.see(status(8.0, pitch=85))
    assert not it.see(status(8.0 + STAND - 0.1, pitch=85))
    assert it.see(status(8.0 + STAND, pitch=85))
    assert it.see(status(9.0, Phase.DAMPING))


@pytest.mark.parametrize("phase", [Phase.PASSIVE, Phase.LIE, Phase.STAND, Phase.READY])
def test_the_operator_gives_up_a_robot_that_does_not_get_on(desk, phase):
    """A fault keeps it passive, or its planner hangs: START would be pressed for ever."""
    assert not Operator(desk.port).see(status(RISEN, phase))
    assert Operator(desk.port).see(status(RISEN + 0.02, phase))
    assert not Operator(desk.port, hold=1800.0).see(status(RISEN + 0.02, pitch=-90.0))
