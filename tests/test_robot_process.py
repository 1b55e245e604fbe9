"""The stand-in as a process of its own, met as a controller meets the robot."""

from __future__ import annotations

import gc
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy.codec import RobotState, decode_state, encode_command
from deploy.dds import Link, LinkError, Publisher, Subscriber
from deploy.messages import LowCmd_, LowState_, WirelessController_
from deploy.motion_switcher import MotionSwitcher
from deploy.remote import Button, unpack
from hmc.cli import command_line
from hmc.go2 import model as go2
from tools.go2_robot import main
from tools.robot.motors import hold
from tools.robot.orders import Desk, obey
from tools.robot.process import LATEST, Args, Clock, Log, run
from tools.robot.standin import Settings, StandIn, Truth, ideal

ROOT = Path(__file__).parent.parent
DOMAIN = 120 + os.getpid() % 100  # not that of test_dds.py: a killed robot lingers
STAND = encode_command(hold(go2.HOME.numpy().astype(np.float64), 60.0, 5.0))


@contextmanager
def robot(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The process once it is ready, and its port for orders."""
    command = [sys.executable, "tools/go2_robot.py", "--domain", str(DOMAIN), *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            port = re.search(r"ready: domain \d+ on lo, orders at UDP port (\d+)", line)
            assert port, line
            yield process, int(port[1])
        finally:
            process.terminate()


def order(port: int, what: dict[str, object]) -> dict[str, object]:
    """Send an order; the answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5)
        client.sendto(json.dumps(what).encode(), ("127.0.0.1", port))
        answer = json.loads(client.recv(65536))
    assert "error" not in answer
    return answer


def hear(states: Subscriber, seconds: float) -> list[RobotState]:
    """States that come in this time."""
    until, heard = time.monotonic() + seconds, []
    while (left := until - time.monotonic()) > 0:
        heard += [decode_state(frame) for frame in states.take(left)]
    return heard


def test_a_controller_meets_it(tmp_path: Path) -> None:
    link = Link(DOMAIN)
    states = link.subscriber("rt/lowstate", LowState_, depth=1000)
    commands = link.publisher("rt/lowcmd", LowCmd_)
    sticks = link.subscriber("rt/wirelesscontroller", WirelessController_)
    log = tmp_path / "new" / "truth.npz"
    with robot("--log", str(log), "--robot.seed", "5") as (process, port):
        assert states.take(10), "no state"
        switcher = MotionSwitcher(link, timeout=10)
        assert switcher.active() == "mcf"
        with pytest.raises(LinkError, match=f"robot in domain {DOMAIN} on lo already: .*{process.pid}"):
            run(Args(domain=DOMAIN), stopped=lambda: True, say=print)

        states.take()
        heard = hear(states, 0.5)
        ticks = np.array([state.tick for state in heard])
        assert (np.diff(ticks) == 2).all()  # none lost, in order
        assert all(state.crc_ok for state in heard)
        assert 50 < len(heard) < 300  # 500 Hz, on a busy machine too

        commands.write(STAND)
        time.sleep(0.1)
        assert order(port, {})["refused"] == {"not released": 1}
        switcher.release()
        for _ in range(100):
            commands.write(STAND)
            time.sleep(0.002)
        answer = order(port, {"stuck": {"FR": 77}, "remote": {"buttons": ["B"]}, "states": {"corrupt": 0.5}})
        assert answer["released"]
        assert int(str(answer["accepted"])) > 50

        states.take()
        time.sleep(0.1)
        heard = hear(states, 0.4)
        good = [state for state in heard if state.crc_ok]
        assert 0.3 < len(good) / len(heard) < 0.7
        assert all(state.foot_force[1] == 77 for state in good[5:])
        assert unpack(good[-1].remote).buttons == Button.B
        assert WirelessController_.deserialize(sticks.take()[-1]).keys == Button.B

        process.send_signal(signal.SIGTERM)
        assert process.stdout is not None
        assert "ended after" in process.stdout.read()
        assert process.wait(10) == 0
    with np.load(log) as truth:
        assert truth["qpos"].shape == (len(truth["tick"]), 19)
        assert (np.diff(truth["tick"].astype(int)) == 2).all()
        assert truth["qpos"][-1, 2] > 0.2
        assert (np.diff(truth["left"]) > 0).all()
        assert (
            truth["left"][-1] - truth["left"][0]
            > 0.001 * float(truth["tick"][-1] - truth["tick"][0]) - LATEST
        )


def test_lockstep_is_the_class_to_the_byte() -> None:
    """The process adds nothing of its own to what `StandIn` does with the same frames."""
    upset = {"push": [30, 0, 0, 0.05], "states": {"nan": 0.1}}
    link = Link(DOMAIN)
    states, commands = link.subscriber("rt/lowstate", LowState_), link.publisher("rt/lowcmd", LowCmd_)
    heard: dict[int, bytes] = {}
    with robot("--lockstep", "--robot.start", "footstand", "--robot.seed", "9") as (_, port):
        while not commands.peers:
            time.sleep(0.01)
        order(port, upset)
        while len(heard) < 60:
            for frame in states.take(5):
                tick = decode_state(frame).tick
                if tick not in heard:  # it repeats itself until it is answered
                    heard[tick] = frame
                    commands.write(STAND)

    here = StandIn(Settings(seed=9, start="footstand"))
    expected = here.step([])
    obey(here, json.dumps(upset))
    for _ in range(59):
        expected += here.step([STAND])
    assert list(heard.values()) == expected


def test_states_leave_on_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it takes to work a state out is no part of a robot's delay."""
    done: list[str] = []

    def note(of: type, name: str, what: str) -> None:
        before = getattr(of, name)

        def noted(self: Any, *args: Any) -> Any:
            if getattr(self, "_topic", "rt/lowstate") == "rt/lowstate":
                done.append(what)
            return before(self, *args)

        monkeypatch.setattr(of, name, noted)

    monkeypatch.setattr("tools.robot.process.priority", lambda: "the test's own priority")
    note(Clock, "wait", "wait")
    note(Publisher, "write", "state")
    note(StandIn, "step", "step")
    run(Args(domain=DOMAIN, seconds=0.05), lambda: False, lambda _: None)
    turns = len(done) // 3
    assert turns > 20
    assert done == ["step", *["wait", "state", "step"] * turns]


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (Args(interface="eth77"), "no network interface 'eth77'"),
        (Args(order=('{"jump": 1}',)), "no order 'jump'"),
    ],
)
def test_errors_are_one_line(
    args: Args, told: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the test run keeps its own handlers
    assert main(args) == 2
    _, err = capsys.readouterr()
    assert err.startswith("go2_robot: ")
    assert told in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--speed 0", "speed of the clock must be 0.001 to 1000, got 0.0"),
        ("--port 99999", "port for orders must be 0 to 65535, got 99999"),
        ("--seconds nan", "seconds of simulated time must be 0 or more, got nan"),
        ("--robot.sensors.rate 0", "rate of the sensors must be more than 0, got 0.0"),
        ("--robot.sensors.gyro inf", "gyro of the sensors must be 0 or more and finite, got inf"),
        ("--robot.state-delay inf", "state_delay of frames must be 0 to 10 s, got inf"),
        ("--robot.loss-after nan", "loss_after must be 0 s or more, got nan"),
        ("--robot.body.mass inf", "mass of the body must be off by 0 to 0.9, got inf"),
        ("--robot.body.friction 2 1", "friction of the body must be a least and a most of"),
    ],
)
def test_settings_that_no_robot_has(words: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command_line(Args, words.split())
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert told in " ".join((out + err).replace("│", " ").split())


def test_a_robot_that_diverges_leaves_its_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And gives its port back."""
    step, log, told = StandIn.step, tmp_path / "truth.npz", list[str]()

    def diverging(self: StandIn, frames: list[bytes]) -> list[bytes]:
        if self.time > 0.021:
            raise RuntimeError("the simulated robot diverged")
        return step(self, frames)

    monkeypatch.setattr("tools.robot.process.priority", lambda: "the test's own priority")
    monkeypatch.setattr(StandIn, "step", diverging)
    with pytest.raises(RuntimeError, match="diverged"):
        run(Args(domain=DOMAIN, log=log), lambda: False, told.append)
    with np.load(log) as truth:
        assert truth["tick"].tolist() == list(range(2, 23, 2))
    (port,) = re.findall(r"UDP port (\d+)", told[0])
    Desk(int(port)).close()


def test_a_long_log_leaves_the_garbage_collector_nothing_to_walk_over(tmp_path: Path) -> None:
    """As an object a step, it took 36 ms after 400 s, and 0.2 s after 25 minutes."""
    log, robot = Log(tmp_path / "truth.npz"), StandIn(ideal())
    kept: list[Truth] = []
    gc.collect()
    before = len(gc.get_objects())
    for _ in range(Log.BLOCK + 10):
        robot.step([])
        log.add(robot.truth(), robot.time)
        kept = [*kept[-1:], robot.truth()]
    gc.collect()
    assert len(gc.get_objects()) < before + 200
    log.write()
    with np.load(tmp_path / "truth.npz") as found:
        assert set(found) == {*Truth._fields, "left"}
        assert found["left"][-1] == robot.time
        assert (np.diff(found["tick"].astype(int)) == 2).all()
        for name in Truth._fields:
            assert len(found[name]) == Log.BLOCK + 10
            assert np.array_equal(found[name][-2:], [getattr(truth, name) for truth in kept])


def test_a_truth_that_cannot_be_written_whole_is_not_there(tmp_path, monkeypatch):
    """Half a file is none that a summary can read."""
    path, whole = tmp_path / "truth.npz", np.savez
    log = Log(path)
    log.add(StandIn(ideal()).truth(), 0.0)

    def full(part: Path, **columns: Any) -> None:
        whole(part, **columns)
        part.write_bytes(part.read_bytes()[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        log.write()
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(np, "savez", whole)
    log.write()
    assert [found.name for found in tmp_path.iterdir()] == ["truth.npz"]
