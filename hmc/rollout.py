"""Rollouts: many schedules in step, as the branches of a tree, each beginning rolled out once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.branches import branches
from hmc.sim.base import Sim
from hmc.trace import Trace
from hmc.worlds import Worlds, finite, stage_terms, total


@dataclass(frozen=True, eq=False)
class Rolled:
    """What came of n rollouts.

    Attributes:
        cost: J, (n,) float64; inf where diverged, a lower bound where pruned.
        terms: each term's share, (n, number of terms) float64; NaN where diverged or pruned.
        diverged: worlds whose state, input or cost stopped being finite, (n,) bool.
        pruned: worlds given up because they are sure to exceed the bound, (n,) bool.
        barred: worlds that came to a mode whose guard barred it, (n,) bool; their cost is inf.
    """

    cost: Tensor
    terms: Tensor
    diverged: Tensor
    pruned: Tensor
    barred: Tensor


def roll(
    worlds: Worlds,
    trunk: Trace,
    schedules: Tensor,
    bound: float = math.inf,
    stop: Callable[[], bool] | None = None,
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
    """
    sim, cost = worlds.sim, worlds.task.cost
    n, horizon = schedules.shape
    tree = branches(schedules.cpu(), trunk.modes[: len(trunk)])
    modes, parents = tree.modes.to(sim.device), tree.parent.to(sim.device)
    limit = bound if cost.nonnegative else math.inf
    rest = worlds.task.lower_bound if math.isfinite(limit) else None
    slack = 1e-9 * abs(limit)  # more than rounding can make of partial cost and lower bound
    stages, guarded = len(cost.stage), worlds.task.rules is not None and bool(worlds.task.rules.guards)
    result = torch.full((n,), math.inf, dtype=torch.float64, device=sim.device)
    terms = torch.zeros(n, len(cost.names), dtype=torch.float64, device=sim.device)
    pruned = torch.zeros(n, dtype=torch.bool, device=sim.device)
    barred, going = torch.zeros_like(pruned), torch.zeros_like(pruned)
    ids = going.nonzero().squeeze(1)  # branch j runs in world j: those that are going on
    for i in range(horizon + 1):
        if stop is not None and stop():
            return None
        born = slice(tree.born[i], tree.born[i + 1])
        if born.stop > born.start:
            new, parent = torch.arange(born.start, born.stop, device=sim.device), parents[born]
            seeds = new[parent < 0]
            shoots, stems = new[parent >= 0], parent[parent >= 0]
            if len(seeds) > 0:
                worlds.reset(trunk.start(i), seeds)
                terms[seeds, :stages], going[seeds] = trunk.sums[i], True
            if len(shoots) > 0:
                worlds.branch(stems, shoots)
                for each in (terms, result, pruned, barred, going):  # a stem that has ended passes on its end
                    each[shoots] = each[stems]
            ids = going[: born.stop].nonzero().squeeze(1)
        if len(ids) == 0:
            continue
        x = sim.x(_indexed(sim, ids))
        if not bool(x.isfinite().all()):
            sound = finite(x)
            going[ids[~sound]] = False
            ids, x = ids[sound], x[sound]
            if len(ids) == 0:
                continue
        k = torch.full_like(ids, trunk.k + i)
        if i == horizon:
            terms[ids, stages:] = cost.terminal_terms(x, k).to(torch.float64)
            result[ids] = total(terms[ids])
            break
        if guarded and bool((bad := worlds.barred(ids, modes[ids, i], x, k)).any()):
            barred[ids[bad]], going[ids[bad]] = True, False
            ids, x, k = ids[~bad], x[~bad], k[~bad]
            if len(ids) == 0:
                continue
        if rest is not None:
            least = total(terms[ids]) + rest(x, k, horizon - i).to(torch.float64) - slack
            if bool((bad := least > limit).any()):
                result[ids[bad]], pruned[ids[bad]], going[ids[bad]] = least[bad], True, False
                ids, x, k = ids[~bad], x[~bad], k[~bad]
                if len(ids) == 0:
                    continue
        u_prev = sim.u(_indexed(sim, ids))
        u = worlds.act(ids, modes[ids, i], x, u_prev, k)
        terms[ids, :stages] += stage_terms(worlds.task, x, u, u_prev, k, sim.dt)
        partial = total(terms[ids])
        sound, beyond = partial.isfinite() & finite(u), partial > limit
        if not bool((sound & ~beyond).all()):
            given_up = ids[sound & beyond]
            result[given_up], pruned[given_up] = partial[sound & beyond], True
            going[ids[~sound | beyond]] = False
            ids, u = ids[sound & ~beyond], u[sound & ~beyond]
            if len(ids) == 0:
                continue
        sim.step(u, _indexed(sim, ids))
        worlds.control_steps += len(ids)
    result[result.isnan()] = math.inf
    diverged = ~result.isfinite() & ~pruned & ~barred
    terms[~result.isfinite() | pruned] = math.nan
    back = tree.row.argsort().to(sim.device)
    return Rolled(result[back], terms[back], diverged[back], pruned[back], barred[back])


def _indexed(sim: Sim, ids: Tensor) -> Tensor | None:
    """Ascending `ids`; None, which costs no indexing, where they are all worlds."""
    return None if len(ids) == sim.num_worlds else ids
