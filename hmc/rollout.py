"""Rollouts: many schedules in step, as the branches of a tree, each beginning rolled out once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.branches import branches
from hmc.cost import total
from hmc.sim.base import Sim
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
    record: tuple[int, ...] | None = None,
) -> Rolled | None:
    r"""Roll out schedules (n, T), n <= num_worlds, in step: J = sum_i l_i dt + c_f(x_T, k + T).

    Schedules that begin alike are one world until they part; what they share with the trunk is not
    rolled out at all. A world is copied with all that decides how it goes on, so the costs are those of
    n separate rollouts, bit for bit on engines that step a world alike in any company.

    Args:
        worlds: where to; the first n are used.
        trunk: where from, and what is known already.
        schedules: mode indices, long.
        bound: where cost terms are non-negative, a world is given up once its partial cost, with the task's
            lower bound of the rest, exceeds this.
        stop: asked before every control step; when it says True the rollout ends with None.
        record: a schedule that is rolled out beside the others, whatever the bound, and recorded; the
            simulator has a world for it too.
    """
    sim, cost = worlds.sim, worlds.task.cost
    recorder = None if record is None else Recorder(trunk, record)
    rows = schedules.cpu()
    if record is not None:
        rows = torch.cat([torch.tensor([record], dtype=rows.dtype), rows])
    tree = branches(rows, trunk.modes[: len(trunk)])
    path = tree.path(0) if recorder is not None else []  # the branches that are recorded
    n, horizon = tree.modes.shape
    modes, parents = tree.modes.to(sim.device), tree.parent.to(sim.device)
    limit = bound if cost.nonnegative else math.inf
    rest = worlds.task.lower_bound if math.isfinite(limit) else None
    slack = 1e-9 * abs(limit)  # more than rounding can make of partial cost and lower bound
    limits = torch.full((n,), limit, dtype=torch.float64, device=sim.device)
    if recorder is not None:
        limits[[branch for branch in path if branch >= 0]] = math.inf
    stages, guarded = len(cost.stage), worlds.task.rules is not None and bool(worlds.task.rules.guards)
    result = torch.full((n,), math.inf, dtype=torch.float64, device=sim.device)
    terms = torch.zeros(len(cost.names), n, dtype=torch.float64, device=sim.device)
    pruned = torch.zeros(n, dtype=torch.bool, device=sim.device)
    barred, going = torch.zeros_like(pruned), torch.zeros_like(pruned)
    ids: Tensor | slice = slice(0, 0)  # branch j runs in world j: those that are going on
    for i in range(horizon + 1):
        if stop is not None and stop():
            return None
        old, now = tree.born[i], tree.born[i + 1]
        if now > old:
            seeds = old + int((parents[old:now] < 0).sum())  # what parts from the trunk comes first
            if seeds > old:
                worlds.reset(trunk.start(i), slice(old, seeds))
                terms[:stages, old:seeds], going[old:seeds] = trunk.sums[i][:, None], True
            if now > seeds:
                stems = parents[seeds:now]
                worlds.branch(stems, slice(seeds, now))
                terms[:, seeds:now] = terms[:, stems]
                for each in (result, pruned, barred, going):  # a stem that has ended passes on its end
                    each[seeds:now] = each[stems]
            whole = bool(going[:now].all())
            ids = slice(0, now) if whole else going[:now].nonzero().squeeze(1)
        watched = path[i] if recorder is not None and path[i] >= 0 and bool(going[path[i]]) else -1
        if recorder is not None and watched >= 0 and i > recorder.agree:
            recorder.arrive(worlds, watched)
        x = sim.x(_worlds(sim, ids))
        if len(x) > 0 and not bool(x.sum().isfinite()):  # a finite sum has finite parts
            ids, (x,) = _drop(going, ids, ~finite(x), x)
        if len(x) == 0:
            continue
        k = trunk.k + i
        if i == horizon:
            ks = torch.full((len(x),), k, device=sim.device)
            terms[stages:, ids] = cost.terminal_terms(x, ks).to(torch.float64).T
            result[ids] = total(terms[:, ids].T)
            break
        if guarded and bool((bad := worlds.barred(ids, modes[ids, i].long(), x, k)).any()):
            barred[_indices(ids)[bad]] = True
            ids, (x,) = _drop(going, ids, bad, x)
        if rest is not None:
            ks = torch.full((len(x),), k, device=sim.device)
            least = total(terms[:, ids].T) + rest(x, ks, horizon - i).to(torch.float64) - slack
            if bool((bad := least > limits[ids]).any()):
                given_up = _indices(ids)[bad]
                result[given_up], pruned[given_up] = least[bad], True
                ids, (x,) = _drop(going, ids, bad, x)
        if len(x) == 0:
            continue
        u_prev = sim.u(_worlds(sim, ids))
        u = worlds.act(ids, modes[ids, i].long(), x, u_prev, k)
        stage = stage_terms(worlds.task, x, u, u_prev, k, sim.dt).T
        terms[:stages, ids] += stage
        partial = total(terms[:, ids].T)
        most = limits[ids]
        if recorder is not None and watched >= 0 and bool(going[watched]):
            place = watched if isinstance(ids, slice) else int((ids == watched).nonzero())
            if bool((partial[place] + u[place].sum()).isfinite()):
                recorder.step(stage[:, place])
        if not (bool((partial.sum() + u.sum()).isfinite()) and bool((partial <= most).all())):
            sound, beyond = partial.isfinite() & finite(u), partial > most
            given_up = _indices(ids)[sound & beyond]
            result[given_up], pruned[given_up] = partial[sound & beyond], True
            ids, (u,) = _drop(going, ids, ~sound | beyond, u)
        if len(u) > 0:
            sim.step(u, _worlds(sim, ids))
            worlds.own_steps += len(u)
    result[result.isnan()] = math.inf
    trace = None
    if recorder is not None:
        if bool(going[path[-1]]):
            recorder.end(terms[stages:, path[-1]].clone())
        if bool(barred[path[-1]]):
            recorder.bar()
        trace = recorder.trace()
    diverged = ~result.isfinite() & ~pruned & ~barred
    terms[:, ~result.isfinite() | pruned] = math.nan
    back = tree.row.argsort().to(sim.device)[n - len(schedules) :]
    return Rolled(result[back], terms[:, back].T, diverged[back], pruned[back], barred[back], trace)


@torch.no_grad()
def record(worlds: Worlds, known: Trace, schedule: Sequence[int]) -> Trace:
    """Roll out one schedule from where `known` begins, and record it.

    The steps in which the two schedules agree are taken over from `known`.
    """
    modes = tuple(schedule)
    if modes == known.modes:
        return known
    none = torch.empty(0, len(modes), dtype=torch.long)
    rolled = roll(worlds, known, none, record=modes)
    assert rolled is not None
    assert rolled.trace is not None
    return rolled.trace


def _worlds(sim: Sim, ids: Tensor | slice) -> Ids:
    """Ascending `ids`; None, which costs least, where they are all worlds."""
    return None if count(ids, sim.num_worlds) == sim.num_worlds else ids


def _indices(ids: Tensor | slice) -> Tensor:
    return torch.arange(ids.start, ids.stop) if isinstance(ids, slice) else ids


def _drop(
    going: Tensor, ids: Tensor | slice, bad: Tensor, *rows: Tensor
) -> tuple[Tensor | slice, tuple[Tensor, ...]]:
    """End those of `ids` that are `bad` (n,): the ids that go on, and of `rows`, (n, ...) each, theirs."""
    if not bool(bad.any()):
        return ids, rows
    index = _indices(ids).to(bad.device)
    going[index[bad]] = False
    return index[~bad], tuple(each[~bad] for each in rows)
