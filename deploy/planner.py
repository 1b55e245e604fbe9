"""The planner's process: newest state in, plan for a later tick out; nobody waits for it."""

from __future__ import annotations

import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from deploy.modes import FOOT, HAND, JUMP, NAMES, NONE, due
from deploy.process import ROOT, Job, allowed, told, until_told
from deploy.settings import DeployCfg, PlanCfg
from deploy.slots import PLAN, STEPS, Board
from hmc import Evaluator, Schedule, Task, Trace, make_start, plan
from hmc.cfg import load
from hmc.go2.ensemble import EnsembleCfg, make_ensemble
from hmc.go2.model import DT
from hmc.go2.stances import FOOTSTAND, HANDSTAND
from hmc.go2.task import FlipCfg, flip_task
from hmc.planner import worlds_for
from hmc.receding import SearchCfg
from hmc.start import Start

NICE = 5  # where what controls the robot has no real-time priority
_KEPT = 40  # plans that the control process may still be running


@dataclass(frozen=True)
class PlannerCfg:
    """cfg/planner.toml.

    Attributes:
        task: overrides of the task in cfg/flip.toml for plans on the way, as on a command line.
        lead: control steps from a plan's begin until the handstand is wanted, while the first way to it is
            looked for.
        rest: horizon of plans in which no flip is looked for, in control steps: before the handstand is asked
            for, and once the robot is in it.
        first: effort of a plan then: the robot stands and can wait.
        search: effort of every other plan on the way to it.
        hold: effort of a plan in the handstand, where a little of it at every plan is as much.
        others: robots that a flip is tried on before it is sent.
        landed: share of them and the nominal one that have to end in the handstand.
        patience: flips in a row that too few land, after which the first way is looked for anew.
        commit: whether a flip that was sent is left alone until the handstand. A new plan is made for a state
            0.2 s and more ahead, where planning takes so long: in flight that is worth less than a plan that
            others landed.
    """

    task: tuple[str, ...] = ()
    lead: int = 45
    rest: int = 40
    others: EnsembleCfg = field(default_factory=EnsembleCfg)
    landed: float = 0.8
    patience: int = 5
    commit: bool = True
    first: SearchCfg = field(default_factory=SearchCfg)
    search: SearchCfg = field(default_factory=SearchCfg)
    hold: SearchCfg = field(default_factory=SearchCfg)


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

    Until the operator asks for the handstand, the whole horizon wants the foot stand. From then on,
    the moment at which the handstand is wanted moves along ahead of the robot, until a schedule is
    found that ends in it; then it stays where it is, and the plan is sent. A plan that leaves the foot
    stand for anything but a handstand, or for one that too few other robots come to, is not sent, but one
    to stand on: the search goes on, and is heard of.

    Attributes:
        task: what is planned while a flip is looked for.
        seconds: that the last plans took [s]: those while a flip is looked for, and the others, which take a
            fraction of it. A flip that is planned for a moment that is over before it comes is of no use.

    Args:
        task: settings of the task.
        cfg: effort.
        rules: of taking plans over.
        seed: of the draws and of the jump's noise.
        threads: of the engine; 0 for all cores.
        speed: of the robot's clock.
    """

    def __init__(
        self,
        task: FlipCfg,
        cfg: PlannerCfg,
        rules: PlanCfg,
        *,
        seed: int = 0,
        threads: int = 0,
        speed: float = 1.0,
    ):
        self._horizon, self._tick = task.horizon, DT / speed
        if not max(cfg.lead, cfg.rest - 1) < self._horizon <= STEPS:
            raise ValueError(
                f"horizon must be more than the lead of {cfg.lead} control steps, at least the {cfg.rest} of "
                f"a plan at rest, and at most {STEPS}, got {self._horizon}"
            )
        # in the task's own time, later than the end of a horizon that begins at 0
        self._wanted = self._horizon + 1
        self.task: Task = flip_task(replace(task, command=self._wanted), seed=seed, threads=threads)
        self._calm = replace(self.task, horizon=cfg.rest)
        if self.task.modes.names != NAMES:
            raise ValueError(f"modes must be {', '.join(NAMES)}, got {', '.join(self.task.modes.names)}")
        self.seconds: dict[bool, deque[float]] = {True: deque(maxlen=5), False: deque([0.1] * 5, maxlen=30)}
        self._cfg, self._rules, self._seed = cfg, rules, seed
        searches = (cfg.first, cfg.search, cfg.hold)
        self._sim = self.task.make_sim(
            max(worlds_for(self.task, it.samples, 0, it.pairs + it.moves) for it in searches)
        )
        self._one = self.task.make_sim(1)
        self._others = replace(self.task, ensemble=make_ensemble(cfg.others, seed=seed, threads=threads))
        self._refused = 0  # flips in a row that too few of them landed
        self._shipped: dict[int, Shipped] = {}
        self._number = 0
        self._command: int | None = None  # tick from which the handstand is wanted
        self._guess = [FOOT] * self._horizon  # incumbent while that is not known
        self._known = False  # whether the guess ended in the handstand

    def warm(self) -> None:
        """Plan once for nothing: what is made on first use is made then."""
        x = FOOTSTAND.state()
        start = make_start(self.task, self._sim, x, x[7:19], k=self._wanted)
        flip = ([FOOT] * 10 + [JUMP] * 20 + [HAND] * self._horizon)[: self._horizon]
        plan(self.task, start, schedule=flip, sim=self._sim, **self._cfg.search.options())

    def looking(self, state: np.ndarray) -> bool:
        """Whether a flip is looked for in a state, as of the state's slot."""
        return int(state["asked"]) >= 0 and int(state["mode"]) == FOOT and self._command is None

    def ahead(self, state: np.ndarray) -> int:
        """Ticks that planning from a state is expected to take."""
        if not (last := self.seconds[self.looking(state)]):
            return self._rules.longest
        expected = float(np.quantile(last, self._rules.quantile))
        return min(1 + math.ceil(expected / self._tick), self._rules.longest)

    def committed(self, state: np.ndarray) -> bool:
        """Whether a flip is under way that no plan is to interfere with.

        Args:
            state: value of the state's slot.
        """
        if self._command is None or not self._cfg.commit or int(state["mode"]) == HAND:
            return False
        if int(state["mode"]) == FOOT and int(state["k"]) > self._command:
            self._command = None  # it was not taken over: the search goes on
            return False
        return True

    @torch.no_grad()
    def plan(self, state: np.ndarray, ahead: int) -> np.ndarray | None:
        """The plan for `ahead` ticks after a state, as a value of the plan's slot; None if there is none.

        Args:
            state: value of the state's slot.
            ahead: ticks.
        """
        begin = int(state["k"]) + ahead
        start, modes = self._predict(state, ahead)
        if not bool(start.x.isfinite().all()):
            return None
        searching = self.looking(state) and start.mode == FOOT
        if int(state["asked"]) < 0:
            return self._stand(state, begin, start)
        if searching:
            start = replace(start, k=self._wanted - self._cfg.lead)
            effort, modes = self._cfg.search if self._known else self._cfg.first, self._guess
        else:
            command = begin if self._command is None else self._command
            start = replace(start, k=max(0, begin - command + self._wanted))
            effort = self._cfg.hold if start.mode == HAND else self._cfg.search
        task = self._calm if start.mode == HAND else self.task
        found = plan(
            task,
            start,
            schedule=modes[: task.horizon],
            seed=(self._seed, begin),
            sim=self._sim,
            forget=False,
            **effort.options(),
        )
        trace = found.known
        if trace.schedule != found.schedule:
            trace = self._follow(task, start, found.schedule.modes, trace)
        reached = self._reached(trace)
        if start.mode != FOOT:
            return self._ship(state, begin, start, trace)
        if searching:
            known, self._known, self._guess = self._known, reached, list(found.schedule)
            if not (known and reached and self._agreed(start)):
                return self._stand(state, begin, start)
            self._command = begin + self._cfg.lead
        elif not reached:
            self._command, self._known, self._guess = None, False, list(found.schedule)
            return self._stand(state, begin, start)
        return self._ship(state, begin, start, trace)

    def landed(self, start: Start, modes: Sequence[int]) -> float:
        """Share of the other robots and the nominal one that are in the handstand after a schedule."""
        evaluator = Evaluator(self._others, self._one, start)
        evaluator.follow(Schedule(tuple(modes), NAMES))
        return float(np.mean([self._reached(trace) for trace in evaluator.trunks]))

    def _stand(self, state: np.ndarray, begin: int, start: Start) -> np.ndarray | None:
        """The plan to go on standing on the hind legs, as a value of the plan's slot."""
        start = replace(start, k=0)  # long before the handstand is wanted
        return self._ship(state, begin, start, self._follow(self._calm, start, [FOOT] * self._cfg.rest))

    def _reached(self, trace: Trace) -> bool:
        return len(trace) == self._horizon and bool(HANDSTAND.held(trace.x[-1:]))

    def _agreed(self, start: Start) -> bool:
        """Whether enough other robots land the flip that was found."""
        agreed = self.landed(start, self._guess) >= self._cfg.landed
        self._refused = 0 if agreed else self._refused + 1
        if self._refused >= self._cfg.patience:
            self._known, self._guess, self._refused = False, [FOOT] * self._horizon, 0
        return agreed

    def _follow(self, task: Task, start: Start, modes: Sequence[int], known: Trace | None = None) -> Trace:
        """What a schedule leads to."""
        evaluator = Evaluator(task, self._sim, start, known)
        return evaluator.trace(Schedule(tuple(modes), NAMES))

    def _ship(self, state: np.ndarray, begin: int, start: Start, trace: Trace) -> np.ndarray | None:
        """The value of the plan's slot for a schedule and what it leads to; None if it does not go on."""
        if len(trace) < trace.task.horizon:
            return None
        self._number += 1
        self._shipped[self._number] = Shipped(begin, trace)
        self._shipped.pop(self._number - _KEPT, None)
        record = np.zeros((), PLAN)
        record["number"], record["base"], record["begin"] = self._number, state["k"], begin
        record["running"] = NONE if start.mode is None else start.mode
        record["steps"], record["cost"] = len(trace), trace.cost
        record["modes"][: len(trace)] = trace.modes
        record["u"][: len(trace)] = trace.u[1:].numpy()
        return record

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
            if mode == JUMP and wanted == HAND and modes[tick - begin : tick - begin + 1] != (HAND,):
                running, modes = None, ()  # as `Performer` does
            mode, entered = wanted, tick if wanted != mode else entered
            self._one.step(u)
            x = self._one.x()
        at = range(k + ahead - begin, k + ahead - begin + self.task.horizon)
        schedule = [modes[min(max(i, 0), len(modes) - 1)] for i in at] if modes else [mode] * len(at)
        return Start(x[0], u[0], mode, memory[0, : self.task.modes[mode].memory_size].to(x), 0), schedule


def run(board: Board, planner: Planner, stopped: Callable[[], bool]) -> None:
    """Plan for every new state until `stopped()`."""
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
        if planner.committed(state):
            continue
        taken = planner.seconds[planner.looking(state)]
        record = planner.plan(state, planner.ahead(state))
        now = time.monotonic()
        taken.append(now - float(state["t"]))
        if record is not None:
            record["t"], record["seconds"] = now, taken[-1]
            board.plan.write(record)


def planner_of(job: Job) -> Planner:
    """The planner that a job asks for; it reckons with the policies that the control process runs.

    Raises:
        ValueError: settings that are none, or policies for plans alone.
    """
    cfg = load(ROOT / "cfg" / "planner.toml", PlannerCfg, job.search)
    task = load(job.task, FlipCfg, (*cfg.task, *job.task_set), table="task")
    for name, given in (("foot", task.foot), ("hand", task.hand)):
        if given:
            raise ValueError(f"task.{name} is {given} for plans alone: use --{name}, for control as well")
    rules = load(job.cfg, DeployCfg, job.set).plan
    task = replace(task, foot=job.foot, hand=job.hand)
    return Planner(task, cfg, rules, seed=job.seed, threads=job.threads, speed=job.speed)


def main(job: Job) -> int:
    """Be the planner until SIGTERM; exit status 2 and one line if it is asked for what it cannot do."""
    stopped = until_told(job.parent)
    if not (job.real_time and allowed()):
        os.nice(NICE)
    torch.set_num_threads(1)
    cores = len(os.sched_getaffinity(0))  # the engine would have a thread for each core of the machine
    try:
        planner = planner_of(replace(job, threads=job.threads or cores))
        planner.warm()
    except ValueError as error:
        print(f"planner: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    print("ready", flush=True)
    run(Board(job.board), planner, stopped)
    return 0


if __name__ == "__main__":
    sys.exit(main(told()))
