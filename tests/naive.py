"""What a schedule costs by the definition: one world, one control step after the other, nothing shared."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from functools import reduce

import torch

from hmc.rules import Rules
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.task import Task


def naive_cost(task: Task, modes: Sequence[int], start: Start, sim: Sim | None = None) -> float:
    """J of one schedule, on an ensemble the risk of it; inf where it diverges or breaks a rule.

    Args:
        task: of any kind.
        modes: of the schedule.
        start: where from.
        sim: one world to roll out in, made with `task.make_sim`; made anew if left out.
    """
    if task.rules is not None and not allowed(task.rules, task.modes.names, modes, start.mode, start.ran):
        return math.inf
    members = task.ensemble
    if members is None:
        return _alone(task, modes, start, task.make_sim(1) if sim is None else sim)
    each = [_alone(task, modes, one, members.make_sim([e])) for e, one in enumerate(members.starts(start))]
    return float(members.risk(torch.tensor([each], dtype=torch.float64))[0])


def _alone(task: Task, modes: Sequence[int], start: Start, sim: Sim) -> float:
    sim.reset(start.x[None], start.u[None])
    if start.snapshot is not None:
        sim.load(start.snapshot[None])
    guards = {} if task.rules is None else task.rules.guards
    running, memory, sums = start.mode, start.memory[None], [0.0] * len(task.cost.names)
    for i, index in enumerate(modes):
        x, before, mode = sim.x(), sim.u(), task.modes[index]
        now = torch.tensor([start.k + i], device=x.device)
        if index != running:
            if mode.name in guards and not bool(guards[mode.name](x, now)[0]):
                return math.inf
            memory = mode.reset(x, before, now).to(sim.dtype)
        action, memory = (each.to(sim.dtype) for each in mode.act(x, before, memory, now))
        for j, term in enumerate(task.cost.stage.values()):
            sums[j] += float(term(x, action, before, now)[0]) * sim.dt
        if not math.isfinite(float(x.sum() + action.sum()) + sum(sums)):
            return math.inf
        sim.step(action)
        running = index
    x, now = sim.x(), torch.tensor([start.k + len(modes)], device=start.x.device)
    for j, final in enumerate(task.cost.terminal.values(), len(task.cost.stage)):
        sums[j] = float(final(x, now)[0])
    cost = reduce(operator.add, sums)  # sum() compensates what rounding loses since Python 3.12
    return cost if math.isfinite(cost + float(x.sum())) else math.inf


def allowed(
    rules: Rules, names: Sequence[str], modes: Sequence[int], running: int | None, ran: int | None
) -> bool:
    """Whether a schedule keeps to the rules, guards aside, by their definition: one step at a time."""
    changes, count, mode = 0, ran if ran is not None else math.inf, running
    for i, chosen in enumerate(modes):
        if i == 0 and mode is None:
            count = 0
        elif mode is not None and chosen != mode:
            if count < rules.dwell.get(names[mode], 0) or (names[mode], names[chosen]) in rules.forbidden:
                return False
            changes, count = changes + 1, 0
        mode, count = chosen, count + 1
    return rules.max_changes is None or changes <= rules.max_changes
