"""What `python deploy/go2.py` says where it cannot start: one line that says what to do, exit status 2."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import onnx
import pytest

pytest.importorskip("cyclonedds", reason="needs the deploy extra: pip install -e .[deploy]")

from deploy import process
from deploy.codec import encode_state
from deploy.dds import LOOPBACK, Link
from deploy.loop import policies
from deploy.messages import LowCmd_, LowState_
from deploy.motion_switcher import MotionSwitcherService
from deploy.process import Job, spawn
from hmc.go2.task import policy_path
from tests import wire

ROOT = Path(__file__).parent.parent
DOMAIN = 115 + os.getpid() % 100
HERE = DOMAIN + 2  # on lo: a process uses a domain on one interface
# a robot is behind a network card; on lo, the program starts its stand-in
CARD = next((name for _, name in socket.if_nameindex() if name.startswith(("e", "w"))), "")
card = pytest.mark.skipif(not CARD, reason="this machine has no network card")


def refused(*arguments: str, folder: Path, domain: int = DOMAIN, cwd: Path = ROOT) -> str:
    """The one line that the program ends with, at status 2; nothing of it is left."""
    command = [sys.executable, str(ROOT / "deploy" / "go2.py"), "--domain", str(domain), "--out", str(folder)]
    ran = subprocess.run([*command, *arguments], cwd=cwd, capture_output=True, text=True, timeout=90)
    assert ran.returncode == 2, ran.stderr
    assert ran.stderr.count("\n") == 1, ran.stderr
    assert not (folder / "summary.json").exists()
    of_it = f'--domain {domain} |"domain": {domain},'
    assert not subprocess.run(["pgrep", "-f", of_it], capture_output=True).stdout
    return ran.stderr


def behind_the_card(folder: Path, domain: int = DOMAIN) -> str:
    """What the program says of a robot that should be behind the network card."""
    return refused("--interface", CARD, folder=folder, domain=domain)


def edited(name: str, out: Path, key: str, value: str) -> Path:
    """A copy of a policy of the package with one field of its metadata changed."""
    model = onnx.load(str(policy_path(name)))
    (field,) = (prop for prop in model.metadata_props if prop.key == key)
    field.value = value
    onnx.save(model, str(out))
    return out


A_GO1 = '["FR_hip", "FR_thigh", "FR_calf"]'
ANOTHER_ROBOT = r"other\.onnx: joint_order is \['FR_hip', .*, expected \['FL_hip', .*train and export it"
ANOTHER_MODE = r"handstand\.onnx: mode is 'handstand', expected 'footstand': give one .* --mode footstand"
A_COMMAND = r"walk\.onnx: command is forward \[m/s\], .*, expected none, .*: give one .* --mode footstand"


def test_policies_that_are_of_no_use(tmp_path: Path) -> None:
    """Another robot's, another mode's, one that has to be told where to go; each is named with its field."""
    other = edited("footstand", tmp_path / "other.onnx", "joint_order", A_GO1)
    hand, walk = str(policy_path("handstand")), str(policy_path("walk"))
    for foot, told in ((str(other), ANOTHER_ROBOT), (hand, ANOTHER_MODE), (walk, A_COMMAND)):
        with pytest.raises(ValueError, match=told):
            policies(foot, "")
    with pytest.raises(ValueError, match=r"footstand\.onnx: mode is 'footstand', expected 'handstand'"):
        policies("", str(policy_path("footstand")))
    assert len(policies(str(policy_path("footstand")), hand)) == 2


def test_paths_are_those_of_who_starts_the_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They run in another folder, and get whole paths; what is not given stays so."""
    commands: list[list[str]] = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **_: commands.append(command))
    monkeypatch.chdir(tmp_path)
    spawn("loop", Job(foot="mine/a.onnx", path="run.mcap"), [])
    monkeypatch.setattr(sys, "argv", commands[0][2:])
    job = process.told()
    assert (job.foot, job.hand, job.path) == (str(tmp_path / "mine/a.onnx"), "", str(tmp_path / "run.mcap"))
    assert job.cfg == Job().cfg


@pytest.mark.deploy
@pytest.mark.parametrize("what", ["robot", "mode", "command", "folder"])
def test_policies_by_the_program(what: str, tmp_path: Path) -> None:
    other = edited("footstand", tmp_path / "other.onnx", "joint_order", A_GO1)
    path, told = {
        "robot": (other, ANOTHER_ROBOT),
        "mode": (policy_path("handstand"), ANOTHER_MODE),
        "command": (policy_path("walk"), A_COMMAND),
        "folder": (Path("other.onnx"), ANOTHER_ROBOT),
    }[what]
    line = refused("--foot", str(path), folder=tmp_path / "out", cwd=tmp_path)
    assert re.search(told, line), line


@contextmanager
def robot(awake: bool = True, charge: int = 80, controller: str = "") -> Iterator[None]:
    """A robot's topics behind the network card: states at 500 Hz if it is awake, and a motion switcher."""
    link, stop = Link(DOMAIN, CARD), threading.Event()
    states, service = link.publisher("rt/lowstate", LowState_), MotionSwitcherService(link, controller)

    def run() -> None:
        tick = 0
        while not stop.is_set():
            tick += 2
            if awake:
                states.write(encode_state(wire.state()._replace(tick=tick, charge=charge)))
            service.serve()
            time.sleep(0.002)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@card
@pytest.mark.deploy
def test_no_robot(tmp_path: Path) -> None:
    line = behind_the_card(tmp_path)
    assert "no state frame within 3 s; nobody publishes rt/lowstate: is the robot on" in line


@card
@pytest.mark.deploy
def test_a_robot_that_is_asleep(tmp_path: Path) -> None:
    with robot(awake=False):
        line = behind_the_card(tmp_path)
    assert "something publishes rt/lowstate, but is silent: is the robot asleep?" in line


@card
@pytest.mark.deploy
def test_the_wrong_domain(tmp_path: Path) -> None:
    with robot():
        line = behind_the_card(tmp_path, domain=DOMAIN + 1)
    assert "nobody publishes rt/lowstate" in line
    assert "are the interface and the DDS domain right (0 on the robot's network, 1 on lo" in line


@card
@pytest.mark.deploy
def test_a_second_controller(tmp_path: Path) -> None:
    with robot():
        other = Link(DOMAIN, CARD).publisher("rt/lowcmd", LowCmd_)
        line = behind_the_card(tmp_path)
        del other
    assert "another program commands the motors: " in line
    assert f"(process {os.getpid()} on {socket.gethostname()}): end it first" in line


@card
@pytest.mark.deploy
@pytest.mark.parametrize(
    ("state", "told"),
    [
        ({"charge": 3}, "the battery has 3 %, at least 20 % is needed: charge it"),
        ({"controller": "mcf"}, "own controller 'mcf' runs: lay the robot down, then use --release"),
    ],
)
def test_a_robot_that_must_not_be_started(state: dict[str, int | str], told: str, tmp_path: Path) -> None:
    with robot(**state):
        assert told in behind_the_card(tmp_path)


@pytest.mark.deploy
def test_a_second_controller_beside_the_stand_in(tmp_path: Path) -> None:
    other = Link(HERE, LOOPBACK).publisher("rt/lowcmd", LowCmd_)
    line = refused(folder=tmp_path, domain=HERE)
    assert f"(process {os.getpid()} on " in line
    del other


@pytest.mark.deploy
def test_a_second_stand_in(tmp_path: Path) -> None:
    """Another robot in the domain: the stand-in refuses to be there as well."""
    other = Link(HERE, LOOPBACK).publisher("rt/lowstate", LowState_)
    line = refused(folder=tmp_path, domain=HERE)
    assert f"there is a robot in domain {HERE} on lo already: " in line
    del other


@pytest.mark.deploy
@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("--task-set=horizon=20", "planner: horizon must be more than the lead of 30 control steps"),
        (
            "--search=search.draws=many",
            "planner: .*planner.toml with search.draws=many: search.draws: expected int",
        ),
    ],
)
def test_a_planner_that_cannot_start(setting: str, told: str, tmp_path: Path) -> None:
    """Beside the stand-in, whose operator would else ask for the first mode for ever."""
    line = refused(setting, folder=tmp_path, domain=HERE)
    assert re.match(told, line), line
