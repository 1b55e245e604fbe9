"""How much a search may spend, and what it has spent."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from hmc.robust import AnyEvaluator


@dataclass(frozen=True)
class Budget:
    """Limits on one call of `plan`; None is no limit.

    The incumbent is always rolled out, whatever the budget. Beyond that, draws are never exceeded, nor
    are control steps where modes make none of their own. What a sampling mode will roll out inside
    itself is not known before; a batch is cut to what the rollouts before it took. A wall-clock budget is
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
    evaluator: AnyEvaluator
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
        """How many of `wanted` draws may be evaluated now, and which limit is the tightest.

        A draw is reckoned at its full T control steps, or at what a rollout took so far where modes roll
        out inside themselves: what pruning and repeats save is seen after the batch, so that the same
        draws are made whatever the machine.
        """
        if self.expired():
            return 0, "seconds"
        rooms = [(wanted, "")]
        if self.budget.draws is not None:
            rooms.append((self.budget.draws - self.draws, "draws"))
        if self.budget.control_steps is not None:
            used = self.evaluator.control_steps
            left = self.budget.control_steps - used
            rollout = max(self.evaluator.task.horizon, used // max(1, self.evaluator.rollouts))
            each = rollout * self.evaluator.models
            rooms.append((max(0, left // each), "control_steps"))
        return min(rooms)
