"""Rollouts: many schedules in step, as the branches of a tree, each beginning rolled out once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.branches import Branches, branches
from hmc.cost import total
from hmc.sim.ids import Ids, count
from hmc.trace import Recorder, Trace
from hmc.worlds import Worlds, finite, stage_terms


@dataclass(frozen=True, eq=False)
class Rolled:
    """What came of n rollouts.

    Attributes:
        cost: J, (n,) float64; inf where diverged, a lower bound where pruned.
        terms: each term's share, (n, number of terms) float64; NaN where diverged or pruned.
        diverged: worlds whose state, input or cost stopped being finite, (n,) bool.
        pruned: worlds given up because they are sure to exceed the bound, (n,) bool.
        barred: worlds that came to a mode whose guard barred it, (n,) bool; their cost is inf.
        trace: of the schedule that was to be recorded.
    """

    cost: Tensor
    terms: Tensor
    diverged: Tensor
    pruned: Tensor
    barred: Tensor
    trace: Trace | None = None


def roll(
    worlds: Worlds,
    trunk: Trace,
    schedules: Tensor,
    bound: float = math.inf,
    stop: Callable[[], bool] | None = None,
    recorded: tuple[int, ...] | None = None,
) -> Rolled | None:
    r"""Roll out schedules (n, T), n <= num_worlds, in step: J = sum_i l_i dt + c_f(x_T, k + T).

    Schedules that begin alike are one world until they part; what they share with the trunk is not
    rolled out at all. A world is copied with all that decides how it goes on, so the costs are those of
    n separate rollouts, bit for bit on engines that step a world alike in any company.

    Args:
        worlds: where to; the first n are used.
        trunk: where from, and what is known already.
        schedules: mode indices.
        bound: where cost terms are non-negative, a world is given up once its partial cost, with the task's
            lower bound of the rest, exceeds this.
        stop: asked before every control step; when it says True the rollout ends with None.
        recorded: a schedule that is rolled out beside the others, whatever the bound, and recorded; the
            simulator has a world for it too.
    """
    rows = schedules.cpu()
    if recorded is not None:
        rows = torch.cat([torch.tensor([recorded], dtype=rows.dtype), rows])
    tree = branches(rows, trunk.modes[: len(trunk)])
    recorder = None if recorded is None else Recorder(trunk, recorded, tree.path(0))
    rollout = _Rollout(worlds, trunk, tree, bound, recorder)
    for i in range(rows.shape[1] + 1):
        if stop is not None and stop():
            return None
        rollout.advance(i)
    return rollout.rolled(tree.row.argsort()[len(rows) - len(schedules) :])


@torch.no_grad()
def record(worlds: Worlds, known: Trace, schedule: Sequence[int]) -> Trace:
    """Roll out one schedule from where `known` begins, and record it.

    The steps in which the two schedules agree are taken over from `known`.
    """
    modes = tuple(schedule)
    if modes == known.modes:
        return known
    none = torch.empty(0, len(modes), dtype=torch.long)
    rolled = roll(worlds, known, none, recorded=modes)
    assert rolled is not None
    assert rolled.trace is not None
    return rolled.trace


class _Rollout:
    """A tree of n branches being rolled out, branch j in world j; arguments as of `roll`."""

    def __init__(self, worlds: Worlds, trunk: Trace, tree: Branches, bound: float, recorder: Recorder | None):
        task, device, n = worlds.task, worlds.sim.device, len(tree.row)
        self.worlds, self.sim, self.task, self.trunk, self.tree = worlds, worlds.sim, task, trunk, tree
        self.recorder = recorder
        self.modes, self.parents = tree.modes.to(device), tree.parent.to(device)
        self.horizon, self.stages = tree.modes.shape[1], len(task.cost.stage)
        self.limit = bound if task.cost.nonnegative else math.inf
        self.slack = 1e-9 * abs(self.limit)  # more than rounding can make of partial cost and lower bound
        self.limits = torch.full((n,), self.limit, dtype=torch.float64, device=device)
        if recorder is not None:
            self.limits[recorder.branches] = math.inf
        self.terms = torch.zeros(len(task.cost.names), n, dtype=torch.float64, device=device)
        self.result = torch.full((n,), math.inf, dtype=torch.float64, device=device)
        self.going, self.pruned, self.barred = torch.zeros(3, n, dtype=torch.bool, device=device)
        self.ids: Tensor | slice = slice(0, 0)  # branches that go on; a slice while none has ended

    def advance(self, i: int) -> None:
        """Step i of all branches that go on: what is born then, and their end at i = T, included."""
        task, sim, k = self.task, self.sim, self.trunk.k + i
        self._grow(i)
        watched = -1 if self.recorder is None else self.recorder.path[i]
        if self.recorder is not None and watched >= 0 and bool(self.going[watched]):
            self.recorder.arrive(self.worlds, i, watched)
        x = sim.x(self._at)
        if not math.isfinite(float(x.sum())):  # a finite sum has finite parts
            (x,) = self._drop(~finite(x), x)
        if len(x) > 0 and i == self.horizon:
            terminal = task.cost.terminal_terms(x, torch.full((len(x),), k, device=sim.device))
            self.terms[self.stages :, self.ids] = terminal.to(torch.float64).T
            self.result[self.ids] = total(self.terms[:, self.ids].T)
            return
        if len(x) > 0:
            x = self._give_up(i, x, k)
        if len(x) == 0:
            return
        u_prev = sim.u(self._at)
        u = self.worlds.act(self.ids, self._modes(i), x, u_prev, k)
        stage = stage_terms(task, x, u, u_prev, k, sim.dt).T
        self.terms[: self.stages, self.ids] += stage
        partial = total(self.terms[:, self.ids].T)
        if self.recorder is not None and watched >= 0 and bool(self.going[watched]):
            place = watched if isinstance(self.ids, slice) else int((self.ids == watched).nonzero())
            if bool((partial[place] + u[place].sum()).isfinite()):
                self.recorder.step(stage[:, place].clone())
        if not math.isfinite(float(partial.sum() + u.sum())) or self._beyond(partial).any():
            (u,) = self._prune(partial, finite(u), u)
        if len(u) > 0:
            sim.step(u, self._at)
            self.worlds.own_steps += len(u)

    def rolled(self, rows: Tensor) -> Rolled:
        """What came of branches `rows`."""
        self.result[self.result.isnan()] = math.inf
        ended = ~self.result.isfinite()
        diverged = ended & ~self.pruned & ~self.barred
        if self.recorder is not None:
            last = self.recorder.path[-1]
            if bool(self.going[last]):
                self.recorder.end(self.terms[self.stages :, last].clone())
            if bool(self.barred[last]):
                self.recorder.bar()
        self.terms[:, ended | self.pruned] = math.nan
        rows = rows.to(self.sim.device)
        return Rolled(
            self.result[rows],
            self.terms[:, rows].T,
            diverged[rows],
            self.pruned[rows],
            self.barred[rows],
            None if self.recorder is None else self.recorder.trace(),
        )

    @property
    def _at(self) -> Ids:
        """The worlds of `ids`; None, which costs least, where they are all."""
        return None if count(self.ids, self.sim.num_worlds) == self.sim.num_worlds else self.ids

    def _modes(self, i: int) -> Tensor:
        return self.modes[self.ids, i].long()

    def _grow(self, i: int) -> None:
        """Branches that are born at step i become copies of what they part from."""
        old, now = self.tree.born[i], self.tree.born[i + 1]
        if now == old:
            return
        seeds = old + self.tree.seeds[i]
        stems, shoots = self.parents[seeds:now], slice(seeds, now)
        if seeds > old:
            self.worlds.reset(self.trunk.start(i), slice(old, seeds))
            self.terms[: self.stages, old:seeds] = self.trunk.sums[i][:, None]
        if now > seeds:
            self.worlds.branch(stems, shoots)
            self.terms[:, shoots] = self.terms[:, stems]
        self.going[old:now] = True
        if isinstance(self.ids, slice):
            self.ids = slice(0, now)
            return
        for each in (self.result, self.pruned, self.barred, self.going):  # a stem that has ended passes it on
            each[shoots] = each[stems]
        self.ids = self.going[:now].nonzero().squeeze(1)

    def _give_up(self, i: int, x: Tensor, k: int) -> Tensor:
        """End what a guard bars and what is sure to exceed its limit; the states of the others."""
        rules, rest = self.task.rules, self.task.lower_bound
        if rules is not None and rules.guards:
            bad = self.worlds.barred(self.ids, self._modes(i), x, k)
            if bool(bad.any()):
                self.barred[self._indices[bad]] = True
                (x,) = self._drop(bad, x)
        if rest is not None and self.limit < math.inf and len(x) > 0:
            steps = torch.full((len(x),), k, device=x.device)
            least = total(self.terms[:, self.ids].T) - self.slack
            least += rest(x, steps, self.horizon - i).to(torch.float64)
            # hopeless is pruned as well, and a bound that is no number bounds nothing
            least = least.nan_to_num(nan=0.0)
            if self._beyond(least).any():
                (x,) = self._prune(least, torch.ones_like(least, dtype=torch.bool), x)
        return x

    def _beyond(self, cost: Tensor) -> Tensor:
        """Whose cost so far is too much already, (n,) bool."""
        return cost > self.limits[self.ids]

    def _prune(self, cost: Tensor, sane: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        """End what is beyond its limit, and what is not `sane` or finite; the `rows` of the others."""
        sane, beyond = sane & cost.isfinite(), self._beyond(cost)
        given_up = self._indices[sane & beyond]
        self.result[given_up], self.pruned[given_up] = cost[sane & beyond], True
        return self._drop(~sane | beyond, *rows)

    @property
    def _indices(self) -> Tensor:
        return torch.arange(len(self.going), device=self.going.device)[self.ids]

    def _drop(self, bad: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        """End those of `ids` that are `bad` (n,); of `rows`, (n, ...) each, those of the others."""
        if bool(bad.any()):
            index = self._indices
            self.going[index[bad]] = False
            self.ids, rows = index[~bad], tuple(each[~bad] for each in rows)
        return rows
