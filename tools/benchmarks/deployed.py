"""What the deployed processes take of a core: state frames in the control process, and plans."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np

from deploy.modes import FOOT, HAND
from deploy.planner import Planner, planner_of
from deploy.process import ROOT, Job
from deploy.settings import DeployCfg
from deploy.slots import STATE
from hmc.cfg import load
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.sim.mujoco import MujocoSim
from tools.benchmarks.figures import Common, Figures

PERIOD = 0.002  # s, of the robot's state frames
AHEAD = 10  # ticks that a plan is expected to take


@dataclass(frozen=True)
class Deployed(Common):
    """The control process and the planner, by processor time of one core each: what else runs matters little.

    Attributes:
        seconds: of the robot's time, from lying over rising to standing, in which state frames are timed [s].
        plans: of each kind.
        seed: of the robot and of the draws.
        set: overrides of the task in plans, as `deploy/go2.py --task-set`.
    """

    seconds: float = 7.0
    plans: int = 20
    seed: int = 0
    set: tuple[str, ...] = ()


def deployed(args: Deployed) -> Figures:
    """Measure."""
    if args.seconds < 0.1:
        raise ValueError(f"seconds must be at least 0.1, or there is no tick in them, got {args.seconds:g}")
    figures = Figures()
    spent, ticked = frames(args.seconds, args.seed)
    figures.add("frame_share", spent.mean() / PERIOD, "of a core that the control process computes")
    figures.add("frame_us", 1e6 * np.median(spent[~ticked]), "a state frame without a tick, median [us]")
    figures.add("tick_us", 1e6 * np.median(spent[ticked]), "a state frame with one, without a policy [us]")

    planner = planner_of(Job(seed=args.seed, threads=1, task_set=args.set))
    planner.warm()
    stand = {"mode": FOOT, "asked": -1}
    kinds = {
        "wait": (situation(**stand), "in the foot stand, while nobody asks for the handstand"),
        "first": (situation(mode=FOOT), "the first way to it looked for"),
        "search": (situation(mode=FOOT), "on the way to it: improved, and tried on other robots"),
        "hand": (situation(mode=HAND, x=HANDSTAND.state().numpy()), "in the handstand"),
    }
    for name, (state, what) in kinds.items():
        whole, engine = plans(planner, state, 1 if name == "first" else args.plans)
        figures.add(f"plan_{name}_ms", 1e3 * np.median(whole), f"processor time of a plan: {what} [ms]")
        figures.add(f"plan_{name}_engine", engine.sum() / whole.sum(), "share of the engine in it")
    return figures


def frames(seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Processor time of each state frame [s], and whether it made a tick, while the stand-in rises."""
    from deploy.control import Control
    from deploy.loop import policies
    from deploy.remote import Button, Remote
    from tools.robot.standin import Settings, StandIn

    cfg = load(ROOT / "cfg" / "deploy.toml", DeployCfg)
    robot, control = StandIn(Settings(seed=seed, start="lying")), Control(cfg, policies("", ""))
    robot.release(True)
    spent, ticked = [], []
    sent: list[bytes] = []
    for k in range(round(seconds / PERIOD)):
        # START, for 50 ms of each second, asks for the next phase
        robot.remote = Remote(Button.START if 250 <= k % 500 < 275 else Button(0))
        for frame in robot.step(sent):
            began = time.thread_time()
            ticked.append(control.hear(frame, robot.time))
            spent.append(time.thread_time() - began)
        sent = [] if control.command is None else [control.command]
    return np.array(spent), np.array(ticked)


def situation(**fields: Any) -> np.ndarray:
    """A state's slot: the foot stand at rest, or what `fields` say; the handstand is asked for."""
    state, x = np.zeros((), STATE), FOOTSTAND.state().numpy()
    state["k"], state["entered"], state["asked"], state["running"] = 100, 50, 90, 1
    state["x"], state["anchor"] = x, (0.0, 0.0, 1.0, 0.0)
    for name, value in fields.items():
        state[name] = value
    state["u"] = state["x"][7:19]
    return state


def plans(planner: Planner, state: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Processor time of plans, tick after tick from a state on, and of the engine in them, (number,) [s]."""
    whole, engine = [], []
    for _ in range(number):
        state["k"] += 1
        with engine_time() as spent:
            began = time.thread_time()
            found = planner.plan(state, AHEAD)
            whole.append(time.thread_time() - began)
        engine.append(spent[0])
        if found is not None and int(state["mode"]) == FOOT:  # a flip that is not taken over: it goes on
            later = state.copy()
            later["k"] += 1000
            planner.committed(later)
    return np.array(whole), np.array(engine)


@contextmanager
def engine_time() -> Iterator[list[float]]:
    """Processor time that steps of the engine take meanwhile, in its one thread [s]."""
    spent, step = [0.0], MujocoSim.step

    def timed(sim: MujocoSim, *args: Any, **kwargs: Any) -> None:
        began = time.thread_time()
        step(sim, *args, **kwargs)
        spent[0] += time.thread_time() - began

    with mock.patch.object(MujocoSim, "step", timed):
        yield spent
