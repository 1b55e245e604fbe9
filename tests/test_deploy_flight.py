"""The whole deployment in lock step: planner, controller, estimator and stand-in, without clocks or wires."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.control import Control
from deploy.loop import policies
from deploy.modes import FOOT, HAND, JUMP, NONE, Plan
from deploy.planner import Planner, PlannerCfg, main, planner_of
from deploy.process import Job
from deploy.remote import Button, Remote
from deploy.safety import Phase
from deploy.settings import DeployCfg
from deploy.slots import STATE
from deploy.summary import stages
from hmc import make_start
from hmc.cfg import load
from hmc.go2.model import DT
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.go2.task import FlipCfg, policy_path
from tools.robot.standin import Settings, StandIn

CFG = load(Path("cfg/deploy.toml"), DeployCfg)


def planner(delay: int, seed: int = 0, *overrides: str) -> Planner:
    """As deployed, but it begins by reckoning with a planning time of so many ticks."""
    cfg = load(Path("cfg/planner.toml"), PlannerCfg, overrides)
    task = load(Path("cfg/flip.toml"), FlipCfg, cfg.task, table="task")
    made = Planner(task, cfg, CFG.plan, seed=seed, threads=1)
    made.seconds[False] = deque([delay * DT], maxlen=5)
    return made


class Flight:
    """A stand-in, its controller and its planner, whose plans take so many ticks to come.

    Args:
        seed: of robot and draws.
        delay: of plans.
        searching: of plans while a flip is looked for.
    """

    def __init__(self, seed: int, delay: int, searching: int):
        self.robot = StandIn(Settings(seed=seed, start="lying"))
        self.robot.release(True)
        self.control = Control(CFG, policies("", ""))
        self.control.planner = True
        self.planner = planner(delay, seed)
        self.delay = {True: searching, False: delay}
        self.x: list[np.ndarray] = []  # true states at the ticks of the hybrid phase
        self.modes: list[int] = []
        self._sent: list[bytes] = []
        self._coming: tuple[int, np.ndarray | None] | None = None  # tick at which a plan comes, and it
        self._released = 0.3  # s: when START may be pressed next

    def run(self, seconds: float) -> Flight:
        """Until the handstand has lasted 4 s, or the robot is damped, or its time has come."""
        while self.robot.time < seconds and self.control.phase != Phase.DAMPING and not self._landed:
            self._press()
            ticked = [self.control.hear(frame, self.robot.time) for frame in self.robot.step(self._sent)]
            command = self.control.command
            self._sent = [] if command is None else [command]
            if any(ticked) and self.control.phase == Phase.HYBRID:
                truth = self.robot.truth()
                self.x.append(np.concatenate([truth.qpos, truth.qvel]))
                self.modes.append(self.control.performer.mode)
                self._plan()
        return self

    @property
    def _landed(self) -> bool:
        return self.modes[-200:] == [HAND] * 200

    def _press(self) -> None:
        """START, for 50 ms whenever it leads on; the handstand is asked for 2 s into the foot stand."""
        control, t = self.control, self.robot.time
        leads_on = control.phase in (Phase.PASSIVE, Phase.READY) or (
            control.phase == Phase.LIE and control._posed()
        )
        if t > self._released and (leads_on or (control.phase == Phase.HYBRID and len(self.modes) > 100)):
            self._released = t + 0.3 if control.asked < 0 else np.inf
        pressed = t > self._released - 0.3 + 1e-9 and t < self._released - 0.25
        self.robot.remote = Remote(Button.START if pressed else Button(0))

    def _plan(self) -> None:
        k = self.control.k
        if self._coming is not None and k >= self._coming[0]:
            if self._coming[1] is not None:
                self.control.performer.offer(Plan.read(self._coming[1]))
            self._coming = None
        state = self.control.situation.copy()
        if self._coming is None and not self.planner.committed(state):
            looking = self.planner.looking(state)
            self._coming = k + self.delay[looking], self.planner.plan(state, self.planner.ahead(state))
            self.planner.seconds[looking].append(self.delay[looking] * DT)


@pytest.mark.parametrize(
    ("seed", "delay", "searching"),
    [(0, 3, 25), *(pytest.param(seed, 25, 25, marks=pytest.mark.deploy) for seed in range(1, 6))],
)
def test_from_lying_to_the_handstand(seed: int, delay: int, searching: int) -> None:
    """With plans that take 0.06 s, and half a second."""
    flight = Flight(seed, delay, searching).run(25.0)
    found = stages(np.array(flight.x), flight.modes)
    assert found is not None
    assert found["success"], (found, flight.control.machine.reason)
    assert flight.control.missed == 0
    assert not flight.control.performer.counts["stale"]
    order = [mode for i, mode in enumerate(flight.modes) if i == 0 or mode != flight.modes[i - 1]]
    assert [mode for mode in order if mode != NONE] == [FOOT, JUMP, HAND]
    assert flight.modes.count(JUMP) >= 12  # the rule of cfg/flip.toml


def situation(**fields: Any) -> np.ndarray:
    """A state's slot: the foot stand at rest, the handstand asked for."""
    state, x = np.zeros((), STATE), FOOTSTAND.state().numpy()
    state["k"], state["x"], state["u"], state["running"] = 100, x, x[7:19], 1
    state["mode"], state["entered"], state["anchor"] = FOOT, 50, (0.0, 0.0, 1.0, 0.0)
    state["asked"] = 90
    for name, value in fields.items():
        state[name] = value
    return state


def test_a_flip_is_left_alone_until_the_handstand_and_given_up_if_it_is_not_taken_over() -> None:
    it = planner(5)
    assert not it.committed(situation())
    plans = (it.plan(situation(k=k), 5) for k in range(100, 200))
    record = next(plan for plan in plans if plan is not None and HAND in plan["modes"][: plan["steps"]])
    begin, modes = int(record["begin"]), record["modes"][: record["steps"]].tolist()
    assert modes[0] == FOOT
    assert modes[-1] == HAND
    assert modes.count(JUMP) >= 12
    assert it.committed(situation(k=begin))
    assert it.committed(situation(k=begin + 30, mode=JUMP))
    assert not it.committed(situation(k=begin + 60, mode=HAND))
    assert not it.committed(situation(k=begin + 60))  # still in the foot stand
    assert not it.committed(situation(k=begin + 1))  # and so the search goes on


def test_a_flip_is_planned_for_when_its_search_will_be_over() -> None:
    """Of which plans to stand, that take a tenth of the time, say nothing."""
    it = planner(3)
    waiting, asked, landed = situation(asked=-1), situation(), situation(mode=HAND)
    assert [it.ahead(state) for state in (waiting, asked, landed)] == [4, CFG.plan.longest, 4]
    it.seconds[True].extend([0.5, 0.3])
    assert [it.ahead(state) for state in (waiting, asked, landed)] == [4, 1 + 23, 4]  # 0.46 s


def test_before_it_is_asked_for_the_foot_stand_goes_on() -> None:
    record = planner(5).plan(situation(asked=-1), 5)
    assert record is not None
    assert record["modes"][: record["steps"]].tolist() == [FOOT] * 20


def test_in_the_handstand_plans_are_short() -> None:
    it = planner(5, 0, "rest=15")
    x = HANDSTAND.state().numpy()
    record = it.plan(situation(x=x, u=x[7:19], mode=HAND), 5)
    assert record is not None
    assert record["modes"][: record["steps"]].tolist() == [HAND] * 15


@pytest.mark.parametrize("wrong", ["lead=50", "rest=51"])
def test_plans_that_do_not_fit_into_the_horizon(wrong: str) -> None:
    with pytest.raises(
        ValueError, match=r"horizon must be more than the lead of \d+ control steps, at least"
    ):
        planner(5, 0, wrong)


def test_a_flip_that_others_do_not_land_is_not_sent() -> None:
    it = planner(5, 0, "landed=1.1", "patience=1")
    for k in range(100, 112):
        record = it.plan(situation(k=k), 5)
        assert record is not None
        assert record["modes"][: record["steps"]].tolist() == [FOOT] * 20


def test_other_robots_land_a_flip_and_not_a_fall() -> None:
    it, alone = planner(5), planner(5, 0, "others.members=0")
    x, horizon = FOOTSTAND.state(), it.task.horizon
    start = make_start(it.task, it._one, x, x[7:19], mode="foot", memory=[0.0, 0.0, 1.0, 0.0])
    flip = [FOOT] * 5 + [JUMP] * 21 + [HAND] * (horizon - 26)
    fall = [FOOT] * 5 + [HAND] * (horizon - 5)
    assert it.landed(start, flip) >= 8 / 9
    assert it.landed(start, fall) == 0.0
    assert it.landed(start, flip) == it.landed(start, flip)
    assert alone.landed(start, flip) == 1.0
    assert alone.landed(start, fall) == 0.0
    upside = make_start(it.task, it._one, HANDSTAND.state(), HANDSTAND.state()[7:19])
    assert it.landed(upside, [HAND] * horizon) >= 8 / 9


def test_plans_are_made_with_the_policies_that_run(tmp_path: Path) -> None:
    """Those of the job, in both processes; where it names none, those of the package."""
    given = {name: tmp_path / f"{name}.onnx" for name in ("foot", "hand")}
    for name, path in given.items():
        path.write_bytes(policy_path(f"{name}stand").read_bytes())
    for job, paths in (
        (Job(foot=str(given["foot"]), hand=str(given["hand"]), threads=1), given),
        (Job(threads=1), {name: policy_path(f"{name}stand") for name in given}),
    ):
        modes, run = planner_of(job).task.modes, policies(job.foot, job.hand)
        for mode, name in ((FOOT, "foot"), (HAND, "hand")):
            planned = modes[mode]
            assert isinstance(planned, Policy)
            assert planned.network.path.samefile(paths[name])
            assert run[mode].path.samefile(paths[name])


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"task_set": ("foot=other.onnx",)}, "task.foot is other.onnx for plans alone: use --foot"),
        ({"task_set": ("horizn=3",)}, "unknown key horizn; did you mean horizon?"),
        ({"search": ("lead=50",)}, "horizon must be more than the lead of 50"),
        ({"hand": "none.onnx"}, "policy none.onnx: no such file"),
    ],
)
def test_what_cannot_be_planned_is_one_line(
    wrong: dict[str, Any], told: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deploy.planner.until_told", lambda _: lambda: True)
    monkeypatch.setattr("os.nice", lambda _: 0)
    assert main(Job(**wrong)) == 2
    _, err = capsys.readouterr()
    assert err.startswith("planner: ")
    assert told in err
    assert err.count("\n") == 1
