"""Robust planning: the models that schedules are rolled out on, and how their costs become one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.sim.base import Sim


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
