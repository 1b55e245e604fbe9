"""Rollouts: many schedules in step, as the branches of a tree, each beginning rolled out once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hmc.account import Account
from hmc.bounds import Rest
from hmc.branches import Branches, tree_of
from hmc.cost import total_by_term
from hmc.neighbours import Neighbours
from hmc.sim.device import upload
from hmc.sim.ids import Ids, blocks
from hmc.trace import Floats, Recorder, Traces
from hmc.worlds import Crew, Flags, Indices, Worlds, finite

ROWS, STEPS = 256, 8  # of states that are priced in one call, at most
MANY_ROWS, MANY_STEPS = 24576, 16  # the same where steps are cheap
RECORDED = 64  # branches that are all recorded, at most


@dataclass(frozen=True, eq=False)
class Rolled:
    """What came of n schedules.

    Attributes:
        cost: J, of an ensemble the risk, (n,) float64; inf where diverged, a lower bound where pruned.
        terms: each term's share, (n, number of terms) float64; NaN where diverged or pruned.
        diverged: those with a world whose state, input or cost stopped being finite, (n,) bool.
        pruned: those given up because they are sure to exceed the bound, (n,) bool.
        barred: the mode that a guard barred in one of its worlds, (n,) long; -1 for none. Its cost is inf.
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
    schedules: Tensor | Neighbours,
    bound: float = math.inf,
    stop: Callable[[], bool] | None = None,
    recorded: tuple[int, ...] | None = None,
    ahead: tuple[int, ...] | None = None,
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
        schedules: mode indices, or the neighbours of a schedule.
        bound: where cost terms are non-negative, a schedule is given up once its partial cost, with the
            task's lower bound of the rest, exceeds this.
        stop: asked before every control step; when it says True the rollout ends with None.
        recorded: a schedule that is rolled out beside the others, whatever the bound, and recorded; the
            simulator has worlds for it too.
        ahead: a schedule before the others, not recorded, with a row of its own in what comes back.
    """
    tree = tree_of(schedules, trunk[0].modes[: len(trunk[0])], recorded or ahead)
    horizon = tree.modes.shape[1]
    rollout = _Rollout(worlds, trunk, tree, bound, recorded is not None)
    first = next((i for i, born in enumerate(tree.born[1:]) if born > 0), horizon)
    for i in range(first, horizon + 1):
        if stop is not None and stop():
            return None
        rollout.advance(i)
    return rollout.rolled(0 if recorded is None else 1)


class _Rollout:
    """A tree of n branches being rolled out on E members; arguments as of `roll`.

    `ids` are the branches that go on, ascending, `at` the worlds that these are in. `watched` says whether
    row 0 is to be recorded whatever the bound. All that is known of branches is in numpy, quicker than torch.
    A call for few worlds takes as long as one for many, so up to `at_once` steps are priced together, and
    with `later` their states and inputs judged only then; with `before_births` before children are born.
    `watchful`: guards or bounds may end a branch on its way. `near`: to look at a number is no wait.
    """

    def __init__(self, worlds: Worlds, trunk: Traces, tree: Branches, bound: float, watched: bool):
        task, n = worlds.task, len(tree.row)
        self.worlds, self.sim, self.task, self.trunk, self.tree = worlds, worlds.sim, task, trunk, tree
        self.members, self.first, self.ensemble = len(trunk), trunk[0].k, task.ensemble
        self.modes, self.parents = tree.modes.numpy().T, tree.parent.numpy()
        self.changes = [True, *(self.modes[1:] != self.modes[:-1]).any(1).tolist()]  # by step
        self.horizon, self.stages = len(self.modes), len(task.cost.stage)
        self.limit = bound if task.cost.nonnegative else math.inf
        self.slack = 1e-9 * abs(self.limit)  # more than rounding can make of partial cost and lower bound
        self.path = tree.path(0) if watched else []
        self.kept = np.array(sorted({branch for branch in self.path if branch >= 0}), dtype=np.int64)
        few = n <= RECORDED
        self.recorder = Recorder(trunk, None if few else self.path) if few or watched else None
        self.terms = np.full((len(task.cost.names), n * self.members), math.nan)  # of those that arrived
        self.result = np.full(n, math.inf)
        self.pruned, self.barred = np.zeros(n, dtype=bool), np.full(n, -1)
        self.cheap = worlds.cheap
        self._go_on(slice(0, 0))  # a slice while none has ended
        self.crew: Crew | None = None  # who acts in them; None: to be found out
        # what cannot end a branch on the way is looked at now and then only
        bounded = task.lower_bound is not None or task.tail_bound is not None
        self.rest = Rest(task, tree) if bounded and self.limit < math.inf else None
        self.watchful = self.rest is not None or (task.rules is not None and bool(task.rules.guards))
        # to look at each step's states and inputs is to wait for a GPU, and takes longer than to go on where
        # steps are cheap: they are judged with what steps cost, together with what guards and bounds say
        self.near = not far(self.sim.device)
        self.later = (self.cheap or not self.near) and self.stages > 0
        self.account = Account(task, n * self.members, self.sim.dt, self.recorder, self.later, self.near)
        self.constant = task.modes.constants is not None
        self.rows = MANY_ROWS if self.cheap or self.later else ROWS
        # what steps cost can wait where nothing is given up for it
        patient = self.limit == math.inf and (self.cheap or not self.later)
        often = self.watchful and not (self.later or self.cheap)
        most = MANY_STEPS if self.cheap else STEPS
        self.at_once = 1 if often else self.rows if patient else most
        # what is beyond its limit has no children, where to find out takes less time than to step those
        self.before_births = not (self.cheap or self.later or patient)

    def advance(self, i: int) -> None:
        """Step i of all branches that go on: what is born then, and their end at i = T, included."""
        sim, k, born = self.sim, self.first + i, self.tree.born
        if i == self.horizon or born[i + 1] > born[i]:
            if i == self.horizon or self.before_births:
                self._price()
            self._grow(i)
        if self.size == 0:
            return
        x, u_prev = sim.x(self._at), sim.u(self._at)
        if self.recorder is not None:
            self.recorder.arrive(self.worlds, i, self.ids, self.at, x, u_prev)
        look = i == self.horizon or not self.later
        if look and not math.isfinite(float(x.sum())):  # a finite sum has finite parts
            x, u_prev = self._price(x, u_prev, sane=self._all(finite(x).cpu().numpy()))
        if i == self.horizon:
            self._arrive(x, k)
            return
        if self.size > 0 and self.watchful:
            x, u_prev = self._give_up(i, x, u_prev)
        if self.size == 0:
            return
        if self.crew is None or self.changes[i]:
            modes = self._each(self.modes[i, self.ids])
            self.crew = self.worlds.crew(self.at, modes, modes if self.constant else self._before(i))
        u = self.worlds.act(self.crew, x, u_prev, k)
        self.account.step(i, self.ids, x, u, u_prev)
        fine = self.later or self.crew.held is not None or math.isfinite(float(u.sum()))
        if not fine or (self._due and not (self.later and self.watchful)):
            (u,) = self._price(u, sane=None if fine else self._all(finite(u).cpu().numpy()))
        if self.size > 0:
            sim.step(u, self._at)
            self.worlds.own_steps += self.size * self.members

    def rolled(self, first: int) -> Rolled:
        """What came of the schedules from row `first` on; of row 0 the traces, if it was watched."""
        ended = ~np.isfinite(self.result)
        diverged = ended & ~self.pruned & (self.barred < 0)
        recorder, tree, barred = self.recorder, self.tree, self.barred

        def by_branch(terms: Floats) -> Tensor:
            return torch.from_numpy(terms).T.unflatten(0, (-1, self.members))

        ends = by_branch(self.terms[self.stages :])

        def traces(row: int) -> Traces:
            assert recorder is not None
            path = tree.path(row)
            last = path[-1]
            return recorder.traces(tuple(tree.modes[last].tolist()), path, ends[last], barred[last] >= 0)

        at = np.empty(len(tree.row), dtype=np.int64)
        at[tree.row.numpy()] = np.arange(len(at))
        at = at[first:]
        terms = self.terms.take(self._blocks(at), 1)
        terms[:, self._each((ended | self.pruned)[at])] = math.nan
        known = by_branch(terms)
        return Rolled(
            torch.from_numpy(self.result[at]),
            known[:, 0] if self.ensemble is None else self.ensemble.terms(known),
            torch.from_numpy(diverged[at]),
            torch.from_numpy(self.pruned[at]),
            torch.from_numpy(barred[at]),
            traces(0) if self.path else None,
            None if recorder is None or recorder.path is not None else lambda row: traces(first + row),
        )

    @property
    def _due(self) -> bool:
        """Whether it is time to find out what the last steps cost."""
        return len(self.account) >= min(self.at_once, self.rows // self.size // self.members)

    @property
    def _indices(self) -> np.ndarray:
        return np.arange(self.ids.stop) if isinstance(self.ids, slice) else self.ids

    @property
    def sums(self) -> Floats:
        """Stage terms of the worlds of `at` so far, (number of stage terms, len(at))."""
        return self.account.sums[:, : self.size * self.members]

    def _device(self, indices: np.ndarray) -> Tensor:
        return upload(indices, self.sim.device)

    def _go_on(self, ids: np.ndarray | slice) -> None:
        """Only branches `ids` go on."""
        self.ids, self.crew = ids, None
        self.size = ids.stop if isinstance(ids, slice) else len(ids)
        places = slice(0, self.size) if self.cheap or isinstance(ids, slice) else self._device(ids)
        self.at = blocks(places, self.members)
        # the same for the simulator; None, which costs least, where they are all
        self._at: Ids = None if self.size * self.members == self.sim.num_worlds else self.at

    def _blocks(self, branches: Indices) -> Indices:
        """The worlds of branches (n,) that lie side by side, (n E,)."""
        if self.members == 1:
            return branches
        worlds: Indices = (branches[:, None] * self.members + np.arange(self.members)).ravel()
        return worlds

    def _each(self, rows: np.ndarray) -> np.ndarray:
        """Of rows (n,), one a branch, one a world, (n E,)."""
        return rows if self.members == 1 else rows.repeat(self.members)

    def _all(self, flags: Flags) -> Flags:
        """Of which branches all worlds are flagged, of flags (n E,) one a world, (n,) bool."""
        return flags if self.members == 1 else np.all(flags.reshape(-1, self.members), axis=1)

    def _risk(self, costs: Floats) -> Floats:
        """What branches cost when their worlds cost (n E,), (n,)."""
        if self.ensemble is None:
            return costs
        risk: Floats = self.ensemble.risk(torch.from_numpy(costs).view(-1, self.members)).numpy()
        return risk

    def _before(self, i: int) -> np.ndarray:
        """The modes that ran before step i, one a world."""
        if i > 0:
            return self._each(self.modes[i - 1, self.ids])
        return np.full(self.size * self.members, int(self.trunk[0].mode[0]))

    def _grow(self, i: int) -> None:
        """Branches that are born at step i become copies of what they part from."""
        old, now, members = self.tree.born[i], self.tree.born[i + 1], self.members
        if now == old:
            return
        seeds = old + self.tree.seeds[i]
        width, grown = self.size * members, (self.size + seeds - old) * members
        for member, trunk in enumerate(self.trunk if seeds > old else ()):
            begin = width if self.cheap else old * members
            self.worlds.enter(trunk, i, slice(begin + member, begin + grown - width, members))
            self.account.sums[:, width + member : grown : members] = trunk.sums[i].numpy()[:, None]
        stems, born = self.parents[seeds:now], np.arange(old, now)
        ids: Indices | slice = slice(0, now)
        places = stems
        if not isinstance(self.ids, slice):
            places = self.ids.searchsorted(stems)
            there = self.ids.take(places, mode="clip") == stems if self.size > 0 else stems < 0
            if not there.all():  # a stem that has ended passes on how
                gone, ends = born[seeds - old :][~there], stems[~there]
                for each in (self.result, self.pruned, self.barred):
                    each[gone] = each[ends]
                born, stems, places = np.delete(born, gone - old), stems[there], places[there]
            ids = np.concatenate([self.ids, born])
        self._go_on(ids)
        if len(stems) > 0:
            children = slice(grown // members, grown // members + len(stems))
            width = len(stems) * members
            self.account.born(slice(grown, grown + width), self._blocks(places))
            there = self.cheap or isinstance(ids, slice)
            self.worlds.branch(
                self._device(self._blocks(places if self.cheap else stems)),
                blocks(children if there else self._device(born[seeds - old :]), members),
            )

    def _arrive(self, x: Tensor, k: int) -> None:
        """The end at control step k, of worlds in states x: what they cost."""
        if self.size == 0:
            return
        ends = self.task.cost.terminal_terms(x, torch.full((len(x),), k, device=x.device)).to(torch.float64)
        terms = np.concatenate([self.sums, ends.cpu().numpy().T])
        costs = total_by_term(terms)
        self.terms[:, self._blocks(self._indices)] = terms
        self.result[self.ids] = np.where(self._all(np.isfinite(costs)), self._risk(costs), math.inf)

    def _price(self, *rows: Tensor, sane: Flags | None = None) -> tuple[Tensor, ...]:
        """Find out what the last steps cost, and end whom `_settle` ends; the `rows` of the others."""
        if len(self.account):
            self.account.settle(self.account.costs(self.first).cpu().numpy())
        elif sane is None:
            return rows
        return self._settle(*rows, sane=sane)

    def _give_up(self, i: int, x: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """End what a guard bars and what is sure to exceed its limit; states and inputs of the others.

        What is to be known for that is fetched at once, what the last steps cost included.
        """
        rules, k, none, barred, least = self.task.rules, self.first + i, np.int64(-1), None, None
        if rules is not None and rules.guards:
            modes = self._each(self.modes[i, self.ids])
            barred = rules.barred(self.task.modes, modes != self._before(i), modes, x, k)
        if self.rest is not None and (self._due or not self.cheap):
            least = self.rest(i, self.ids, x, k)
        if barred is None and least is None and not (self.later and self._due):
            return x, u
        costs = self.account.costs(self.first) if len(self.account) else None
        look = self.later and not (self.near and math.isfinite(float(x.sum())))
        known = fetched(costs, finite(x) if look else None, barred, least)
        if costs is not None:
            self.account.settle(known[0])
        return self._settle(
            x,
            u,
            sane=self._all(known[1] > 0) if look else None,
            barred=None
            if barred is None
            else np.where(self._all(known[2] == 0), none, self.modes[i, self.ids]),
            least=None if least is None else known[3],
        )

    def _settle(
        self,
        *rows: Tensor,
        sane: Flags | None = None,
        barred: Indices | None = None,
        least: Floats | None = None,
    ) -> tuple[Tensor, ...]:
        """End the branches that cost more than the limit or no number, those not `sane` (n,), those with a
        mode that is `barred` (n,), not -1, and those that the `least` (n E,) that is still to come takes
        beyond the limit; the `rows`, (n E, ...) each, of the others."""
        total, there = total_by_term(self.sums), self._indices
        fine = np.ones(self.size, dtype=bool) if sane is None else sane
        if not math.isfinite(total.sum()):
            fine = fine & self._all(np.isfinite(total))
        cost = self._risk(total)
        beyond = cost > self.limit
        over = beyond
        if least is not None:
            bound = total - self.slack + least
            bound[np.isnan(bound)] = 0.0  # what is no number bounds nothing
            cost = np.where(beyond, cost, self._risk(bound))
            over = cost > self.limit
        if len(self.kept) > 0 and over.any():
            free = ~np.isin(there, self.kept)
            beyond, over = beyond & free, over & free
        gone = over | ~fine
        if barred is not None:
            stopped = (barred >= 0) & fine & ~beyond
            self.barred[there[stopped]] = barred[stopped]
            over, gone = over & ~stopped, gone | stopped
        if not gone.any():
            return rows
        over = over & fine
        self.result[there[over]], self.pruned[there[over]] = cost[over], True
        return self._drop(gone, *rows)

    def _drop(self, bad: Flags, *rows: Tensor) -> tuple[Tensor, ...]:
        """End those branches that are `bad` (n,); of `rows`, (n E, ...) each, those of the others."""
        good = np.flatnonzero(self._each(~bad))
        self.account.keep(good)
        self._go_on(self._indices[~bad])
        chosen = self._device(good)
        if self.cheap:  # to close up takes less time than to pick them out at every step
            self.worlds.branch(chosen, self.at)
        return tuple(each[chosen] for each in rows)


def far(device: torch.device) -> bool:
    """Whether to look at a number on a device is to wait for all that it was told to do before."""
    return device.type != "cpu"


def fetched(*numbers: Tensor | None) -> list[Floats]:
    """Tensors of a device in double precision, in one copy; nothing for None."""
    given = [np.empty(0) if each is None else each.to(torch.float64) for each in numbers]
    if not any(far(each.device) for each in numbers if each is not None):
        return [each if isinstance(each, np.ndarray) else each.numpy() for each in given]
    flat = torch.cat([each.flatten() for each in given if isinstance(each, Tensor)]).cpu().numpy()
    parts = np.split(flat, np.cumsum([0 if each is None else each.numel() for each in numbers])[:-1])
    return [part.reshape(each.shape) for part, each in zip(parts, given, strict=True)]
