"""Robust planning: the models that schedules are rolled out on, and how their costs become one.

Of costs J_1 >= J_2 >= ... >= J_E, one a member, what counts is their conditional value at risk at a tail
alpha, the mean of the worst share alpha: with m = max(1, alpha E),

    CVaR = min over c of c + 1 / m sum_e max(J_e - c, 0) = 1 / m sum_e min(1, max(0, m - e + 1)) J_e.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hmc.cost import total
from hmc.sim.base import Sim

if TYPE_CHECKING:
    from hmc.start import Start


class Ensemble:
    """The models that each schedule is rolled out on, and how their costs become one.

    Args:
        size: E, how many members there are, alike in weight.
        make_sim: which member each world is to be, 0 to E - 1 -> a simulator with a world for each. Engines
            that have one model in all worlds go together in a `hmc.sim.mixed.Mixed`.
        disturb: (x, u) -> (E, nx), (E, nu): where the robot may be on each member when x (nx,) is the
            estimate and u (nu,) the last input; None: exactly there.
        tail: the share of the worst outcomes whose mean counts, the conditional value at risk (Rockafellar
            and Uryasev 2000): 1 is the mean of all, 0 (or anything up to 1 / E) the worst case.

    Raises:
        ValueError: no member, or a tail that is no share.
    """

    def __init__(
        self,
        size: int,
        make_sim: Callable[[Sequence[int]], Sim],
        *,
        disturb: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None,
        tail: float = 1.0,
    ):
        if size < 1:
            raise ValueError(f"an ensemble needs at least one member, got {size}")
        if not 0 <= tail <= 1:
            raise ValueError(f"an ensemble's tail is a share of the outcomes, 0 to 1, got {tail}")
        self.size, self.make_sim, self.disturb, self.tail = size, make_sim, disturb, tail
        self._sims: dict[int, Sim] = {}
        mass = max(1.0, tail * size)
        self._by_rank = [min(1.0, mass - rank) / mass for rank in range(math.ceil(mass))]

    def sim(self, schedules: int) -> Sim:
        """A simulator for so many schedules at a time: world j E + e is schedule j on member e.

        Made once a size.

        Raises:
            ValueError: `make_sim` gave another number of worlds than it was asked for.
        """
        if schedules not in self._sims:
            sim = self.make_sim(list(range(self.size)) * schedules)
            if sim.num_worlds != self.size * schedules:
                raise ValueError(
                    f"an ensemble's make_sim was asked for {self.size * schedules} worlds and made "
                    f"{sim.num_worlds}"
                )
            self._sims[schedules] = sim
        return self._sims[schedules]

    def starts(self, start: Start) -> list[Start]:
        """Where each member begins; the engine's snapshot belongs to the nominal model alone.

        Raises:
            ValueError: `disturb` gave states or inputs of another shape, or not finite.
        """
        x, u = start.x.expand(self.size, -1), start.u.expand(self.size, -1)
        if self.disturb is not None:
            wanted, (x, u) = (x.shape, u.shape), self.disturb(start.x, start.u)
            if (x.shape, u.shape) != wanted:
                raise ValueError(
                    f"an ensemble's disturb gave x {tuple(x.shape)} and u {tuple(u.shape)}, expected a row a "
                    f"member, {tuple(wanted[0])} and {tuple(wanted[1])}"
                )
            if not (x.isfinite().all() and u.isfinite().all()):
                raise ValueError("an ensemble's disturb gave x or u with numbers that are not finite")
        return [replace(start, x=x[e], u=u[e], snapshot=None) for e in range(self.size)]

    def risk(self, costs: Tensor) -> Tensor:
        """One cost of each schedule's (N, E) costs, (N,); inf where one is.

        Every cost enters by monotone roundings in order of rank: a partial risk of terms >= 0 never exceeds
        the final one, in floating point too, so that pruning by it is exact.
        """
        ranked = costs.sort(1, descending=True).values
        return reduce(torch.add, [weight * ranked[:, i] for i, weight in enumerate(self._by_rank)])

    def terms(self, terms: Tensor) -> Tensor:
        """Terms of each schedule's risk, (N, number of terms), from its members', (N, E, number of terms).

        They are weighted as the members' costs are; NaN where one of a schedule's is.
        """
        costs = total(terms.flatten(0, 1)).view(-1, self.size)
        by_rank = costs.new_tensor(self._by_rank + [0.0] * (self.size - len(self._by_rank)))
        rank = costs.argsort(dim=1, descending=True, stable=True).argsort(1)
        return reduce(torch.add, (by_rank[rank][:, :, None] * terms).unbind(1))
