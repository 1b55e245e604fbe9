"""Rollouts: many schedules in step, as the branches of a tree, each beginning rolled out once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.branches import Branches, branches
from hmc.cost import total
from hmc.sim.ids import Ids, blocks, count
from hmc.trace import Recorder, Traces
from hmc.worlds import Crew, Worlds, finite

ROWS, STEPS = 256, 8
RECORDED = 64  # branches that are all recorded, at most


@dataclass(frozen=True, eq=False)
class Rolled:
    """What came of n schedules.

    Attributes:
        cost: J, of an ensemble the risk, (n,) float64; inf where diverged, a lower bound where pruned.
        terms: each term's share, (n, number of terms) float64; NaN where diverged or pruned.
        diverged: those with a world whose state, input or cost stopped being finite, (n,) bool.
        pruned: those given up because they are sure to exceed the bound, (n,) bool.
        barred: those with a world that came to a mode whose guard barred it, (n,) bool; their cost is inf.
        trace: of the schedule that was to be recorded, one on each member.
        traces: row -> its traces, of every one that was not given up; None where they are too many to keep.
    """

    cost: Tensor
    terms: Tensor
    diverged: Tensor
    pruned: Tensor
    barred: Tensor
    trace: Traces | None = None
    traces: Callable[[int], Traces] | None = None


def roll(
    worlds: Worlds,
    trunk: Traces,
    schedules: Tensor,
    bound: float = math.inf,
    stop: Callable[[], bool] | None = None,
    recorded: tuple[int, ...] | None = None,
) -> Rolled | None:
    r"""Roll out schedules (n, T) in step: J = sum_i l_i dt + c_f(x_T, k + T), the risk of it on an ensemble.

    Schedules that begin alike are one world until they part; what they share with the trunk is not
    rolled out at all. A world is copied with all that decides how it goes on, so the costs are those of
    n separate rollouts, bit for bit on engines that step a world alike in any company.

    A task's E members go side by side, branch j on member e in world j E + e, and end together: what ends
    one of them decides what the schedule costs.

    Args:
        worlds: where to; the first n E are used.
        trunk: where from, and what is known already; E traces, all of one schedule and one length.
        schedules: mode indices.
        bound: where cost terms are non-negative, a schedule is given up once its partial cost, with the
            task's lower bound of the rest, exceeds this.
        stop: asked before every control step; when it says True the rollout ends with None.
        recorded: a schedule that is rolled out beside the others, whatever the bound, and recorded; the
            simulator has worlds for it too.
    """
    rows = schedules.cpu()
    if recorded is not None:
        rows = torch.cat([torch.tensor([recorded], dtype=rows.dtype), rows])
    tree = branches(rows, trunk[0].modes[: len(trunk[0])])
    rollout = _Rollout(worlds, trunk, tree, bound, recorded is not None)
    first = next((i for i, born in enumerate(tree.born[1:]) if born > 0), rows.shape[1])
    for i in range(first, rows.shape[1] + 1):
        if stop is not None and stop():
            return None
        rollout.advance(i)
    return rollout.rolled(len(rows) - len(schedules))


@torch.no_grad()
def record(worlds: Worlds, known: Traces, schedule: Sequence[int]) -> Traces:
    """Roll out one schedule from where `known` begins, and record it on each member.

    The steps in which the two schedules agree are taken over from `known`.
    """
    modes = tuple(schedule)
    if modes == known[0].modes:
        return known
    none = torch.empty(0, len(modes), dtype=torch.long)
    rolled = roll(worlds, known, none, recorded=modes)
    assert rolled is not None
    assert rolled.trace is not None
    return rolled.trace


class _Rollout:
    """A tree of n branches being rolled out on E members; arguments as of `roll`.

    `ids` are the branches that go on, `at` the worlds that these are in. What steps cost is found out for
    several of them at a time: a call for few worlds takes as long as one for many. `watched` says whether
    row 0 is to be recorded whatever the bound.
    """

    def __init__(self, worlds: Worlds, trunk: Traces, tree: Branches, bound: float, watched: bool):
        task, device, n = worlds.task, worlds.sim.device, len(tree.row)
        self.worlds, self.sim, self.task, self.trunk, self.tree = worlds, worlds.sim, task, trunk, tree
        self.members, self.first, self.ensemble = len(trunk), trunk[0].k, task.ensemble
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
        self.terms = torch.zeros(len(task.cost.names), n * self.members, dtype=torch.float64, device=device)
        self.result = torch.full((n,), math.inf, dtype=torch.float64, device=device)
        self.going, self.pruned, self.barred = torch.zeros(3, n, dtype=torch.bool, device=device)
        self._go_on(slice(0, 0))  # a slice while none has ended
        self.crew: Crew | None = None  # who acts in them; None: to be found out
        self.changes = [True, *(tree.modes[:, 1:] != tree.modes[:, :-1]).any(0).tolist()]
        self.unpriced: list[tuple[Tensor, Tensor, Tensor]] = []  # x, u, u before of the last steps
        # what cannot end a branch on the way is looked at now and then only
        watchful = task.lower_bound is not None or (task.rules is not None and bool(task.rules.guards))
        self.at_once = 1 if watchful else STEPS

    def advance(self, i: int) -> None:
        """Step i of all branches that go on: what is born then, and their end at i = T, included."""
        task, sim, k = self.task, self.sim, self.first + i
        if i == self.horizon or self.tree.born[i + 1] > self.tree.born[i]:
            self._price(k)
            self._grow(i)
        if count(self.at, sim.num_worlds) == 0:
            return
        x, u_prev = sim.x(self._at), sim.u(self._at)
        if self.recorder is not None:
            self.recorder.arrive(self.worlds, i, self.at, x, u_prev)
        if not math.isfinite(float(x.sum())):  # a finite sum has finite parts
            x, u_prev = self._price(k, x, u_prev)
            x, u_prev = self._drop(~self._all(finite(x)), x, u_prev)
        if len(x) > 0 and i == self.horizon:
            terminal = task.cost.terminal_terms(x, torch.full((len(x),), k, device=sim.device))
            self.terms[self.stages :, self.at] = terminal.to(torch.float64).T
            costs = total(self.terms[:, self.at].T)
            self.result[self.ids] = self._risk(costs).where(self._all(costs.isfinite()), math.inf)
            return
        if len(x) > 0:
            x, u_prev = self._give_up(i, x, u_prev)
        if len(x) == 0:
            return
        if self.crew is None or self.changes[i]:
            self.crew = self.worlds.crew(self.at, self._each(self.modes[self.ids, i]).long())
        u = self.worlds.act(self.crew, x, u_prev, k)
        self.unpriced.append((x, u, u_prev))
        sane = None if math.isfinite(float(u.sum())) else self._all(finite(u))
        if sane is not None or len(self.unpriced) >= min(self.at_once, ROWS // len(u)):
            (u,) = self._price(k + 1, u, sane=sane)
        if len(u) > 0:
            sim.step(u, self._at)
            self.worlds.own_steps += len(u)

    def rolled(self, first: int) -> Rolled:
        """What came of the schedules from row `first` on; of row 0 the traces, if it was watched."""
        ended = ~self.result.isfinite()
        diverged = ended & ~self.pruned & ~self.barred
        recorder, tree, going, barred = self.recorder, self.tree, self.going.tolist(), self.barred.tolist()
        terms = self.terms.T.reshape(-1, self.members, len(self.terms))

        def traces(row: int) -> Traces:
            assert recorder is not None
            path = tree.path(row)
            last = path[-1]
            modes = tuple(tree.modes[last].tolist())
            terminal = terms[last, :, self.stages :] if going[last] else None
            return recorder.traces(modes, path, terminal, barred[last])

        at = tree.row.argsort()[first:].to(self.sim.device)
        known = terms[at].masked_fill((ended | self.pruned)[at, None, None], math.nan)
        return Rolled(
            self.result[at],
            known[:, 0] if self.ensemble is None else self.ensemble.terms(known),
            diverged[at],
            self.pruned[at],
            self.barred[at],
            traces(0) if self.path else None,
            None if recorder is None or recorder.path is not None else lambda row: traces(first + row),
        )

    @property
    def _at(self) -> Ids:
        """The worlds of `at`; None, which costs least, where they are all."""
        return None if count(self.at, self.sim.num_worlds) == self.sim.num_worlds else self.at

    def _go_on(self, ids: Tensor | slice) -> None:
        """Only branches `ids` go on."""
        self.ids, self.at = ids, blocks(ids, self.members)

    def _each(self, rows: Tensor) -> Tensor:
        """Of rows (n, ...), one a branch, one a world, (n E, ...)."""
        return rows if self.members == 1 else rows.repeat_interleave(self.members, 0)

    def _all(self, flags: Tensor) -> Tensor:
        """Of which branches all worlds are flagged, of flags (n E,) one a world, (n,) bool."""
        return flags if self.members == 1 else flags.view(-1, self.members).all(1)

    def _risk(self, costs: Tensor) -> Tensor:
        """What branches cost when their worlds cost (n E,), (n,)."""
        return costs if self.ensemble is None else self.ensemble.risk(costs.view(-1, self.members))

    def _grow(self, i: int) -> None:
        """Branches that are born at step i become copies of what they part from."""
        old, now, size = self.tree.born[i], self.tree.born[i + 1], self.members
        if now == old:
            return
        seeds = old + self.tree.seeds[i]
        stems, shoots = self.parents[seeds:now], slice(seeds, now)
        for member, trunk in enumerate(self.trunk if seeds > old else ()):
            at = slice(old * size + member, seeds * size, size)
            self.worlds.reset(trunk.start(i), at)
            self.terms[: self.stages, at] = trunk.sums[i][:, None]
        if now > seeds:
            parents, children = blocks(stems, size), blocks(shoots, size)
            self.worlds.branch(parents, children)
            self.terms[:, children] = self.terms[:, parents]
        self.going[old:now], self.crew = True, None
        if isinstance(self.ids, slice):
            self._go_on(slice(0, now))
            return
        for each in (self.result, self.pruned, self.barred, self.going):  # a stem that has ended passes it on
            each[shoots] = each[stems]
        self._go_on(self.going[:now].nonzero().squeeze(1))

    def _price(self, k: int, *rows: Tensor, sane: Tensor | None = None) -> tuple[Tensor, ...]:
        """Add what the last steps cost, the last one that before control step k, and end the branches that
        are beyond their limit, no number, or not `sane` (n,); the `rows`, (n E, ...) each, of the others."""
        if not self.unpriced:
            return rows
        steps, n = len(self.unpriced), len(self.unpriced[0][0])
        x, u, u_prev = self.unpriced[0] if steps == 1 else map(torch.cat, zip(*self.unpriced, strict=True))
        self.unpriced = []
        ks = torch.arange(k - steps, k, device=x.device).repeat_interleave(n)
        terms = self.task.cost.stage_terms(x, u, u_prev, ks).to(torch.float64) * self.sim.dt
        stage = terms.T.reshape(self.stages, steps, n)
        sums = self.terms[: self.stages, self.at]
        for i, step in enumerate(stage.unbind(1), k - steps - self.first):
            sums = sums + step
            if self.recorder is not None:
                self.recorder.step(i, self.at, step)
        self.terms[: self.stages, self.at] = sums
        costs = total(self.terms[:, self.at].T)
        partial = self._risk(costs)
        if sane is not None or not math.isfinite(float(costs.sum())) or self._beyond(partial).any():
            fine = self._all(costs.isfinite())
            return self._prune(partial, fine if sane is None else fine & sane, *rows)
        return rows

    def _give_up(self, i: int, x: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """End what a guard bars and what is sure to exceed its limit; states and inputs of the others."""
        rules, rest, k = self.task.rules, self.task.lower_bound, self.first + i
        if rules is not None and rules.guards:
            modes = self._each(self.modes[self.ids, i]).long()
            bad = ~self._all(~self.worlds.barred(self.at, modes, x, k))
            if bool(bad.any()):
                self.barred[self._indices[bad]] = True
                x, u = self._drop(bad, x, u)
        if rest is not None and self.limit < math.inf and len(x) > 0:
            steps = torch.full((len(x),), k, device=x.device)
            least = total(self.terms[:, self.at].T) - self.slack
            least += rest(x, steps, self.horizon - i).to(torch.float64)
            # hopeless is pruned as well, and a bound that is no number bounds nothing
            risk = self._risk(least.nan_to_num(nan=0.0))
            if self._beyond(risk).any():
                x, u = self._prune(risk, torch.ones_like(risk, dtype=torch.bool), x, u)
        return x, u

    def _beyond(self, cost: Tensor) -> Tensor:
        """Which branches' cost so far is too much already, (n,) bool."""
        return cost > self.limits[self.ids]

    def _prune(self, cost: Tensor, sane: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        """End branches whose cost so far is beyond their limit, and those not `sane` (n,); as `_drop`."""
        beyond = self._beyond(cost)
        given_up = self._indices[sane & beyond]
        self.result[given_up], self.pruned[given_up] = cost[sane & beyond], True
        return self._drop(~sane | beyond, *rows)

    @property
    def _indices(self) -> Tensor:
        return torch.arange(len(self.going), device=self.going.device)[self.ids]

    def _drop(self, bad: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        """End those branches that are `bad` (n,); of `rows`, (n E, ...) each, those of the others."""
        if bool(bad.any()):
            index, good = self._indices, self._each(~bad)
            self.going[index[bad]], self.crew = False, None
            self._go_on(index[~bad])
            rows = tuple(each[good] for each in rows)
        return rows
