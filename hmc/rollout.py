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
from hmc.worlds import Crew, Worlds, finite

ROWS, STEPS = 256, 8
RECORDED = 64  # branches that are all recorded, at most


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
        traces: row -> its trace, of every one that was not given up; None where they are too many to keep.
    """

    cost: Tensor
    terms: Tensor
    diverged: Tensor
    pruned: Tensor
    barred: Tensor
    trace: Trace | None = None
    traces: Callable[[int], Trace] | None = None


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
    rollout = _Rollout(worlds, trunk, tree, bound, recorded is not None)
    first = next((i for i, born in enumerate(tree.born[1:]) if born > 0), rows.shape[1])
    for i in range(first, rows.shape[1] + 1):
        if stop is not None and stop():
            return None
        rollout.advance(i)
    return rollout.rolled(len(rows) - len(schedules))


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
    """A tree of n branches being rolled out, branch j in world j; arguments as of `roll`.

    What steps cost is found out for several of them at a time: a call for few worlds takes as long as one
    for many. `watched` says whether row 0 is to be recorded whatever the bound.
    """

    def __init__(self, worlds: Worlds, trunk: Trace, tree: Branches, bound: float, watched: bool):
        task, device, n = worlds.task, worlds.sim.device, len(tree.row)
        self.worlds, self.sim, self.task, self.trunk, self.tree = worlds, worlds.sim, task, trunk, tree
        self.modes, self.parents = tree.modes.to(device), tree.parent.to(device)
        self.horizon, self.stages = tree.modes.shape[1], len(task.cost.stage)
        self.limit = bound if task.cost.nonnegative else math.inf
        self.slack = 1e-9 * abs(self.limit)  # more than rounding can make of partial cost and lower bound
        self.limits = torch.full((n,), self.limit, dtype=torch.float64, device=device)
        self.path = tree.path(0) if watched else []
        self.limits[[branch for branch in set(self.path) if branch >= 0]] = math.inf
        self.recorder = (
            Recorder(trunk, None if n <= RECORDED else self.path) if watched or n <= RECORDED else None
        )
        self.terms = torch.zeros(len(task.cost.names), n, dtype=torch.float64, device=device)
        self.result = torch.full((n,), math.inf, dtype=torch.float64, device=device)
        self.going, self.pruned, self.barred = torch.zeros(3, n, dtype=torch.bool, device=device)
        self.ids: Tensor | slice = slice(0, 0)  # branches that go on; a slice while none has ended
        self.crew: Crew | None = None  # who acts in them; None: to be found out
        self.changes = [True, *(tree.modes[:, 1:] != tree.modes[:, :-1]).any(0).tolist()]
        self.unpriced: list[tuple[Tensor, Tensor, Tensor]] = []  # x, u, u before of the last steps
        # what cannot end a world on the way is looked at now and then only
        watchful = task.lower_bound is not None or (task.rules is not None and bool(task.rules.guards))
        self.at_once = 1 if watchful else STEPS

    def advance(self, i: int) -> None:
        """Step i of all branches that go on: what is born then, and their end at i = T, included."""
        task, sim, k = self.task, self.sim, self.trunk.k + i
        if i == self.horizon or self.tree.born[i + 1] > self.tree.born[i]:
            self._price(k)
            self._grow(i)
        if count(self.ids, sim.num_worlds) == 0:
            return
        x, u_prev = sim.x(self._at), sim.u(self._at)
        if self.recorder is not None:
            self.recorder.arrive(self.worlds, i, self.ids, x, u_prev)
        if not math.isfinite(float(x.sum())):  # a finite sum has finite parts
            x, u_prev = self._price(k, x, u_prev)
            x, u_prev = self._drop(~finite(x), x, u_prev)
        if len(x) > 0 and i == self.horizon:
            terminal = task.cost.terminal_terms(x, torch.full((len(x),), k, device=sim.device))
            self.terms[self.stages :, self.ids] = terminal.to(torch.float64).T
            self.result[self.ids] = total(self.terms[:, self.ids].T)
            return
        if len(x) > 0:
            x, u_prev = self._give_up(i, x, u_prev)
        if len(x) == 0:
            return
        if self.crew is None or self.changes[i]:
            self.crew = self.worlds.crew(self.ids, self.modes[self.ids, i].long())
        u = self.worlds.act(self.crew, x, u_prev, k)
        self.unpriced.append((x, u, u_prev))
        sane = None if math.isfinite(float(u.sum())) else finite(u)
        if sane is not None or len(self.unpriced) >= min(self.at_once, ROWS // len(u)):
            (u,) = self._price(k + 1, u, sane=sane)
        if len(u) > 0:
            sim.step(u, self._at)
            self.worlds.own_steps += len(u)

    def rolled(self, first: int) -> Rolled:
        """What came of the schedules from row `first` on; of row 0 the trace, if it was watched."""
        self.result[self.result.isnan()] = math.inf
        ended = ~self.result.isfinite()
        diverged = ended & ~self.pruned & ~self.barred
        terminal, going, barred = self.terms[self.stages :].clone(), self.going.tolist(), self.barred.tolist()
        self.terms[:, ended | self.pruned] = math.nan
        recorder, tree = self.recorder, self.tree

        def trace(row: int) -> Trace:
            assert recorder is not None
            path = tree.path(row)
            last = path[-1]
            modes = tuple(tree.modes[last].tolist())
            return recorder.trace(modes, path, terminal[:, last] if going[last] else None, barred[last])

        at = tree.row.argsort()[first:].to(self.sim.device)
        return Rolled(
            self.result[at],
            self.terms[:, at].T,
            diverged[at],
            self.pruned[at],
            self.barred[at],
            trace(0) if self.path else None,
            None if recorder is None or recorder.path is not None else lambda row: trace(first + row),
        )

    @property
    def _at(self) -> Ids:
        """The worlds of `ids`; None, which costs least, where they are all."""
        return None if count(self.ids, self.sim.num_worlds) == self.sim.num_worlds else self.ids

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
        self.going[old:now], self.crew = True, None
        if isinstance(self.ids, slice):
            self.ids = slice(0, now)
            return
        for each in (self.result, self.pruned, self.barred, self.going):  # a stem that has ended passes it on
            each[shoots] = each[stems]
        self.ids = self.going[:now].nonzero().squeeze(1)

    def _price(self, k: int, *rows: Tensor, sane: Tensor | None = None) -> tuple[Tensor, ...]:
        """Add what the last steps cost, the last one that before control step k, and end what is beyond its
        limit, no number, or not `sane`; of `rows`, (n, ...) each, those of the others."""
        if not self.unpriced:
            return rows
        steps, n = len(self.unpriced), len(self.unpriced[0][0])
        x, u, u_prev = self.unpriced[0] if steps == 1 else map(torch.cat, zip(*self.unpriced, strict=True))
        self.unpriced = []
        ks = torch.arange(k - steps, k, device=x.device).repeat_interleave(n)
        terms = self.task.cost.stage_terms(x, u, u_prev, ks).to(torch.float64) * self.sim.dt
        stage = terms.T.reshape(self.stages, steps, n)
        sums = self.terms[: self.stages, self.ids]
        for i, step in enumerate(stage.unbind(1), k - steps - self.trunk.k):
            sums = sums + step
            if self.recorder is not None:
                self.recorder.step(i, self.ids, step)
        self.terms[: self.stages, self.ids] = sums
        partial = total(self.terms[:, self.ids].T)
        if sane is not None or not math.isfinite(float(partial.sum())) or self._beyond(partial).any():
            everywhere = torch.ones_like(partial, dtype=torch.bool)
            return self._prune(partial, everywhere if sane is None else sane, *rows)
        return rows

    def _give_up(self, i: int, x: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """End what a guard bars and what is sure to exceed its limit; states and inputs of the others."""
        rules, rest, k = self.task.rules, self.task.lower_bound, self.trunk.k + i
        if rules is not None and rules.guards:
            bad = self.worlds.barred(self.ids, self.modes[self.ids, i].long(), x, k)
            if bool(bad.any()):
                self.barred[self._indices[bad]] = True
                x, u = self._drop(bad, x, u)
        if rest is not None and self.limit < math.inf and len(x) > 0:
            steps = torch.full((len(x),), k, device=x.device)
            least = total(self.terms[:, self.ids].T) - self.slack
            least += rest(x, steps, self.horizon - i).to(torch.float64)
            # hopeless is pruned as well, and a bound that is no number bounds nothing
            least = least.nan_to_num(nan=0.0)
            if self._beyond(least).any():
                x, u = self._prune(least, torch.ones_like(least, dtype=torch.bool), x, u)
        return x, u

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
            self.going[index[bad]], self.crew = False, None
            self.ids, rows = index[~bad], tuple(each[~bad] for each in rows)
        return rows
