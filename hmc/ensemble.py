"""Robust planning: schedules are rolled out on several models, and judged by the worst of what comes out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hmc.evaluate import Evaluator
from hmc.schedule import Schedule
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.trace import Trace

if TYPE_CHECKING:
    from hmc.task import Task


@dataclass(frozen=True)
class Member:
    """One of the models: how the world may be.

    Attributes:
        make_sim: number of worlds -> a simulator with this member's friction, masses, ...
        disturb: (x, u) -> (x, u): where the robot may be when x (nx,) is the estimate and u (nu,) the last
            input; None: exactly there.
    """

    make_sim: Callable[[int], Sim]
    disturb: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None


class Ensemble:
    """The models that each schedule is rolled out on, and how their costs become one.

    Args:
        members: E of them, alike in weight.
        tail: the share of the worst outcomes whose mean counts, the conditional value at risk (Rockafellar
            and Uryasev 2000): 1 is the mean of all, 0 (or anything up to 1 / E) the worst case.
    """

    def __init__(self, members: Sequence[Member], tail: float = 1.0):
        if not members:
            raise ValueError("an ensemble needs at least one member, got none")
        if not 0 <= tail <= 1:
            raise ValueError(f"an ensemble's tail is a share of the outcomes, 0 to 1, got {tail}")
        self.members, self.tail = tuple(members), tail
        self._sims: dict[int, list[Sim]] = {}

    def sims(self, num_worlds: int) -> list[Sim]:
        """A simulator of each member, made once a size."""
        if num_worlds not in self._sims:
            self._sims[num_worlds] = [member.make_sim(num_worlds) for member in self.members]
        return self._sims[num_worlds]

    def weights(self, costs: Tensor) -> Tensor:
        """Weight of each member in the risk, for costs (E, N) -> (E, N); each column sums to 1."""
        mass = max(1.0, self.tail * len(costs))
        by_rank = (mass - torch.arange(len(costs), dtype=costs.dtype)).clamp(0, 1) / mass
        rank = costs.argsort(dim=0, descending=True, stable=True).argsort(0)
        return by_rank[rank]

    def risk(self, costs: Tensor) -> Tensor:
        """One cost of each schedule's (E, N) costs, (N,); inf where a weighted one is."""
        weights = self.weights(costs)
        return torch.where(weights > 0, weights * costs, 0.0).sum(0)


class EnsembleEvaluator:
    """As `Evaluator`, with the risk over an ensemble as cost.

    The members are rolled out one after the other; a schedule that one of them makes worse than the bound is
    not rolled out on the next.
    """

    def __init__(self, task: Task, sim: Sim, start: Start):
        assert task.ensemble is not None
        self.task, self.start, self.ensemble = task, start, task.ensemble
        self.members = [
            Evaluator(task, each, _disturbed(start, member))
            for member, each in zip(self.ensemble.members, self.ensemble.sims(sim.num_worlds), strict=True)
        ]

    @property
    def trunk(self) -> Trace:
        """What the first member recorded last."""
        return self.members[0].trunk

    @property
    def control_steps(self) -> int:
        """Control steps made so far, over all members."""
        return sum(member.control_steps for member in self.members)

    @property
    def rollouts(self) -> int:
        """Schedules rolled out so far, once a member."""
        return sum(member.rollouts for member in self.members)

    @property
    def diverged(self) -> int:
        """Those whose world stopped being finite."""
        return sum(member.diverged for member in self.members)

    @property
    def ruled_out(self) -> int:
        """Schedules that the task's rules do not allow."""
        return sum(member.ruled_out for member in self.members)

    def costs(
        self, schedules: Tensor, bound: float = math.inf, stop: Callable[[], bool] | None = None
    ) -> Tensor:
        """Risks of schedules (N, T) long -> (N,) float64; as `Evaluator.costs`."""
        size = len(self.members)
        costs = torch.full((size, len(schedules)), math.inf, dtype=torch.float64)
        # costs >= 0: the risk is at least this share of any member's cost, rounding aside
        limit = bound * max(1.0, self.ensemble.tail * size)
        limit += 1e-9 * abs(limit) if math.isfinite(limit) else 0.0
        left = torch.arange(len(schedules))
        for row, member in zip(costs, self.members, strict=True):
            row[left] = member.costs(schedules[left], limit, stop).cpu()
            left = left[~row[left].isinf()]
        known = ~costs.isnan().any(0)
        return torch.where(known, self.ensemble.risk(costs.nan_to_num(0.0, posinf=math.inf)), math.nan)

    def follow(self, schedule: Schedule) -> float:
        """As `Evaluator.follow`, on every member."""
        costs = torch.tensor([[member.follow(schedule)] for member in self.members], dtype=torch.float64)
        return float(self.ensemble.risk(costs)[0])

    def terms(self, schedule: Schedule) -> dict[str, float]:
        """The risk of one schedule, term by term: the members' terms, weighted as their costs are."""
        costs = torch.tensor([[member.cost(schedule)] for member in self.members], dtype=torch.float64)
        weights = self.ensemble.weights(costs)[:, 0].tolist()
        sums = dict.fromkeys(self.task.cost.names, 0.0)
        for weight, member in zip(weights, self.members, strict=True):
            for name, value in (member.terms(schedule) if weight > 0 else {}).items():
                sums[name] += weight * value
        return sums


AnyEvaluator = Evaluator | EnsembleEvaluator


def make_evaluator(task: Task, sim: Sim, start: Start, known: Trace | None) -> AnyEvaluator:
    """The evaluator that a task asks for."""
    return (
        Evaluator(task, sim, start, known) if task.ensemble is None else EnsembleEvaluator(task, sim, start)
    )


def _disturbed(start: Start, member: Member) -> Start:
    """A member's start: a snapshot belongs to the nominal engine only."""
    x, u = (start.x, start.u) if member.disturb is None else member.disturb(start.x, start.u)
    return replace(start, x=x, u=u, snapshot=None)
