r"""The single-switch problem, and the search that solves it again and again (Algorithms 1 and 2).

Problem 5: of a schedule K_def in M^T, the switch that lowers its cost most,

    min over (m, mu, nu) in Omega of J((m, mu, nu) u K_def),

where (m, mu, nu) u K_def runs mode m in steps mu <= k < mu + nu and is K_def elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

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


@dataclass(frozen=True)
class Standing:
    """What a search has come to: one value, changed by one assignment, so that Ctrl-C always finds it whole.

    Attributes:
        incumbent: the schedule that the search began with.
        incumbent_terms: its cost, term by term, once it is known.
        schedule: the best schedule so far, K_def of the paper.
        terms: its cost, term by term, once it is known.
        costs: the incumbent's cost once it is known, then the cost after each accepted switch or pair.
        switches: accepted switches.
        steps: what was accepted at once, and the cost's terms after it.
        seen: how many switches of `schedule` were evaluated and do not improve it.
    """

    incumbent: Schedule
    incumbent_terms: Mapping[str, float]
    schedule: Schedule
    terms: Mapping[str, float]
    costs: tuple[float, ...] = ()
    switches: tuple[Switch, ...] = ()
    steps: tuple[tuple[tuple[Switch, ...], Mapping[str, float]], ...] = ()
    seen: int = 0


@dataclass
class Search:
    """A search under way: the best schedule so far, and how much of Omega speaks for it.

    Attributes:
        evaluator: gives the cost of schedules.
        meter: what may be spent.
        incumbent: the schedule to begin with.
        samples: N, switches a batch.
        tolerance: a switch counts only when it lowers the cost by more than this share of it.
        rng: where draws come from.
        order: of the draws, one of ORDERS.
        pairs: draws beside each batch that hand over by way of a third mode.
        moves: draws beside each batch that move a stretch of the schedule.
        max_samples: size that batches of one iteration double to; N throughout if that is larger.
        report: told after every batch and accepted switch; False ends the search.
        stopped_by: why the search ended; None while it runs.
        best: what it has come to.
        ahead: what it comes to if the switch that was taken note of is accepted; None if there is none.
    """

    evaluator: Evaluator
    meter: Meter
    incumbent: Schedule
    samples: int
    tolerance: float
    rng: np.random.Generator
    order: str = "uniform"
    pairs: int = 0
    moves: int = 0
    max_samples: int = 0
    report: Callable[[Search], bool | None] = lambda _: None
    stopped_by: str | None = None
    best: Standing = field(init=False)
    ahead: Standing | None = None
    _largest: int = 0

    def __post_init__(self) -> None:
        self.space = SwitchSpace(len(self.evaluator.task.modes), len(self.incumbent))
        self.best = Standing(self.incumbent, {}, self.incumbent, {})

    @property
    def schedule(self) -> Schedule:
        """The best schedule so far."""
        return self.best.schedule

    @property
    def bound(self) -> float:
        """What a switch has to get below: the best one found, else the schedule's cost less the tolerance."""
        if self.ahead is not None:
            return self.ahead.costs[-1]
        cost = self.best.costs[-1] if self.best.costs else math.inf
        return cost - self.tolerance * abs(cost) if math.isfinite(cost) else cost

    def begin(self) -> None:
        """Find out what the incumbent costs, if that is not known yet.

        If that is not finite, to stay in the running mode takes its place where that is.
        """
        if self.best.costs:
            return
        evaluator, incumbent = self.evaluator, self.incumbent
        cost, mode = evaluator.follow(incumbent), evaluator.start.mode
        if mode is not None and not math.isfinite(cost):
            stay = Schedule.constant(mode, len(incumbent), incumbent.names)
            other = evaluator.follow(stay)
            incumbent, cost = (stay, other) if math.isfinite(other) else (incumbent, cost)
        terms = evaluator.terms(incumbent)
        self.best = Standing(incumbent, terms, incumbent, terms, (cost,))

    def batches(
        self, order: Draws | TailsFirst | InOrder, beside: bool = False
    ) -> Iterator[tuple[Tensor, Tensor, Pairs, Tensor]]:
        """Switches of Omega in an order, batch by batch: indices and costs, (n,) each; inf if not known.

        With `beside`, also what takes two switches, of which the first alone need not improve, and the costs
        of that: see `hmc.moves`. All of it is rolled out together, which takes least time.
        """
        waiting, size, batch_number = torch.empty(0, dtype=torch.long), self.samples, 0
        if self.best.costs:
            self.evaluator.follow(self.schedule)
        else:
            self.evaluator.aim(self.schedule)
        while order.left > 0 or len(waiting) > 0:
            waiting = torch.cat([waiting, order.take(size - len(waiting))])
            room, limit = self.meter.room(len(waiting))
            if room <= 0:  # what would be tried beside it is not worked out
                self.stopped_by = limit
                return
            pairs = self._pairs(room, batch_number) if beside else []
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
            found = torch.where(known, costs, math.inf)
            yield indices, found[:room], pairs, found[room:]
            # only now, when what improves has been offered: or Ctrl-C in between leaves a false certificate
            self.best = replace(self.best, seen=self.best.seen + int(known[:room].sum()))
            if self.stopped_by or not known.all():
                self.stopped_by = self.stopped_by or "seconds"
                return
            size, batch_number = max(self.samples, min(2 * size, self.max_samples)), batch_number + 1
            self.tell()

    def offer(self, switches: Sequence[Switch], cost: float, equal: bool = False) -> None:
        """Take note of one switch, or of some that are stitched one after the other, if below `bound`.

        With `equal`, also of what costs the same as what was noted before.
        """
        if cost < self.bound or (equal and self.ahead is not None and cost == self.bound):
            best, schedule = self.best, self._stitched(switches)
            terms = self.evaluator.terms(schedule)
            self.ahead = Standing(
                best.incumbent,
                best.incumbent_terms,
                schedule,
                terms,
                (*best.costs, cost),
                (*best.switches, *switches),
                (*best.steps, (tuple(switches), terms)),
            )

    def _pairs(self, ahead: int, number: int) -> Pairs:
        """What is tried beside the batch of this number since the last improvement, of `ahead` draws."""
        k = self.evaluator.start.k
        room = max(0, self.meter.room(ahead + self.pairs + self.moves)[0] - ahead)
        tried = handovers(self.space, k, k + len(self.best.switches) + number, min(self.pairs, room))
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
        if self.ahead is None:
            return False
        self.best, self.ahead = self.ahead, None
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
        if search.ahead is not None:
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
            search.offer([search.space[here[1]]], here[0], equal=True)


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
        if len(search.best.steps) >= iterations:
            search.stopped_by = "iterations"
            return
        solve(search)
        accepted = search.accept()
        if search.stopped_by is None and not accepted:
            search.stopped_by = "converged"
        elif search.stopped_by is None:
            search.tell()
