"""One schedule rolled out and recorded: the incumbent that others are rolled out from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from hmc.rollout import roll
from hmc.sim.ids import joined
from hmc.trace import Trace, Traces
from hmc.worlds import Worlds, finite


@torch.no_grad()
def record(worlds: Worlds, known: Traces, schedule: Sequence[int]) -> Traces:
    """Roll out one schedule from where `known` begins, and record it on each member.

    The steps in which the two schedules agree are taken over from `known`.
    """
    modes, task = tuple(schedule), worlds.task
    if modes == known[0].modes:
        return known
    guarded = task.rules is not None and bool(task.rules.guards)
    if task.modes.constants is not None and not guarded and len(known) == 1 and worlds.cheap:
        return (_played(worlds, known[0], modes, task.modes.constants.take(modes)),)
    none = torch.empty(0, len(modes), dtype=torch.long)
    rolled = roll(worlds, known, none, recorded=modes)
    assert rolled is not None
    assert rolled.trace is not None
    return rolled.trace


def _played(worlds: Worlds, known: Trace, modes: tuple[int, ...], held: np.ndarray) -> Trace:
    """As `record`, to the bit, under inputs (T,) that nothing changes: one has to look at nothing on the way.

    Where the world diverged is found out at the end, from its snapshots.
    """
    task, sim = worlds.task, worlds.sim
    steps = enumerate(zip(modes, known.modes[: len(known)], strict=False))
    agree = next((i for i, (now, before) in steps if now != before), len(known))
    here = slice(0, 1)
    worlds.enter(known, agree, here)
    snapshots = [known.snapshots[agree : agree + 1]]
    inputs = torch.from_numpy(held[agree:]).to(sim.device, sim.dtype)
    for u in inputs[:, None].expand(-1, sim.nu).split(1):
        sim.step(u, here)
        snapshots.append(sim.save(here))
    rows = torch.cat(snapshots)
    parts = []
    for some in rows.split(sim.num_worlds):
        at = slice(0, len(some))
        sim.load(some, at)
        parts.append((sim.x(at), sim.u(at)))
    x, u = map(joined, zip(*parts, strict=True))
    ks = torch.arange(known.k + agree, known.k + len(modes), device=x.device)
    stage = task.cost.stage_terms(x[:-1], u[1:], u[:-1], ks).to(torch.float64).cpu() * sim.dt
    fine = _leading(finite(x).cpu())  # a step is made from each of these, but from the end
    worlds.own_steps += min(fine, len(stage))
    went = min(fine, _leading(finite(stage)))
    n = agree + went
    end = task.cost.terminal_terms(x[-1:], ks[-1:] + 1)[0].to(torch.float64).cpu()
    return replace(
        known,
        modes=modes,
        x=torch.cat([known.x[:agree], x[: went + 1]]),
        u=torch.cat([known.u[:agree], u[: went + 1]]),
        memory=known.memory[:1].expand(n + 1, -1),
        mode=torch.tensor([int(known.mode[0]), *modes[:n]]),
        snapshots=torch.cat([known.snapshots[:agree], rows[: went + 1]]),
        stage=torch.cat([known.stage[:agree], stage[:went]]),
        terminal=end if min(fine - 1, went) == len(stage) else torch.full_like(end, math.nan),
        barred=False,
    )


def _leading(flags: torch.Tensor) -> int:
    """How many of flags (n,) are True before the first that is not."""
    return int(flags.cumprod(0).sum())
