"""What schedules cost: rollouts in chunks of worlds, no schedule and no common beginning more than once."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.branches import added_steps, in_order
from hmc.rollout import Rolled, record, roll
from hmc.schedule import Schedule
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.table import Table
from hmc.task import Task
from hmc.trace import Trace, root
from hmc.worlds import Worlds


class Evaluator:
    """Costs of schedules from one start.

    A schedule's cost does not depend on which others are evaluated with it, in which order, or in how
    large a simulator. A world whose state, input or cost stops being finite costs inf, is counted, and is
    not stepped any more. Results are kept: an equal schedule is never rolled out twice.

    Schedules that begin alike share the rollout of their beginning: with the one that `follow` recorded,
    and with each other as far as they fit into the simulator together.

    Args:
        task: what to roll out.
        sim: where; made with `task.make_sim`.
        start: where from.
        known: a trace from earlier evaluations; where it meets `start` bit for bit, its steps are taken over.

    Attributes:
        rollouts: schedules rolled out so far.
        diverged: schedules among them whose world stopped being finite.
        pruned: schedules among them given up because they were sure to exceed the bound.
        ruled_out: schedules that the task's rules do not allow; their cost is inf.
    """

    def __init__(self, task: Task, sim: Sim, start: Start, known: Trace | None = None):
        self.task, self.sim, self.start = task, sim, start
        self.rollouts = self.diverged = self.pruned = self.ruled_out = 0
        self._worlds = Worlds(task, sim)
        self._trunk = root(self._worlds, start)
        if known is not None and known.meets(self._trunk):
            self._trunk = known
        self._next: Schedule | None = None  # to be recorded with the next batch
        self._traces: dict[bytes, Callable[[], Trace]] = {}  # of the last batch, where they were kept
        self._table = Table(len(task.modes), len(task.cost.names))

    @property
    def control_steps(self) -> int:
        """Control steps made so far, over all worlds and inside the modes."""
        return self._worlds.control_steps

    @property
    def own_steps(self) -> int:
        """Those among them that were not made inside a mode."""
        return self._worlds.own_steps

    @property
    def trunk(self) -> Trace:
        """The trace of the schedule recorded last."""
        return self._trunk

    @property
    def pending(self) -> int:
        """Control steps, modes' own aside, that it takes to record what is followed; 0 if it is recorded."""
        if self._next is None:
            return 0
        lead = self._trunk.modes[: len(self._trunk)]
        return int(added_steps(self._next.tensor()[None], lead)[1][0])

    @torch.no_grad()
    def costs(
        self, schedules: Tensor, bound: float = math.inf, stop: Callable[[], bool] | None = None
    ) -> Tensor:
        """Costs of schedules (N, T) -> (N,) float64.

        Args:
            schedules: mode indices.
            bound: a schedule that costs more may come back as inf, because its rollout was given up on
                the way; what costs at most `bound` is exact. Used where cost terms are non-negative.
            stop: asked before every control step; once it says True, what is not known yet comes back
                as NaN.
        """
        if schedules.numel() and not 0 <= int(schedules.min()) <= int(schedules.max()) < len(self.task.modes):
            raise ValueError(
                f"schedules hold modes {int(schedules.min())} to {int(schedules.max())}: task "
                f"{self.task.name!r} has 0 to {len(self.task.modes) - 1}"
            )
        keys = self._table.keys(schedules)
        missing = np.flatnonzero(self._table.missing(self._table.find(keys), bound))
        todo: dict[bytes, int] = {}
        for row in missing.tolist():
            todo.setdefault(keys[row], row)
        fresh, rows = self._allowed(
            list(todo), torch.tensor(list(todo.values()), dtype=torch.long), schedules
        )
        if len(fresh) > self.sim.num_worlds:  # neighbours share most: let them be in one chunk
            order = in_order(schedules[rows].cpu(), self._trunk.modes[: len(self._trunk)])
            fresh, rows = [fresh[i] for i in order], rows[order]
        first = 0
        while first < len(fresh):
            beside = self._beside
            size = self.sim.num_worlds - len(beside)
            chunk = slice(first, first + size)
            modes = beside[0].modes if beside else None
            rolled = roll(self._worlds, self._trunk, schedules[rows[chunk]], bound, stop, modes)
            if rolled is None:
                break
            if rolled.trace is not None:
                self._trunk, self._next = rolled.trace, None
            self._learn(fresh[chunk], rolled)
            self._keep(fresh[chunk], rolled)
            first += size
        return torch.from_numpy(self._table.costs(self._table.find(keys), bound))

    def needs(self, schedules: Tensor) -> NDArray[np.int64]:
        """Control steps, modes' own aside, that the costs of the first 1, 2, ... of schedules (N, T) take.

        Fewer if some are pruned or barred; none for those that break a rule.
        """
        new = self._table.missing(self._table.find(self._table.keys(schedules)), math.inf)
        if self.task.rules is not None:
            new &= ~self._broken(schedules).cpu().numpy()
        wanted, horizon = schedules[torch.from_numpy(new)].cpu(), self.task.horizon
        ahead = [schedule.tensor()[None].to(wanted.dtype) for schedule in self._beside]
        shared, alone = added_steps(torch.cat([*ahead, wanted]), self._trunk.modes[: len(self._trunk)])
        # a part that does not fit into the simulator with those before it rolls one beginning out again
        parts = np.arange(len(shared)) // max(1, self.sim.num_worlds - len(ahead))
        steps = shared.cumsum() + parts * horizon
        if not ahead:
            steps = np.minimum(steps, alone.cumsum())
        return np.concatenate([[0], steps])[len(ahead) + new.cumsum()]

    @torch.no_grad()
    def follow(self, schedule: Schedule) -> float:
        """Cost of a schedule, so that others are rolled out from where they part from it.

        A schedule of the last batch was recorded with it, if that was small. Another one whose cost is known
        is recorded together with the next batch, which costs as many control steps as alone and less time.
        """
        rows = schedule.tensor()[None]
        key = self._table.keys(rows)
        found = self._table.find(key)
        known = not bool(self._table.missing(found, math.inf)[0])
        if known:
            cost = float(self._table.costs(found, math.inf)[0])
            if math.isfinite(cost) and key[0] in self._traces:
                self._trunk = self._traces[key[0]]()
            self._next = schedule if math.isfinite(cost) and schedule.modes != self._trunk.modes else None
            return cost
        if found[0] < 0 and not self._allowed(key, torch.tensor([0]), rows)[0]:
            return math.inf
        self._next = schedule
        self.record()
        self._traces = {}
        trunk = self._trunk
        self.rollouts += 1
        self.ruled_out += trunk.barred
        self.diverged += not (math.isfinite(trunk.cost) or trunk.barred)
        terms = trunk.terms.cpu().numpy()
        self._table.learn(key, np.array([trunk.cost]), np.array([False]), terms[None])
        return trunk.cost

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
        terms = self._table.terms(int(self._table.find(self._table.keys(rows))[0]))
        return dict(zip(self.task.cost.names, terms.tolist(), strict=True))

    def trace(self, schedule: Schedule) -> Trace:
        """The trajectory of one schedule; its control steps are not counted."""
        return record(Worlds(self.task, self.sim), self._trunk, schedule)

    @property
    def _beside(self) -> list[Schedule]:
        """What the next batch is to record, if it has room for it."""
        return [self._next] if self._next is not None and self.sim.num_worlds > 1 else []

    def _broken(self, schedules: Tensor) -> Tensor:
        """Which of schedules (N, T) break the task's rules, (N,) bool."""
        assert self.task.rules is not None
        return self.task.rules.broken(self.task.modes, schedules, self.start.mode, self.start.ran)

    def _allowed(self, keys: list[bytes], rows: Tensor, schedules: Tensor) -> tuple[list[bytes], Tensor]:
        """The keys and rows of schedules that break no rule; what breaks one is known to cost inf."""
        rules = self.task.rules
        if rules is None or not keys:
            return keys, rows
        broken = self._broken(schedules[rows])
        out = [keys[i] for i in broken.nonzero().squeeze(1).tolist()]
        nothing = np.full((len(out), len(self.task.cost.names)), math.nan)
        self._table.learn(out, np.full(len(out), math.inf), np.zeros(len(out), dtype=bool), nothing)
        self.ruled_out += int(broken.sum())
        return [key for key, bad in zip(keys, broken.tolist(), strict=True) if not bad], rows[~broken]

    def _keep(self, keys: list[bytes], rolled: Rolled) -> None:
        """How to come by the traces of schedules just rolled out."""
        traces = rolled.traces
        self._traces = {} if traces is None else {key: partial(traces, i) for i, key in enumerate(keys)}

    def _learn(self, keys: list[bytes], rolled: Rolled) -> None:
        self.rollouts += len(keys)
        self.diverged += int(rolled.diverged.sum())
        self.pruned += int(rolled.pruned.sum())
        self.ruled_out += int(rolled.barred.sum())
        cost, pruned, terms = (part.cpu().numpy() for part in (rolled.cost, rolled.pruned, rolled.terms))
        self._table.learn(keys, cost, pruned, terms)
