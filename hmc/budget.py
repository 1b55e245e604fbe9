"""How much a search may spend, and what it has spent."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from hmc.evaluate import Evaluator
from hmc.neighbours import Neighbours


@dataclass(frozen=True)
class Budget:
    """Limits on one call of `plan`; None is no limit.

    The incumbent is always rolled out, whatever the budget. Beyond that, draws are never exceeded, nor
    are control steps where modes make none of their own. What a sampling mode will roll out inside
    itself is not known before; it is reckoned by what the rollouts before took. Control steps that suffice
    for less than a quarter of the largest batch so far are left unspent. A wall-clock budget is
    looked at before every control step; a batch that it cuts short is dropped, and the result may then
    depend on the machine's speed.

    Attributes:
        draws: switches drawn from Omega.
        control_steps: control steps rolled out, over all worlds and inside the modes.
        seconds: wall-clock time [s].
    """

    draws: int | None = None
    control_steps: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        for name in ("draws", "control_steps", "seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"budget {name} must be more than 0, got {value}: leave it out for no limit")


@dataclass
class Meter:
    """A budget being spent by one search with one evaluator; time runs from its making."""

    budget: Budget
    evaluator: Evaluator
    draws: int = 0
    began: float = field(default_factory=lambda: time.perf_counter())

    @property
    def elapsed(self) -> float:
        """Time since the search began [s]."""
        return time.perf_counter() - self.began

    def expired(self) -> bool:
        """Whether the wall-clock budget is spent."""
        return self.budget.seconds is not None and self.elapsed >= self.budget.seconds

    def room(self, wanted: int) -> tuple[int, str]:
        """How many of `wanted` draws may be made now, and which limit is the tightest."""
        if self.expired():
            return 0, "seconds"
        if self.budget.draws is not None and self.budget.draws - self.draws < wanted:
            return int(self.budget.draws - self.draws), "draws"  # of 1e4, too
        return wanted, ""

    def affordable(self, schedules: Tensor | Neighbours) -> int:
        """How many of schedules (n, T), the first ones, the control steps that are left suffice for.

        Where modes roll out inside themselves, a step is reckoned at what one took so far. What pruning
        saves is seen after the batch, so that the same draws are made whatever the machine.
        """
        if self.budget.control_steps is None:
            return len(schedules)
        left, each = self.budget.control_steps - self.evaluator.control_steps, self._nested
        if self.evaluator.most(len(schedules)) * each <= left:
            return len(schedules)
        return int(np.searchsorted(self.evaluator.needs(schedules) * each, left, "right"))

    def settle(self) -> None:
        """Record the schedule followed last if there is room for that: a next search goes on from it.

        Not on an ensemble, whose members begin elsewhere then.
        """
        if self.evaluator.task.ensemble is not None:
            return
        steps, limit = self.evaluator.pending * self._nested, self.budget.control_steps
        if not self.expired() and (limit is None or self.evaluator.control_steps + steps <= limit):
            self.evaluator.record()

    @property
    def _nested(self) -> float:
        """Control steps made for each that is not made inside a mode, as far as that is known by now."""
        evaluator = self.evaluator
        inside = evaluator.control_steps - evaluator.own_steps
        # a few steps say little: one of them may have been a mode's re-planning
        return 1 + inside / max(evaluator.own_steps, evaluator.task.horizon)
