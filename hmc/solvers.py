"""The single-switch problem, and the search that solves it again and again (Algorithms 1 and 2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from hmc.budget import Meter
from hmc.evaluate import Evaluator
from hmc.moves import handovers, moves
from hmc.neighbours import Neighbours
from hmc.schedule import Draws, InOrder, Schedule, Switch, SwitchSpace, TailsFirst

Pairs = list[tuple[Switch, ...]]
PARTS = 8  # of a horizon: switches from cut to cut come first, where that shows what can be given up
WORTH = 8  # others to each of them, at least: where there are few it takes longer than it saves


@dataclass
class Search:
    """A search under way: the best schedule so far, and how much of Omega speaks for it.

    Attributes:
        evaluator: gives the cost of schedules.
        meter: what may be spent.
        schedule: the best schedule so far, K_def of the paper.
        samples: N, switches a batch.
        tolerance: a switch counts only when it lowers the cost by more than this share of it.
        rng: where draws come from.
        order: of the draws, one of ORDERS.
        pairs: draws beside each batch that hand over by way of a third mode.
        moves: draws beside each batch that move a stretch of the schedule.
        max_samples: size that batches of one iteration double to; N throughout if that is larger.
        report: told after every batch and accepted switch; False ends the search.
        costs: the incumbent's cost once it is known, then the cost after each accepted switch or pair.
        switches: accepted switches.
        seen: how many switches of `schedule` were evaluated and do not improve it.
        stopped_by: why the search ended; None while it runs.
    """

    evaluator: Evaluator
    meter: Meter
    schedule: Schedule
    samples: int
    tolerance: float
    rng: np.random.Generator
    order: str = "uniform"
    pairs: int = 0
    moves: int = 0
    max_samples: int = 0
    report: Callable[[Search], bool | None] = lambda _: None
    costs: list[float] = field(default_factory=list)
    switches: list[Switch] = field(default_factory=list)
    seen: int = 0
    stopped_by: str | None = None
    _found: tuple[tuple[Switch, ...], float] | None = None
    _largest: int = 0

    def __post_init__(self) -> None:
        self.space = SwitchSpace(len(self.evaluator.task.modes), len(self.schedule))

    @property
    def bound(self) -> float:
        """What a switch has to get below: the best one found, else the schedule's cost less the tolerance."""
        if self._found is not None:
            return self._found[1]
        cost = self.costs[-1] if self.costs else math.inf
        return cost - self.tolerance * abs(cost) if math.isfinite(cost) else cost

    @property
    def found(self) -> bool:
        """Whether there is something to accept."""
        return self._found is not None

    def begin(self) -> None:
        """Find out what the incumbent costs, if that is not known yet."""
        if not self.costs:
            self.costs.append(self.evaluator.follow(self.schedule))

    def batches(
        self, order: Draws | TailsFirst | InOrder, beside: bool = False
    ) -> Iterator[tuple[Tensor, Tensor, Pairs, Tensor]]:
        """Switches of Omega in an order, batch by batch: indices and costs, (n,) each; inf if not known.

        With `beside`, also what takes two switches, of which the first alone need not improve, and the costs
        of that: see `hmc.moves`. All of it is rolled out together, which takes least time.
        """
        waiting, size = torch.empty(0, dtype=torch.long), self.samples
        if self.costs:
            self.evaluator.follow(self.schedule)
        else:
            self.evaluator.aim(self.schedule)
        while order.left > 0 or len(waiting) > 0:
            waiting = torch.cat([waiting, order.take(size - len(waiting))])
            room, limit = self.meter.room(len(waiting))
            if room <= 0:  # what would be tried beside it is not worked out
                self.stopped_by = limit
                return
            pairs = self._pairs(room) if beside else []
            single = self.space.neighbours(self.schedule, waiting[:room])
            batch: Tensor | Neighbours = single
            if pairs:
                others = np.array([self._stitched(switches).modes for switches in pairs])
                batch = single.tensor()
                batch = torch.cat([batch, torch.from_numpy(others).to(batch.dtype)])
            affordable = self.meter.affordable(batch)
            if 0 <= affordable < room:
                # few rollouts take as long as many: what is left over is not worth another round
                room, limit = affordable if 4 * affordable >= self._largest else 0, "control_steps"
            if room <= 0:
                self.stopped_by = limit
                return
            indices, waiting, self._largest = waiting[:room], waiting[room:], max(self._largest, room)
            pairs = pairs[: max(0, affordable - room)]
            costs = self._roll(batch[: room + len(pairs)])
            self.begin()
            known = ~costs.isnan()
            self.seen += int(known[:room].sum())
            found = torch.where(known, costs, math.inf)
            yield indices, found[:room], pairs, found[room:]
            if self.stopped_by or not known.all():
                self.stopped_by = self.stopped_by or "seconds"
                return
            size = max(self.samples, min(2 * size, self.max_samples))
            self.tell()

    def offer(self, switches: Sequence[Switch], cost: float, replace: bool = False) -> None:
        """Take note of one switch, or of some that are stitched one after the other, if below `bound`.

        With `replace`, also of what costs the same as what was noted before.
        """
        if cost < self.bound or (replace and self.found and cost == self.bound):
            self._found = tuple(switches), cost

    def _pairs(self, ahead: int) -> Pairs:
        """What is tried beside a batch of `ahead` draws."""
        k = self.evaluator.start.k
        room = self.meter.room(ahead + self.pairs + self.moves)[0] - ahead
        tried = handovers(self.space, k, k + len(self.switches), min(self.pairs, room))
        return tried + moves(self.schedule, self.rng, min(self.moves, room - len(tried)))

    def _stitched(self, switches: Sequence[Switch]) -> Schedule:
        """The schedule with switches stitched one after the other."""
        schedule = self.schedule
        for switch in switches:
            schedule = schedule.stitch(switch)
        return schedule

    def _roll(self, schedules: Tensor | Neighbours) -> Tensor:
        """Costs of a batch of draws (n, T), (n,); NaN where the clock cut it short."""
        stop = None if self.meter.budget.seconds is None else self.meter.expired
        costs = self.evaluator.costs(schedules, self.bound, stop)
        self.meter.draws += int((~costs.isnan()).sum())
        return costs

    def accept(self) -> bool:
        """Go on from the switch taken note of: K_def <- (m, mu, nu) u K_def. False if there is none."""
        if self._found is None:
            return False
        switches, cost = self._found
        self.schedule = self._stitched(switches)
        self.switches += switches
        self.costs.append(cost)
        self.seen, self._found = 0, None
        return True

    def tell(self) -> None:
        """Report, and end the search if told so."""
        if self.report(self) is False:
            self.stopped_by = "progress"


def sample(search: Search) -> None:
    """Algorithm 2: draw from Omega without replacement until a batch has a switch that improves.

    The batch's best is taken, not its first: the whole batch has been rolled out by then.
    """
    search.begin()
    draws = ORDERS[search.order](search)
    for indices, costs, pairs, theirs in search.batches(draws, beside=True):
        best = costs.argmin()
        search.offer([search.space[int(indices[best])]], float(costs[best]))
        if pairs:
            best = theirs.argmin()
            search.offer(pairs[int(best)], float(theirs[best]))
        if search.found:
            return


def exhaustive(search: Search) -> None:
    """Problem 5 solved exactly: the best of all of Omega; of equal ones, that of lowest index.

    Where a task bounds what is left of a rollout, the switches of a coarse grid come first: most of the
    others can be given up soon then.
    """
    size, task = len(search.space), search.evaluator.task
    bounded = task.cost.nonnegative and (task.lower_bound is not None or task.tail_bound is not None)
    first = search.space.coarse(PARTS) if bounded else None
    if first is None or min(size, search.samples) < WORTH * len(first):
        search.begin()
        first = None
    lowest = math.inf, size
    for indices, costs, _, _ in search.batches(InOrder(size, first)):
        best = int(costs.argmin())
        here = float(costs[best]), int(indices[best])
        if here < lowest:
            lowest = here
            search.offer([search.space[here[1]]], here[0], replace=True)


def _tails(search: Search) -> TailsFirst:
    k = search.evaluator.start.k
    return TailsFirst(search.space, search.rng, k, k * search.samples + search.meter.draws)


ORDERS: dict[str, Callable[[Search], Draws | TailsFirst]] = {
    "uniform": lambda search: Draws(len(search.space), search.rng),
    "tails": _tails,
}
SOLVERS: dict[str, Callable[[Search], None]] = {"sample": sample, "exhaustive": exhaustive}


def run(search: Search, solve: Callable[[Search], None], iterations: float) -> None:
    """Algorithm 1: solve the single-switch problem and stitch, until no switch improves."""
    while search.stopped_by is None:
        if len(search.switches) >= iterations:
            search.stopped_by = "iterations"
            return
        solve(search)
        accepted = search.accept()
        if search.stopped_by is None and not accepted:
            search.stopped_by = "converged"
        elif search.stopped_by is None:
            search.tell()
