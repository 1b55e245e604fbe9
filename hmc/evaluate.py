"""What schedules cost: rollouts in chunks of worlds, no schedule and no common beginning more than once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.branches import added_steps, in_order
from hmc.neighbours import Neighbours
from hmc.record import record
from hmc.rollout import Rolled, roll
from hmc.schedule import Schedule
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.table import Rows, Table
from hmc.task import Task
from hmc.trace import Trace, Traces, roots
from hmc.worlds import Worlds


class Evaluator:
    """Costs of schedules from one start.

    A schedule's cost does not depend on which others are evaluated with it, in which order, or in how
    large a simulator. A world whose state, input or cost stops being finite costs inf, is counted, and is
    not stepped any more. Results are kept: an equal schedule is never rolled out twice, but for one that
    others are built on, see `aim`.

    Schedules that begin alike share the rollout of their beginning: with the one that `follow` recorded,
    and with each other as far as they fit into the simulator together.

    Where the task has an ensemble, a schedule is rolled out on all of its members at once and costs their
    risk. It is inf where one of them diverges or is barred; then, and once the risk is sure to exceed the
    bound, none of them is stepped any more.

    Args:
        task: what to roll out.
        sim: where; made with `task.make_sim`. An ensemble has a simulator of its own, for as many schedules
            at a time as this one has worlds.
        start: where from; each member of an ensemble is `disturb`ed from there.
        known: a trace from earlier evaluations; where it meets `start` bit for bit, its steps are taken over.
            None is, where an ensemble has several members.

    Attributes:
        size: schedules that are rolled out at a time.
        rollouts: schedules rolled out so far.
        diverged: schedules among them with a world that stopped being finite.
        pruned: schedules among them given up because they were sure to exceed the bound.
        ruled_out: schedules that the task's rules do not allow; their cost is inf.
    """

    def __init__(self, task: Task, sim: Sim, start: Start, known: Trace | None = None):
        self.task, self.start, self.size = task, start, sim.num_worlds
        self.sim = sim if task.ensemble is None else task.ensemble.sim(self.size)
        self.rollouts = self.diverged = self.pruned = self.ruled_out = 0
        self._broke: list[Tensor] = []  # schedules that broke a rule
        self._barred = np.zeros(len(task.modes), dtype=np.int64)  # those that a guard barred, by its mode
        self._worlds = Worlds(task, self.sim)
        self._root = roots(self._worlds, [start] if task.ensemble is None else task.ensemble.starts(start))
        if known is not None and len(self._root) == 1 and known.meets(self._root[0]):
            self._root = (known if known.ran == start.ran else replace(known, ran=start.ran),)
        self.renew()

    def renew(self) -> None:
        """Begin anew, whatever an interrupt left half done; counts go on."""
        self._trunk = self._root
        self._next: Schedule | None = None  # to be recorded with the next batch
        self._again = False  # it is rolled out with each batch in place of that
        self._traces: dict[int, Callable[[], Traces]] = {}  # of the last batch, where they were kept
        self._table = Table(len(self.task.modes), len(self.task.cost.names))

    @property
    def control_steps(self) -> int:
        """Control steps made so far, over all worlds and inside the modes."""
        return self._worlds.control_steps

    @property
    def own_steps(self) -> int:
        """Those among them that were not made inside a mode."""
        return self._worlds.own_steps

    @property
    def why_not(self) -> dict[str, int]:
        """How many of the schedules `ruled_out` each rule bars, a guard by the mode that it is of."""
        rules, modes, found = self.task.rules, self.task.modes, {}
        if rules is not None and self._broke:
            self._broke = [torch.cat(self._broke)]
            found = rules.reasons(modes, self._broke[0], self.start.mode, self.start.ran)
        guards = {f"guard of {modes.names[i]}": int(self._barred[i]) for i in self._barred.nonzero()[0]}
        return found | guards

    @property
    def trunk(self) -> Trace:
        """The trace of the schedule recorded last, on the first member."""
        return self._trunk[0]

    @property
    def trunks(self) -> Traces:
        """The same on each member of an ensemble; one where there is none."""
        return self._trunk

    @property
    def pending(self) -> int:
        """Control steps, modes' own aside, that it takes to record what is followed; 0 if it is recorded."""
        if self._next is None:
            return 0
        return len(self._trunk) * int(added_steps(self._next.tensor()[None], self._lead)[1][0])

    @torch.no_grad()
    def costs(
        self,
        schedules: Tensor | Neighbours,
        bound: float = math.inf,
        stop: Callable[[], bool] | None = None,
    ) -> Tensor:
        """Costs of schedules (N, T) -> (N,) float64.

        Args:
            schedules: mode indices; or the neighbours of one schedule, which takes less time.
            bound: a schedule that costs more may come back as inf, because its rollout was given up on
                the way; what costs at most `bound` is exact. Used where cost terms are non-negative.
            stop: asked before every control step; once it says True, what is not known yet comes back
                as NaN.
        """
        used = _used(schedules)
        if used.numel() and not 0 <= int(used.min()) <= int(used.max()) < len(self.task.modes):
            raise ValueError(
                f"schedules hold modes {int(used.min())} to {int(used.max())}: task "
                f"{self.task.name!r} has 0 to {len(self.task.modes) - 1}"
            )
        rows = self._table.rows(schedules)
        every = np.arange(len(rows))
        earliest = np.empty(rows.max(initial=0) + 1, dtype=np.int64)
        earliest[rows[::-1]] = every[::-1]
        todo = np.flatnonzero((earliest[rows] == every) & self._table.missing(rows, bound))  # each once
        todo = self._allowed(todo, rows, schedules)
        if len(todo) > self.size:  # neighbours share most: let them be in one chunk
            todo = todo[in_order(_spelt(_some(schedules, todo)).cpu(), self._lead)]
        first = 0
        while first < len(todo):
            beside = self._beside
            size = self.size - len(beside)
            chunk = todo[first : first + size]
            modes = beside[0].modes if beside else None
            recorded, ahead = (None, modes) if self._again else (modes, None)
            some = _some(schedules, chunk)
            rolled = roll(self._worlds, self._trunk, some, bound, stop, recorded, ahead)
            if rolled is None:
                break
            if rolled.trace is not None and self._next is not None:
                followed, self._trunk, self._next = self._next, rolled.trace, None
                self._know(followed)
            named = rows[chunk]
            if ahead is not None:
                named = np.concatenate([self._table.rows(beside[0].tensor()[None]), named])
            self._learn(named, rolled)
            self._keep(named, rolled)
            first += size
        return torch.from_numpy(self._table.costs(rows, bound))

    def needs(self, schedules: Tensor | Neighbours) -> NDArray[np.int64]:
        """Control steps, modes' own aside, that the costs of the first 1, 2, ... of schedules (N, T) take.

        Fewer if some are pruned or barred; none for those that break a rule.
        """
        new = self._table.missing(self._table.rows(schedules), math.inf)
        if self.task.rules is not None:
            new &= ~self._broken(_spelt(schedules)).cpu().numpy()
        wanted, horizon = _spelt(_some(schedules, np.flatnonzero(new))).cpu(), self.task.horizon
        ahead = [schedule.tensor()[None].to(wanted.dtype) for schedule in self._beside]
        shared, alone = added_steps(torch.cat([*ahead, wanted]), self._lead)
        # a part that does not fit into the simulator with those before it rolls one beginning out again, and
        # where it is rolled out with each batch, what is built on as well
        parts = np.arange(len(shared)) // max(1, self.size - len(ahead))
        steps = shared.cumsum() + parts * horizon * (2 if ahead and self._again else 1)
        if not ahead:
            steps = np.minimum(steps, alone.cumsum())
        return len(self._trunk) * np.concatenate([[0], steps])[len(ahead) + new.cumsum()]

    def most(self, number: int) -> int:
        """What `needs` says of so many schedules at most, without a look at them."""
        # each is rolled out whole, after what is recorded beside them, and each begins a part
        return len(self._trunk) * self.task.horizon * 2 * (number + 1)

    @torch.no_grad()
    def follow(self, schedule: Schedule) -> float:
        """Cost of a schedule, so that others are rolled out from where they part from it.

        A schedule of the last batch was recorded with it, if that was small. Another one whose cost is known
        is recorded together with the next batch, which costs as many control steps as alone and less time.
        """
        rows = self._table.rows(schedule.tensor()[None])
        self._again = self._again and schedule == self._next
        if not self._table.missing(rows, math.inf)[0]:
            cost = float(self._table.costs(rows, math.inf)[0])
            if math.isfinite(cost) and int(rows[0]) in self._traces:
                self._trunk = self._traces[int(rows[0])]()
            self._next = schedule if math.isfinite(cost) and schedule.modes != self.trunk.modes else None
            return cost
        if len(self._allowed(np.array([0]), rows, schedule.tensor()[None])) == 0:
            return math.inf
        self._next = schedule
        self.record()
        self._traces = {}
        return self._know(schedule)

    def aim(self, schedule: Schedule) -> None:
        """As `follow`, but a schedule of unknown cost is rolled out beside the next batch, if it has room.

        Where steps are cheap beside all batches that are built on it: to record it takes longer.
        """
        rows = schedule.tensor()[None]
        if self.size == 1 or not self._table.missing(self._table.rows(rows), math.inf)[0]:
            self.follow(schedule)
        elif len(self._allowed(np.array([0]), self._table.rows(rows), rows)) > 0:
            self._next, self._again = schedule, self._worlds.cheap

    @torch.no_grad()
    def record(self) -> None:
        """Record the schedule followed last now, if it is not yet."""
        if self._next is not None:
            self._trunk, self._next = record(self._worlds, self._trunk, self._next), None

    def cost(self, schedule: Schedule) -> float:
        """Cost of one schedule."""
        return float(self.costs(schedule.tensor()[None])[0])

    def terms(self, schedule: Schedule) -> dict[str, float]:
        """Cost of one schedule, term by term; NaN where its world diverged."""
        rows = schedule.tensor()[None]
        self.costs(rows)
        terms = self._table.terms(int(self._table.rows(rows)[0]))
        return dict(zip(self.task.cost.names, terms.tolist(), strict=True))

    def trace(self, schedule: Schedule) -> Trace:
        """The trajectory of one schedule, on the first member; its control steps are not counted."""
        return record(Worlds(self.task, self.sim), self._trunk, schedule)[0]

    @property
    def _lead(self) -> tuple[int, ...]:
        """The modes of those steps that were recorded last."""
        return self.trunk.modes[: len(self.trunk)]

    @property
    def _beside(self) -> list[Schedule]:
        """What the next batch is to record, if it has room for it."""
        return [self._next] if self._next is not None and self.size > 1 else []

    def _broken(self, schedules: Tensor) -> Tensor:
        """Which of schedules (N, T) break the task's rules, (N,) bool."""
        assert self.task.rules is not None
        return self.task.rules.broken(self.task.modes, schedules, self.start.mode, self.start.ran)

    def _allowed(self, at: Rows, rows: Rows, schedules: Tensor | Neighbours) -> Rows:
        """Those of the schedules `at` (n,) that break no rule; what breaks one is known to cost inf."""
        rules = self.task.rules
        if rules is None or len(at) == 0:
            return at
        asked = _spelt(_some(schedules, at))
        found = self._broken(asked)
        broken = found.cpu().numpy()
        out = rows[at[broken]]
        if len(out) > 0:
            self._broke.append(asked[found])
        nothing = np.full((len(out), len(self.task.cost.names)), math.nan)
        self._table.learn(out, np.full(len(out), math.inf), np.zeros(len(out), dtype=bool), nothing)
        self.ruled_out += len(out)
        return at[~broken]

    def _keep(self, rows: Rows, rolled: Rolled) -> None:
        """How to come by the traces of schedules just rolled out."""
        traces, whole = rolled.traces, ~rolled.pruned.numpy()
        self._traces = (
            {} if traces is None else {int(rows[i]): partial(traces, i) for i in whole.nonzero()[0].tolist()}
        )

    def _know(self, schedule: Schedule) -> float:
        """Take down what the schedule costs that was just recorded, if that is new; its cost."""
        rows = self._table.rows(schedule.tensor()[None])
        if self._table.missing(rows, math.inf)[0]:
            cost, terms = self.trunk.cost, self.trunk.terms
            if self.task.ensemble is not None:
                costs = torch.tensor([[each.cost for each in self._trunk]], dtype=torch.float64)
                cost = float(self.task.ensemble.risk(costs)[0])
                terms = self.task.ensemble.terms(torch.stack([each.terms for each in self._trunk])[None])[0]
            self._tally(
                np.array([not (math.isfinite(cost) or self.trunk.barred)]),
                np.array([self.trunk.modes[len(self.trunk)] if self.trunk.barred else -1]),
            )
            self._table.learn(rows, np.array([cost]), np.array([False]), terms.cpu().numpy()[None])
        return float(self._table.costs(rows, math.inf)[0])

    def _learn(self, rows: Rows, rolled: Rolled) -> None:
        """Take down what came of (n,) rows; the first one may be known."""
        known = 0 if self._table.missing(rows[:1], math.inf)[0] else 1
        ends = (rolled.diverged, rolled.pruned, rolled.barred)
        diverged, pruned, barred = (part[known:].cpu().numpy() for part in ends)
        self.pruned += int(pruned.sum())
        self._tally(diverged, barred)
        cost, terms = rolled.cost[known:].cpu().numpy(), rolled.terms[known:].cpu().numpy()
        self._table.learn(rows[known:], cost, pruned, terms)

    def _tally(self, diverged: NDArray[np.bool_], barred: NDArray[np.int64]) -> None:
        """Count schedules just rolled out: who diverged (n,), which mode a guard barred (n,), -1 for none."""
        self.rollouts += len(diverged)
        self.diverged += int(diverged.sum())
        stopped = barred[barred >= 0]
        self.ruled_out += len(stopped)
        self._barred += np.bincount(stopped, minlength=len(self._barred))


def _spelt(schedules: Tensor | Neighbours) -> Tensor:
    """Schedules as mode indices, (N, T)."""
    return schedules.tensor() if isinstance(schedules, Neighbours) else schedules


def _used(schedules: Tensor | Neighbours) -> Tensor:
    """All modes that occur in schedules."""
    if isinstance(schedules, Neighbours):
        return torch.from_numpy(np.r_[schedules.base.modes, schedules.mode])
    return schedules


def _some(schedules: Tensor | Neighbours, at: Rows) -> Tensor | Neighbours:
    """Rows of schedules (N, T), laid out as `Neighbours` and the rollout have them: by steps."""
    if isinstance(schedules, Neighbours):
        return schedules[at]
    return schedules.T.index_select(1, torch.from_numpy(at).to(schedules.device)).T
