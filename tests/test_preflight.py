"""What keeps the control process from starting, with a robot's topics on the loopback interface."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy import loop
from deploy.codec import encode_state
from deploy.dds import Link
from deploy.loop import Refusal, preflight
from deploy.messages import LowCmd_, LowState_
from deploy.motion_switcher import MotionSwitcherService
from deploy.settings import DeployCfg, InputCfg
from hmc.go2 import facts
from tests import wire

DOMAIN = 125 + os.getpid() % 100
CFG = DeployCfg(input=InputCfg(min_charge=20))
LYING = np.tile(CFG.lie.pose, 4) + 0.3


@pytest.fixture(autouse=True)
def _soon(monkeypatch) -> None:
    monkeypatch.setattr(loop, "HEARD", 1.0)


@contextmanager
def robot(
    charge: int = 80, controller: str = "", q: np.ndarray = LYING, broken: bool = False
) -> Iterator[MotionSwitcherService]:
    """States at 500 Hz and a motion switcher."""
    link, stop = Link(DOMAIN), threading.Event()
    states, service = link.publisher("rt/lowstate", LowState_), MotionSwitcherService(link, controller)

    def run() -> None:
        tick = 0
        while not stop.is_set():
            tick += 2
            frame = bytearray(encode_state(wire.state()._replace(tick=tick, charge=charge, q=q)))
            frame[500] ^= broken
            states.write(bytes(frame))
            service.serve()
            time.sleep(0.002)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield service
    finally:
        stop.set()
        thread.join()


def start(release: bool = False, dry_run: bool = False) -> None:
    link = Link(DOMAIN)
    preflight(link, link.subscriber("rt/lowstate", LowState_), CFG, release, dry_run)


def test_no_robot() -> None:
    with pytest.raises(Refusal, match="no state frame within 1 s"):
        start()


def test_a_second_controller() -> None:
    with robot():
        other = Link(DOMAIN).publisher("rt/lowcmd", LowCmd_)
        with pytest.raises(Refusal, match=rf"another program commands the motors: .*{os.getpid()}"):
            start()
        del other


def test_a_low_battery() -> None:
    with robot(charge=19), pytest.raises(Refusal, match="the battery has 19 %, at least 20 % is needed"):
        start()


def test_the_robots_own_controller() -> None:
    """It is refused, or stopped where that was asked for."""
    with robot(controller="mcf") as service:
        with pytest.raises(Refusal, match="own controller 'mcf' runs: lay the robot down"):
            start()
        assert service.name == "mcf"
        start(release=True)
        assert service.name == ""
        start()


def test_a_robot_that_stands_is_not_dropped() -> None:
    """Its own controller is not stopped while the legs carry it."""
    standing = np.array(facts.HOME)
    with robot(controller="mcf", q=standing) as service:
        with pytest.raises(Refusal, match=r"does not lie: .._calf is 0.9 rad off .* lay it down first"):
            start(release=True)
        assert service.name == "mcf"


def test_a_dry_run_asks_nothing_of_the_robot() -> None:
    """Neither is its controller stopped nor does another one matter, or the battery."""
    with robot(charge=1, controller="mcf") as service:
        other = Link(DOMAIN).publisher("rt/lowcmd", LowCmd_)
        start(release=True, dry_run=True)
        assert service.name == "mcf"
        del other


def test_frames_of_another_robot() -> None:
    with robot(broken=True), pytest.raises(Refusal, match="no state frame has a right checksum"):
        start()
