"""One schedule's trajectory, recorded: for execution, figures and re-planning from any of its steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.rollout import Worlds, finite, stage_terms, total
from hmc.schedule import Schedule
from hmc.sim.base import Sim
from hmc.start import Start
from hmc.task import Task


@dataclass(frozen=True, eq=False)
class Trace:
    """One schedule, rolled out and recorded; n = T steps, fewer where the world diverged.

    Attributes:
        task: what was rolled out.
        schedule: the T modes.
        k: control step of row 0.
        x: states, (n + 1, nx).
        u: inputs, (n + 1, nu); row 0 was applied before the trace began, row i + 1 in step i.
        memory: memory of the mode that ran last on arrival at each step, (n + 1, memory_size).
        mode: that mode, (n + 1,) long; -1 in row 0 if none was running.
        snapshots: engine snapshot rows, (n + 1, ns).
        stage: stage terms of each step times dt, (n, number of stage terms).
        terminal: terminal terms, (number of terminal terms,).
        cost: J, inf where the world diverged.
    """

    task: Task
    schedule: Schedule
    k: int
    x: Tensor
    u: Tensor
    memory: Tensor
    mode: Tensor
    snapshots: Tensor
    stage: Tensor
    terminal: Tensor
    cost: float

    def start(self, i: int, *, exact: bool = True) -> Start:
        """The situation on arrival at step i, to plan on from there.

        `exact` takes the engine's snapshot along; without it only x and u are known, as on a robot.
        """
        mode = int(self.mode[i])
        size = 0 if mode < 0 else self.task.modes[mode].memory_size
        return Start(
            x=self.x[i],
            u=self.u[i],
            mode=None if mode < 0 else mode,
            memory=self.memory[i, :size],
            k=self.k + i,
            snapshot=self.snapshots[i] if exact else None,
        )


@torch.no_grad()
def record(task: Task, sim: Sim, start: Start, schedule: Schedule) -> Trace:
    """Roll out one schedule from `start` in world 0 of `sim` and record it."""
    worlds, zero = Worlds(task, sim), torch.zeros(1, dtype=torch.long, device=sim.device)
    worlds.reset(start, zero)
    arrivals, stage = [], []
    terms = torch.zeros(1, len(task.cost.names), dtype=torch.float64, device=sim.device)
    stages, cost = len(task.cost.stage), math.inf
    for i, mode in enumerate([*schedule, None]):
        x, u_prev, k = sim.x(zero), sim.u(zero), torch.full_like(zero, start.k + i)
        arrivals.append((x, u_prev, worlds.memory[:1].clone(), worlds.mode[:1].clone(), sim.save(zero)))
        if not finite(x).all():
            break
        if mode is None:
            terms[:, stages:] = task.cost.terminal_terms(x, k).to(torch.float64)
            cost = float(total(terms)[0])
            break
        u = worlds.act(zero, torch.full_like(zero, mode), x, u_prev, k)
        step_terms = stage_terms(task, x, u, u_prev, k, sim.dt)
        terms[:, :stages] += step_terms
        if not (finite(u) & finite(terms)).all():
            break
        stage.append(step_terms)
        sim.step(u, zero)
    x, u, memory, modes, snapshots = (torch.cat(rows) for rows in zip(*arrivals, strict=True))
    return Trace(
        task=task,
        schedule=schedule,
        k=start.k,
        x=x,
        u=u,
        memory=memory,
        mode=modes,
        snapshots=snapshots,
        stage=torch.cat([*stage, terms[:0, :stages]]),
        terminal=terms[0, stages:],
        cost=cost if math.isfinite(cost) else math.inf,
    )
