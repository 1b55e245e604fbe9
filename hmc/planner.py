"""`plan`: from a task and a state to the best schedule that a budget allows, and what backs it.

What a schedule K in M^T costs from state x_0 at control step k_0, with dt the duration of a control step:

    J(K) = sum over i = 0 ... T - 1 of l(x_i, u_i, u_(i-1), k_0 + i) dt + c_f(x_T, k_0 + T),
    u_i = mode K_i at (x_i, u_(i-1), its memory, k_0 + i),  x_(i+1) = the simulator's step from x_i under u_i.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from hmc.budget import Budget, Meter
from hmc.evaluate import Evaluator
from hmc.memory import make_worlds
from hmc.schedule import Schedule, Switch, SwitchSpace
from hmc.sim.base import Sim
from hmc.sim.check import tell_overflow
from hmc.solvers import ORDERS, SOLVERS, Search, run
from hmc.start import Start, Vector, make_start
from hmc.task import Task
from hmc.trace import Trace

Progress = Callable[["Plan"], bool | None]


@dataclass(frozen=True)
class Plan:
    """What a search came to, so far or in the end.

    Attributes:
        schedule: the best schedule found.
        terms: its cost, term by term.
        incumbent: the schedule that the search began with.
        incumbent_terms: its cost, term by term.
        switches: accepted switches, in order; stitched onto `incumbent` they give `schedule`, unless
            that is the fallback.
        costs: the incumbent's cost, then the cost after each accepted switch, or pair of switches (never
            rising, Theorem 1).
        steps: why each of them: the switches accepted at once, and the cost's terms after them; one entry for
            each cost after the first.
        seen: switches of `schedule` that were evaluated and do not improve it.
        space_size: Z, how many there are.
        draws: switches evaluated in the whole search, repeats included.
        rollouts: schedules rolled out, one on all members of an ensemble counting once; fewer than draws, as
            equal ones are rolled out once. This and the other counts are not compared: what is pruned before
            it diverges depends on the simulator's size.
        control_steps: control steps rolled out, over all worlds and inside the modes; not compared, as
            schedules share their beginnings only where a batch fits into the simulator.
        diverged: rollouts with a world that stopped being finite; their cost is inf.
        ruled_out: schedules that the task's rules do not allow; their cost is inf.
        why_not: how many of these each rule bars, as "dwell of jump": 412; who breaks several counts once.
        fell_back: whether no schedule with a finite cost was found and `schedule` is the rules' fallback.
        stopped_by: "converged", "iterations", "draws", "control_steps", "seconds", "progress" or
            "interrupt"; "" while the search goes on.
        elapsed: wall-clock time [s]; not compared.
        known: what was recorded of the incumbent last gone out from: the next plan can begin with it;
            not compared.
    """

    schedule: Schedule
    terms: Mapping[str, float]
    incumbent: Schedule
    incumbent_terms: Mapping[str, float]
    switches: tuple[Switch, ...]
    costs: tuple[float, ...]
    steps: tuple[tuple[tuple[Switch, ...], Mapping[str, float]], ...]
    seen: int
    space_size: int
    draws: int
    rollouts: int = field(compare=False)
    control_steps: int = field(compare=False)
    diverged: int = field(compare=False)
    ruled_out: int = field(compare=False)
    why_not: Mapping[str, int] = field(compare=False)
    fell_back: bool
    stopped_by: str
    elapsed: float = field(compare=False)
    known: Trace = field(compare=False, repr=False)

    @property
    def cost(self) -> float:
        """J of `schedule`; inf where that is the fallback."""
        return self.costs[-1]

    @property
    def incumbent_cost(self) -> float:
        """J of `incumbent`."""
        return self.costs[0]

    @property
    def schedules(self) -> tuple[Schedule, ...]:
        """The incumbent and what each of `steps` made of it: one for each of `costs`; `schedule` is the last,
        unless that is the fallback."""
        made = [self.incumbent]
        for switches, _ in self.steps:
            made.append(reduce(Schedule.stitch, switches, made[-1]))
        return tuple(made)

    @property
    def gains(self) -> dict[str, float]:
        """Why these switches: how much each term of the cost changed, the largest fall first; NaN where the
        incumbent diverged."""
        change = {name: value - self.incumbent_terms[name] for name, value in self.terms.items()}
        return dict(sorted(change.items(), key=lambda item: item[1]))

    @property
    def coverage(self) -> float:
        """n / Z: share of `schedule`'s single switches known not to improve it.

        With draws in uniform order, the chance that a best one of them would have come by now (Theorem 2).
        """
        return self.seen / self.space_size

    @property
    def locally_optimal(self) -> bool:
        """Whether no single switch improves `schedule` by more than the tolerance (Proposition 1).

        Not where its cost is inf: then there is nothing that a switch could be measured by.
        """
        return self.seen == self.space_size and math.isfinite(self.cost)

    @property
    def machine_dependent(self) -> bool:
        """Whether the result depends on when it was stopped, so that another run may give another."""
        return self.stopped_by in ("seconds", "progress", "interrupt")

    def __str__(self) -> str:
        reasons = ", ".join(f"{number:,} by {rule}" for rule, number in self.why_not.items())
        against = f"{self.ruled_out:,} against the rules ({reasons})"
        lines = [
            str(self.schedule)
            + ("  (the fallback: no schedule has a finite cost)" if self.fell_back else ""),
            f"cost {self.cost:.6g} (incumbent {self.incumbent_cost:.6g}), {len(self.switches)} switches; "
            + ("locally optimal" if self.locally_optimal else f"coverage {self.coverage:.1%}")
            + f" of {self.space_size:,} switches",
            f"{self.draws:,} draws, {self.control_steps:,} control steps in {self.elapsed:.3g} s"
            + (f", {self.diverged} rollouts diverged" if self.diverged else "")
            + (f", {against}" if self.ruled_out else "")
            + (f"; stopped by {self.stopped_by}" if self.stopped_by else ""),
        ]
        if not math.isfinite(self.cost) and not self.fell_back:
            lines.insert(
                1,
                "no schedule tried is feasible: relax the rules, add a mode, or name what is to run then "
                "with Rules(fallback=...)",
            )
        if self.switches and math.isfinite(self.incumbent_cost):
            lines.append("by term: " + ", ".join(f"{name} {gain:+.4g}" for name, gain in self.gains.items()))
        if self.machine_dependent:
            lines.append(f"{self.stopped_by} is not a count: a run at another speed may find another plan")
        return "\n".join(lines)


class PlanInterrupted(KeyboardInterrupt):
    """Ctrl-C during `plan`: goes on up like any other, with the best plan so far in `plan`.

    Where the incumbent's cost is not known yet, that is rolled out first; a second Ctrl-C ends that too.
    """

    def __init__(self, plan: Plan):
        super().__init__(str(plan))
        self.plan = plan


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch on one thread: operations on a few thousand worlds are too small to share.

    Two threads gain nothing then, and where a core is busy each of the many operations waits for it.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@_one_thread()
def plan(
    task: Task,
    x: Vector | Start,
    *,
    u: Vector | None = None,
    mode: int | str | None = None,
    memory: Vector | None = None,
    k: int = 0,
    snapshot: Tensor | None = None,
    ran: int | None = None,
    schedule: Sequence[int | str] | None = None,
    solver: str = "sample",
    samples: int | None = None,
    max_samples: int = 0,
    order: str = "uniform",
    pairs: int = 0,
    moves: int = 0,
    iterations: int | None = None,
    budget: Budget | None = None,
    tolerance: float = 1e-6,
    seed: int | Sequence[int] = 0,
    progress: Progress | None = None,
    sim: Sim | None = None,
    room: float | None = None,
    forget: bool = True,
    known: Trace | None = None,
) -> Plan:
    """Search the mode schedules of `task` from state x, from an incumbent towards lower cost.

    The result is never worse than the incumbent. With the same arguments it is the same, whatever the
    number of worlds or threads, unless the clock, `progress` or Ctrl-C ended the search; but a budget of
    control steps reaches less far in a simulator that a batch does not fit into. Torch works on one thread
    meanwhile; engines and policies have threads of their own.

    Args:
        task: modes, cost, horizon T and simulator.
        x: state to plan from, (nx,); or a `Start`, which has u, mode, memory, k, snapshot and ran
            inside.
        u: input applied last, (nu,); zero if left out.
        mode: the mode now running, by index or name.
        memory: what that mode remembers, (its memory_size,): a schedule that begins with `mode` goes on
            with it. Left out, it is made anew; for rules the mode goes on running.
        k: control steps since the start of the task.
        snapshot: the engine's snapshot row of x, if the world is simulated by the same engine.
        ran: control steps that the running mode has run, for rules on dwell times; None: long enough.
        schedule: the incumbent, T modes by index or name; by default `mode` (else mode 0) throughout.
        solver: "sample" (Algorithms 1 and 2) takes the best of the first batch that improves; "exhaustive"
            (Algorithm 1) evaluates all of Omega and takes the best.
        samples: N, switches drawn a batch; left out, 64, or where the solver is "exhaustive" all of Omega.
            What does not fit into the memory at once is rolled out in parts.
        max_samples: the batches of one iteration double up to this size, since many at once are cheaper each;
            0 for N throughout.
        order: of "sample"'s draws: "uniform", as Theorem 2 has it, or "tails": the switches that last to
            the end of the horizon first. Either way each switch comes once.
        pairs: further draws that "sample" makes beside each batch: two switches at once, into a mode and
            on to a third (`hmc.moves.handovers`). What no single switch improves, two may. They do not
            count in `coverage`.
        moves: further draws beside each batch that move a stretch of the schedule, or one of its ends
            (`hmc.moves.moves`); they do not count either.
        iterations: at most this many improvements are accepted, of one switch each, or of two that `pairs` or
            `moves` found; None for as many as there are.
        budget: limits on draws, control steps and seconds.
        tolerance: a switch counts if it lowers the cost by more than this share of it.
        seed: of the draws.
        progress: called with the plan so far after every batch and accepted switch; False stops.
        sim: simulator to plan in, made with `task.make_sim`; made anew if left out.
        room: bytes that the worlds made then may take, see `hmc.memory`; None for what a GPU has free, on a
            CPU for any.
        forget: let modes drop what they kept from earlier searches. A receding loop keeps it: then what
            a budget of control steps reaches depends on the ticks before.
        known: `Plan.known` of an earlier plan of this task, cut to where this one begins (`Trace.since`): if
            it meets the state bit for bit, its steps are not rolled out again. The plan is the same.

    Raises:
        ValueError: an argument that makes no sense, or not even one schedule fits into the memory.
        PlanInterrupted: on Ctrl-C; a KeyboardInterrupt that carries the best plan so far.
    """
    if np.min(seed) < 0:
        raise ValueError(f"seed must be >= 0, got {seed}")
    _known("solver", solver, SOLVERS)
    _known("order", order, ORDERS)
    samples = batch_of(task, solver, samples)
    _check(samples, max_samples, pairs, moves, iterations, tolerance)
    if sim is None:
        sim = make_worlds(task, worlds_for(task, samples, max_samples, pairs + moves), room)
    if forget:
        for each in task.modes:
            each.forget()
    if isinstance(x, Start):
        if any(value is not None for value in (u, mode, memory, snapshot, ran)) or k != 0:
            raise ValueError(
                "a Start has u, mode, memory, k, snapshot and ran inside: do not pass them as well"
            )
        u, mode, memory, k, snapshot = x.u, x.mode, x.memory if x.mode is not None else None, x.k, x.snapshot
        ran, x = x.ran, x.x
    start = make_start(task, sim, x, u, mode, memory, k, snapshot, ran)
    meter = Meter(budget or Budget(), Evaluator(task, sim, start, known))
    search = Search(
        meter.evaluator,
        meter,
        _incumbent(task, start, schedule),
        samples,
        tolerance,
        np.random.default_rng(seed),
        order,
        pairs,
        moves,
        max_samples,
    )
    if progress is not None:
        search.report = lambda search: progress(_plan(search))
    try:
        if start.mode is not None:
            search.begin()
        run(search, SOLVERS[solver], math.inf if iterations is None else iterations)
        search.begin()
        search.evaluator.follow(search.schedule)
        meter.settle()
        for used in (search.evaluator.sim, *(sim for each in task.modes for sim in each.sims)):
            tell_overflow(used)
        return _plan(search)
    except KeyboardInterrupt:
        if not search.best.costs:
            search.evaluator.renew()
            search.begin()
        search.accept()
        search.stopped_by = search.stopped_by or "interrupt"
        raise PlanInterrupted(_plan(search)) from None


def batch_of(task: Task, solver: str, samples: int | None) -> int:
    """N: what was asked for, else 64, or all of Omega for a solver that evaluates all of it."""
    if samples is not None:
        return samples
    return len(SwitchSpace(len(task.modes), task.horizon)) if solver == "exhaustive" else 64


def worlds_for(task: Task, samples: int, max_samples: int, beside: int) -> int:
    """Worlds that a batch fits into, with one more for the schedule that is recorded beside it."""
    single = min(max(samples, max_samples), len(SwitchSpace(len(task.modes), task.horizon)))
    return single + beside + 1


def _incumbent(task: Task, start: Start, schedule: Sequence[int | str] | None) -> Schedule:
    names = task.modes.names
    if schedule is None:
        return Schedule.constant(start.mode or 0, task.horizon, names)
    if len(schedule) != task.horizon:
        raise ValueError(
            f"task {task.name!r}: the incumbent schedule has {len(schedule)} steps, expected the horizon, "
            f"{task.horizon}"
        )
    return Schedule(tuple(task.modes.index(item) for item in schedule), names)


def _plan(search: Search) -> Plan:
    evaluator, best = search.evaluator, search.best
    schedule, modes, rules = best.schedule, evaluator.task.modes, evaluator.task.rules
    fallback = None if rules is None or math.isfinite(best.costs[-1]) else rules.fallback
    if fallback is not None:
        schedule = Schedule.constant(modes.index(fallback), len(schedule), modes.names)
    return Plan(
        schedule=schedule,
        terms=best.terms,
        incumbent=best.incumbent,
        incumbent_terms=best.incumbent_terms,
        switches=best.switches,
        costs=best.costs,
        steps=best.steps,
        seen=best.seen,
        space_size=len(search.space),
        draws=search.meter.draws,
        rollouts=evaluator.rollouts,
        control_steps=evaluator.control_steps,
        diverged=evaluator.diverged,
        ruled_out=evaluator.ruled_out,
        why_not=evaluator.why_not,
        fell_back=fallback is not None,
        stopped_by=search.stopped_by or "",
        elapsed=search.meter.elapsed,
        known=evaluator.trunk,
    )


def _known(what: str, name: str, names: Mapping[str, object]) -> None:
    if name not in names:
        near = difflib.get_close_matches(name, names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown {what} {name!r}: expected one of {', '.join(names)}{hint}")


def _check(
    samples: int, max_samples: int, pairs: int, moves: int, iterations: int | None, tolerance: float
) -> None:
    if samples < 1:
        raise ValueError(f"samples must be at least 1 switch a batch, got {samples}")
    if max_samples < 0:
        raise ValueError(f"max_samples must be >= 0 switches a batch, got {max_samples}")
    for name, beside in (("pairs", pairs), ("moves", moves)):
        if beside < 0:
            raise ValueError(f"{name} must be >= 0 draws beside each batch, got {beside}")
    if iterations is not None and iterations < 0:
        raise ValueError(f"iterations must be >= 0, or None for no limit, got {iterations}")
    if not 0 <= tolerance < math.inf:
        raise ValueError(f"tolerance must be a finite share >= 0 of the cost, got {tolerance}")
