"""The planner's process: newest state in, plan for a later tick out; nobody waits for it."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from deploy.modes import HAND, JUMP, NAMES, NONE, due
from deploy.process import Job, told, until_told
from deploy.settings import DeployCfg, PlanCfg
from deploy.slots import PLAN, STEPS, Board
from hmc import Budget, Evaluator, Task, Trace, make_start, plan
from hmc.cfg import load
from hmc.go2.model import DT
from hmc.go2.stances import FOOTSTAND
from hmc.go2.task import FlipCfg, flip_task
from hmc.receding import SearchCfg
from hmc.start import Start

NICE = 5  # what controls the robot goes first
_KEPT = 40  # plans that the control process may still be running


@dataclass(frozen=True)
class PlannerCfg:
    """What cfg/flip.toml says of the task and the search.

    Attributes:
        seconds: of a run in simulation; not used here.
        task: modes, cost, horizon.
        search: effort of each plan.
    """

    seconds: float = 0.0
    task: FlipCfg = field(default_factory=FlipCfg)
    search: SearchCfg = field(default_factory=SearchCfg)


@dataclass(frozen=True, eq=False)
class Shipped:
    """A plan that was sent.

    Attributes:
        begin: tick of its first step.
        trace: what it leads to.
    """

    begin: int
    trace: Trace


class Planner:
    """Plans from the state that the running plan will have led to when the new one is ready.

    The wish for the handstand is a moment in the task's time: until it is known, the task stands still before
    it, and the whole horizon wants the foot stand.

    Attributes:
        task: what is planned.
        seconds: that the last plans took [s].

    Args:
        cfg: task and search.
        rules: of taking plans over.
        seed: of the draws and of the jump's noise.
        threads: of the engine; 0 for all cores.
    """

    def __init__(self, cfg: PlannerCfg, rules: PlanCfg, *, seed: int = 0, threads: int = 0):
        horizon = cfg.task.horizon
        if horizon > STEPS:
            raise ValueError(f"horizon must be at most {STEPS} control steps, got {horizon}")
        self.task: Task = flip_task(replace(cfg.task, command=horizon), seed=seed, threads=threads)
        if self.task.modes.names != NAMES:
            raise ValueError(f"modes must be {', '.join(NAMES)}, got {', '.join(self.task.modes.names)}")
        search = cfg.search
        self.seconds: deque[float] = deque([0.1] * 5, maxlen=30)
        self._rules, self._seed = rules, seed
        self._options = {
            "samples": search.samples,
            "order": search.order,
            "pairs": search.pairs,
            "moves": search.moves,
            "budget": Budget(draws=search.draws, control_steps=search.control_steps),
        }
        self._sim = self.task.make_sim(1 + max(search.samples, search.pairs + search.moves))
        self._one = self.task.make_sim(1)
        self._shipped: dict[int, Shipped] = {}
        self._number = 0

    def warm(self) -> None:
        """Plan once for nothing: what is made on first use is made then."""
        hand = self.task.horizon
        start = make_start(self.task, self._sim, _upright(), _upright()[7:19], k=hand)
        plan(
            self.task, start, schedule=["foot"] * 10 + ["jump"] * 35 + ["hand"] * (hand - 45), **self._options
        )

    @property
    def ahead(self) -> int:
        """Ticks that planning is expected to take."""
        expected = float(np.quantile(self.seconds, self._rules.quantile))
        return min(1 + math.ceil(expected / DT), self._rules.longest)

    @torch.no_grad()
    def plan(self, state: np.ndarray, ahead: int) -> np.ndarray | None:
        """The plan for `ahead` ticks after a state, as a value of the plan's slot; None if there is none.

        Args:
            state: value of the state's slot.
            ahead: ticks.
        """
        k, asked = int(state["k"]), int(state["asked"])
        begin = k + ahead
        start, modes = self._predict(state, ahead)
        now = begin - asked + self.task.horizon if asked >= 0 else 0
        if not bool(start.x.isfinite().all()):
            return None
        found = plan(
            self.task,
            replace(start, k=max(0, now)),
            schedule=modes,
            seed=(self._seed, begin),
            sim=self._sim,
            forget=False,
            **self._options,
        )
        trace = found.known
        if trace.schedule != found.schedule:
            trace = Evaluator(self.task, self._sim, replace(start, k=max(0, now)), trace).trace(
                found.schedule
            )
        if len(trace) < len(found.schedule):
            return None
        self._number += 1
        self._shipped[self._number] = Shipped(begin, trace)
        self._shipped.pop(self._number - _KEPT, None)
        return self._record(self._number, state, begin, start.mode, trace, found.cost)

    def _predict(self, state: np.ndarray, ahead: int) -> tuple[Start, list[int]]:
        """The situation `ahead` ticks later under the running plan, and its modes from there on."""
        k, mode, entered = int(state["k"]), int(state["mode"]), int(state["entered"])
        x, u = torch.from_numpy(state["x"].copy())[None], torch.from_numpy(state["u"].copy())[None]
        running = self._shipped.get(int(state["plan"]))
        begin, modes = (0, ()) if running is None else (running.begin, running.trace.modes)
        memory = torch.from_numpy(state["anchor"].copy())[None]
        self._one.reset(x, u)
        for tick in range(k, k + ahead):
            wanted, step = due(self._rules, begin, modes, tick, mode, entered), torch.tensor([tick])
            if wanted == JUMP:
                assert running is not None
                row = tick - begin + 1
                u, memory = running.trace.u[row][None], running.trace.memory[row][None]
            else:
                chosen = self.task.modes[wanted]
                memory = chosen.reset(x, u, step) if wanted != mode else memory[:, : chosen.memory_size]
                u, memory = chosen.act(x, u, memory, step)
            mode, entered = wanted, tick if wanted != mode else entered
            self._one.step(u)
            x = self._one.x()
        at = range(k + ahead - begin, k + ahead - begin + self.task.horizon)
        schedule = [modes[min(max(i, 0), len(modes) - 1)] for i in at] if modes else [mode] * len(at)
        if mode == JUMP and schedule[0] != JUMP:  # it was ended
            schedule = [HAND] * len(at)
        return Start(x[0], u[0], mode, memory[0, : self.task.modes[mode].memory_size].to(x), 0), schedule

    def _record(
        self, number: int, state: np.ndarray, begin: int, running: int | None, trace: Trace, cost: float
    ) -> np.ndarray:
        record, steps = np.zeros((), PLAN), len(trace.modes)
        record["number"], record["base"], record["begin"] = number, state["k"], begin
        record["running"] = NONE if running is None else running
        record["steps"], record["cost"] = steps, cost
        record["modes"][:steps] = trace.modes
        record["u"][:steps] = trace.u[1:].numpy()
        return record


def run(board: Board, planner: Planner, stopped: Callable[[], bool]) -> None:
    """Plan for every new state until `stopped()`."""
    planner.warm()
    last = -1
    while not stopped():
        state = board.state.read()
        if state is None or not state["running"] or state["k"] == last:
            if state is None or not state["running"]:
                waiting = board.plan.blank()
                waiting["t"] = time.monotonic()
                board.plan.write(waiting)
            time.sleep(0.002 if last >= 0 else 0.05)
            continue
        last = int(state["k"])
        record = planner.plan(state, planner.ahead)
        now = time.monotonic()
        planner.seconds.append(now - float(state["t"]))
        if record is not None:
            record["t"], record["seconds"] = now, planner.seconds[-1]
            board.plan.write(record)


def _upright() -> Tensor:
    return FOOTSTAND.state()


def main(job: Job) -> None:
    """Be the planner until SIGTERM."""
    stopped = until_told()
    os.nice(NICE)
    torch.set_num_threads(1)
    cfg, rules = load(job.task, PlannerCfg, job.task_set), load(job.cfg, DeployCfg, job.set).plan
    run(Board(job.board), Planner(cfg, rules, seed=job.seed, threads=job.threads), stopped)


if __name__ == "__main__":
    main(told())
