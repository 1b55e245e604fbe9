"""What schedules cost: rollouts in chunks of worlds, no schedule and no common beginning more than once."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hmc.branches import in_order
from hmc.rollout import Rolled, roll
from hmc.schedule import Schedule
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.task import Task
from hmc.trace import Trace, record, root
from hmc.worlds import Worlds


class _Known(NamedTuple):
    """Cost and terms of a schedule; where it was pruned, a lower bound of the cost and no terms."""

    cost: float
    terms: list[float] | None

    def answers(self, bound: float) -> bool:
        """Whether this is all that a caller with this bound asks for."""
        return self.terms is not None or self.cost > bound


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
        trunk: what was recorded last.
        rollouts: schedules rolled out so far.
        diverged: schedules among them whose world stopped being finite.
        pruned: schedules among them given up because their partial cost exceeded the bound.
        ruled_out: schedules that the task's rules do not allow; their cost is inf.
    """

    def __init__(self, task: Task, sim: Sim, start: Start, known: Trace | None = None):
        self.task, self.sim, self.start = task, sim, start
        self.rollouts = self.diverged = self.pruned = self.ruled_out = 0
        self._worlds = Worlds(task, sim)
        self.trunk = root(self._worlds, start)
        if known is not None and known.meets(self.trunk):
            self.trunk = known
        self._known: dict[bytes, _Known] = {}

    @property
    def control_steps(self) -> int:
        """Control steps made so far, over all worlds."""
        return self._worlds.control_steps

    @torch.no_grad()
    def costs(
        self, schedules: Tensor, bound: float = math.inf, stop: Callable[[], bool] | None = None
    ) -> Tensor:
        """Costs of schedules (N, T) long -> (N,) float64.

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
        keys = self._keys(schedules)
        todo: dict[bytes, int] = {}
        for row, key in enumerate(keys):
            known = self._known.get(key)
            if known is None or not known.answers(bound):
                todo.setdefault(key, row)
        fresh, rows = list(todo), torch.tensor(list(todo.values()), dtype=torch.long)
        fresh, rows = self._allowed(fresh, rows, schedules)
        if len(fresh) > self.sim.num_worlds:  # neighbours share most: let them be in one chunk
            order = in_order(schedules[rows].cpu().numpy(), self.trunk.modes[: len(self.trunk)])
            fresh, rows = [fresh[i] for i in order], rows[order]
        for first in range(0, len(fresh), self.sim.num_worlds):
            chunk = slice(first, first + self.sim.num_worlds)
            rolled = roll(self._worlds, self.trunk, schedules[rows[chunk]], bound, stop)
            if rolled is None:
                break
            self._learn(fresh[chunk], rolled)
        return torch.tensor([self._answer(key, bound) for key in keys], dtype=torch.float64)

    @torch.no_grad()
    def follow(self, schedule: Schedule) -> float:
        """Cost of a schedule that is recorded, so that others are rolled out from where they part from it."""
        rows = schedule.tensor()[None]
        key = self._keys(rows)[0]
        known = self._known.get(key)
        if known is None and not self._allowed([key], torch.tensor([0]), rows)[0]:
            return math.inf
        if known is not None and known.terms is not None and not math.isfinite(known.cost):
            return math.inf
        self.trunk = record(self._worlds, self.trunk, schedule)
        if known is None or known.terms is None:
            self.rollouts += 1
            self.ruled_out += self.trunk.barred
            self.diverged += not (math.isfinite(self.trunk.cost) or self.trunk.barred)
            self._known[key] = _Known(self.trunk.cost, self.trunk.terms.tolist())
        return self.trunk.cost

    def cost(self, schedule: Schedule) -> float:
        """Cost of one schedule."""
        return float(self.costs(schedule.tensor()[None])[0])

    def terms(self, schedule: Schedule) -> dict[str, float]:
        """Cost of one schedule, term by term; NaN where its world diverged."""
        rows = schedule.tensor()[None]
        self.costs(rows)
        return dict(zip(self.task.cost.names, self._known[self._keys(rows)[0]].terms or (), strict=True))

    def trace(self, schedule: Schedule) -> Trace:
        """The trajectory of one schedule; its control steps are not counted."""
        return record(Worlds(self.task, self.sim), self.trunk, schedule)

    def _allowed(self, keys: list[bytes], rows: Tensor, schedules: Tensor) -> tuple[list[bytes], Tensor]:
        """The keys and rows of schedules that break no rule; what breaks one is known to cost inf."""
        rules = self.task.rules
        if rules is None or not keys:
            return keys, rows
        broken = rules.broken(self.task.modes, schedules[rows], self.start.mode, self.start.ran)
        for i in broken.nonzero().squeeze(1).tolist():
            self._known[keys[i]] = _Known(math.inf, [math.nan] * len(self.task.cost.names))
        self.ruled_out += int(broken.sum())
        return [key for key, bad in zip(keys, broken.tolist(), strict=True) if not bad], rows[~broken]

    def _learn(self, keys: list[bytes], rolled: Rolled) -> None:
        self.rollouts += len(keys)
        self.diverged += int(rolled.diverged.sum())
        self.pruned += int(rolled.pruned.sum())
        self.ruled_out += int(rolled.barred.sum())
        rows = zip(rolled.cost.tolist(), rolled.terms.tolist(), rolled.pruned.tolist(), strict=True)
        for key, (cost, terms, pruned) in zip(keys, rows, strict=True):
            self._known[key] = _Known(cost, None if pruned else terms)

    def _answer(self, key: bytes, bound: float) -> float:
        known = self._known.get(key)
        if known is None or not known.answers(bound):
            return math.nan
        return math.inf if known.terms is None else known.cost

    def _keys(self, schedules: Tensor) -> list[bytes]:
        small = torch.uint8 if len(self.task.modes) <= 256 else torch.int32
        return [row.tobytes() for row in schedules.to("cpu", small).numpy()]
