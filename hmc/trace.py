"""One schedule's trajectory, recorded: for execution, figures and planning on from any of its steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from hmc.cost import total
from hmc.schedule import Schedule
from hmc.start import Start
from hmc.task import Task
from hmc.worlds import Worlds

# What a situation is, a row a step: a world put there goes on bit for bit.
SITUATION = ("x", "u", "memory", "mode", "snapshots")


@dataclass(frozen=True, eq=False)
class Trace:
    """One schedule, rolled out and recorded; n = T steps, fewer where the world diverged.

    Attributes:
        task: what was rolled out.
        modes: of the schedule, T; those of the steps after n never ran.
        k: control step of row 0.
        x: states, (n + 1, nx).
        u: inputs, (n + 1, nu); row 0 was applied before the trace began, row i + 1 in step i.
        memory: memory of the mode that ran last on arrival at each step, (n + 1, memory_size).
        mode: that mode, (n + 1,) long; -1 in row 0 if none was running.
        snapshots: engine snapshot rows, (n + 1, ns).
        stage: stage terms of each step times dt, (n, number of stage terms).
        terminal: terminal terms, (number of terminal terms,); NaN where the world diverged.
        ran: control steps that the mode of row 0 had been running; None: unknown.
        barred: whether it ended because a guard barred the next step's mode.
    """

    task: Task
    modes: tuple[int, ...]
    k: int
    x: Tensor
    u: Tensor
    memory: Tensor
    mode: Tensor
    snapshots: Tensor
    stage: Tensor
    terminal: Tensor
    ran: int | None = None
    barred: bool = False

    def __len__(self) -> int:
        """How many steps were recorded, n."""
        return len(self.stage)

    @property
    def schedule(self) -> Schedule:
        """What was rolled out."""
        return Schedule(self.modes, self.task.modes.names)

    @cached_property
    def sums(self) -> Tensor:
        """Stage terms summed up to each step, in a rollout's order, (n + 1, number of stage terms)."""
        rows = np.vstack([np.zeros((1, self.stage.shape[1])), self.stage.cpu().numpy()])
        return torch.from_numpy(np.add.accumulate(rows)).to(self.stage.device)

    @cached_property
    def terms(self) -> Tensor:
        """Each term's share of the cost, stage terms first, (number of terms,); NaN where diverged."""
        terms = torch.cat([self.sums[-1], self.terminal])
        return terms if bool(terms.isfinite().all()) else torch.full_like(terms, math.nan)

    @cached_property
    def cost(self) -> float:
        """J; inf where the world diverged."""
        cost = float(total(self.terms[None])[0])
        return cost if math.isfinite(cost) else math.inf

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
            ran=self._ran(i),
        )

    def _ran(self, i: int) -> int | None:
        """How long the mode on arrival at step i has been running."""
        since = self._since[i]
        if since > 0:
            return i - since + 1
        return None if self.ran is None else i + self.ran

    @cached_property
    def _since(self) -> list[int]:
        """The row in which the mode on arrival at each step appeared."""
        modes, since = self.mode.tolist(), [0]
        for i in range(1, len(modes)):
            since.append(i if modes[i] != modes[i - 1] else since[-1])
        return since

    def since(self, i: int) -> Self:
        """The rest of this trace from its step i on, as the trace of the rest of its schedule."""
        rows = {name: getattr(self, name)[i:] for name in (*SITUATION, "stage")}
        ran = self._ran(i)
        return type(self)(
            self.task, self.modes[i:], self.k + i, terminal=self.terminal, ran=ran, barred=self.barred, **rows
        )

    def meets(self, other: Trace) -> bool:
        """Whether both begin in the same situation, bit for bit."""
        same = self.task is other.task and self.k == other.k
        return same and all(
            torch.equal(getattr(self, part)[0], getattr(other, part)[0]) for part in SITUATION
        )


@torch.no_grad()
def root(worlds: Worlds, start: Start) -> Trace:
    """The trace of no steps at all from `start`, made in world 0."""
    zero = torch.zeros(1, dtype=torch.long, device=worlds.sim.device)
    worlds.reset(start, zero)
    stages, names = len(worlds.task.cost.stage), len(worlds.task.cost.names)
    none = torch.full((names,), math.nan, dtype=torch.float64, device=worlds.sim.device)
    situation: dict[str, Any] = dict(zip(SITUATION, _situation(worlds, zero), strict=True))
    return Trace(
        worlds.task,
        (),
        start.k,
        stage=none[None, :stages][:0],
        terminal=none[stages:],
        ran=start.ran,
        **situation,
    )


class Recorder:
    """Takes down the trace of one world of many while they are rolled out.

    Args:
        known: the trace of an earlier schedule from the same start.
        modes: the schedule, T mode indices.
        path: the world that it is in at each step i = 0 ... T; -1 as long as it agrees with `known`.
    """

    def __init__(self, known: Trace, modes: tuple[int, ...], path: list[int]):
        self.known, self.modes, self.path = known, modes, path
        self.agree = next(i for i, world in enumerate(path) if world >= 0)
        self._rows = [tuple(getattr(known, part)[: self.agree + 1] for part in SITUATION)]
        self._stage = [known.stage[: self.agree]]
        self._terminal, self._barred = torch.full_like(known.terminal, math.nan), False

    @property
    def branches(self) -> list[int]:
        """The worlds that it is in, one after the other."""
        return list(dict.fromkeys(self.path[self.agree :]))

    def arrive(self, worlds: Worlds, i: int, world: int) -> None:
        """World number `world` has come to step i."""
        if i > self.agree:  # there it is what `known` says
            self._rows.append(_situation(worlds, torch.tensor([world], device=worlds.sim.device)))

    def step(self, stage: Tensor) -> None:
        """Its stage terms in this step, (number of stage terms,)."""
        self._stage.append(stage[None])

    def end(self, terminal: Tensor) -> None:
        """Its terminal terms, (number of terminal terms,)."""
        self._terminal = terminal

    def bar(self) -> None:
        """A guard bars its next mode."""
        self._barred = True

    def trace(self) -> Trace:
        """What was recorded."""
        parts = zip(SITUATION, zip(*self._rows, strict=True), strict=True)
        situation = {part: torch.cat(column) for part, column in parts}
        known = self.known
        return Trace(
            known.task,
            self.modes,
            known.k,
            stage=torch.cat(self._stage),
            terminal=self._terminal,
            ran=known.ran,
            barred=self._barred,
            **situation,
        )


def _situation(worlds: Worlds, ids: Tensor) -> tuple[Tensor, ...]:
    """What `SITUATION` names, of worlds `ids`."""
    sim = worlds.sim
    return sim.x(ids), sim.u(ids), worlds.memory[ids], worlds.mode[ids], sim.save(ids)
