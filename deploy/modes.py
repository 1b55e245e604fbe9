"""Runs, tick by tick, the mode that the current plan names: policies, and the jump as it was planned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from deploy.observe import anchor_of
from deploy.settings import PlanCfg
from deploy.slots import STEPS
from deploy.so3 import Array
from hmc.go2.network import Network, follow

NAMES = ("foot", "jump", "hand")  # the modes of hmc.go2.task.flip_task, in its order
FOOT, JUMP, HAND = range(3)
NONE = -1
_MEMORY = 256  # ticks whose modes are remembered


@dataclass(frozen=True, eq=False)
class Plan:
    """A schedule for ticks from `begin` on.

    Attributes:
        number: counts the plans.
        base: tick of the state it was made from.
        begin: tick of its first step.
        running: mode that it takes to run before that; NONE for none.
        modes: of each step.
        u: joint targets predicted for each step [rad], (steps, 12).
    """

    number: int
    base: int
    begin: int
    running: int
    modes: tuple[int, ...]
    u: Array

    @classmethod
    def read(cls, record: np.ndarray) -> Self:
        """The plan in a slot's value.

        Raises:
            ValueError: it holds modes or steps that are none, or targets that are not numbers.
        """
        number, base, begin, running, steps = (
            int(record[name]) for name in ("number", "base", "begin", "running", "steps")
        )
        if not (0 < steps <= STEPS and 0 <= base <= begin):
            raise ValueError(f"plan {number} has {steps} steps from tick {begin} on, made at tick {base}")
        modes, u = tuple(record["modes"][:steps].tolist()), record["u"][:steps].astype(np.float64)
        if not all(0 <= mode < len(NAMES) for mode in modes):
            raise ValueError(f"plan {number} has {steps} steps of modes {sorted(set(modes))}")
        if not np.isfinite(u).all():
            raise ValueError(f"plan {number} has targets that are not numbers")
        return cls(number, base, begin, running, modes, u)


class Performer:
    """Takes plans over when their time comes, and runs their modes.

    A plan was made for the state that the plan before it leads to. It is taken over only if what ran since is
    what it reckoned with: then it may even come late. One that is older than `expires` starts no other mode:
    a stance is kept, and a jump is finished and followed by the handstand.

    Attributes:
        mode: that ran last; NONE before the first.
        anchor: where it was entered, or what `hmc.go2.observe.follow` makes of that, (4,).
        entered: tick at which it was.
        plan: that runs; None before the first.
        counts: plans taken over, late and stale.

    Args:
        cfg: rules.
        policies: of the modes that are policies.
    """

    def __init__(self, cfg: PlanCfg, policies: Mapping[int, Network]):
        self.cfg = cfg
        self.mode, self.entered = NONE, 0
        self.anchor: Array = np.array([0.0, 0.0, 1.0, 0.0])
        self.plan: Plan | None = None
        self.counts: Counter[str] = Counter()
        self._policies = policies
        self._coming: list[Plan] = []  # in the order of their begins
        self._ran: dict[int, int] = {}

    def offer(self, plan: Plan) -> None:
        """A plan has come: it runs from its begin on, unless a newer one begins before that."""
        self._coming = [other for other in self._coming if other.begin < plan.begin] + [plan]

    def act(self, k: int, x: Array, u: Array) -> Array:
        """Joint targets of tick k [rad], (12,); `take_over` goes before.

        Args:
            k: tick.
            x: state, (37,).
            u: targets commanded last [rad], (12,).
        """
        mode = self._choose(k)
        if self.mode == JUMP and mode == HAND and not self._planned(k, HAND):
            self.plan = None  # the jump was cut short: what the plan says after it is void
        if mode != self.mode:
            self.mode, self.entered, self.anchor = mode, k, anchor_of(x)
        self._ran[k] = mode
        self._ran.pop(k - _MEMORY, None)
        if mode == JUMP:
            assert self.plan is not None
            return self.plan.u[k - self.plan.begin]
        self.anchor = follow(x[None], self.anchor[None])[0]
        return self._policies[mode].act(x[None], u[None], self.anchor[None])[0]

    def take_over(self, k: int) -> None:
        """Make the newest of the plans whose time has come by tick k the one that runs, if it can be."""
        ripe = [plan for plan in self._coming if plan.begin <= k]
        if not ripe:
            return
        self._coming, plan = self._coming[len(ripe) :], ripe[-1]
        if k - plan.begin >= self.cfg.expires:  # nor is what ran since worth a look, however much that is
            self.counts["late"] += 1
            return
        before = [self._ran.get(tick, NONE) for tick in range(plan.begin - 1, k)]
        if before != [plan.running, *plan.modes[: k - plan.begin]]:
            self.counts["stale"] += 1
        else:
            self.counts["taken"] += 1
            self.plan = plan

    def _planned(self, k: int, mode: int) -> bool:
        """Whether the plan names this mode for a tick."""
        plan = self.plan
        return plan is not None and k - plan.begin < len(plan.modes) and plan.modes[k - plan.begin] == mode

    def _choose(self, k: int) -> int:
        """The mode of tick k."""
        plan = self.plan
        begin, modes = (0, ()) if plan is None else (plan.begin, plan.modes)
        return due(self.cfg, begin, modes, k, self.mode, self.entered)


def due(cfg: PlanCfg, begin: int, modes: Sequence[int], k: int, mode: int, entered: int) -> int:
    """The mode that a plan makes run at a tick; the planner reckons with the same.

    Args:
        cfg: rules.
        begin: tick of the plan's first step.
        modes: of its steps; none before the first plan.
        k: the tick.
        mode: that ran before it; NONE for none.
        entered: tick at which that was entered.
    """
    i = k - begin
    if mode == JUMP:
        over = i >= len(modes) or k - entered >= cfg.jump
        # a plan that is too old may end the jump, but only in the stance that jumps end in
        wanted = HAND if over else modes[i]
        return wanted if i < cfg.expires or wanted == JUMP else HAND
    return modes[i] if i < min(cfg.expires, len(modes)) else FOOT if mode == NONE else mode
