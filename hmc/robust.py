"""Evaluating schedules on an ensemble of models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.ensemble import Member
from hmc.evaluate import Evaluator
from hmc.schedule import Schedule
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.task import Task
from hmc.trace import Trace


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
    def own_steps(self) -> int:
        """Those among them that were not made inside a mode."""
        return sum(member.own_steps for member in self.members)

    def needs(self, schedules: Tensor) -> NDArray[np.int64]:
        """As `Evaluator.needs`, over all members."""
        return np.sum([member.needs(schedules) for member in self.members], axis=0)

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
        """Risks of schedules (N, T) -> (N,) float64; as `Evaluator.costs`."""
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

    pending = 0  # nothing goes on from what an ensemble recorded, so that it does not at the end

    def record(self) -> None:
        """As `Evaluator.record`; does nothing."""

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
