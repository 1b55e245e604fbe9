"""One schedule's trajectory, recorded: for execution, figures and planning on from any of its steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.cost import total
from hmc.schedule import Schedule
from hmc.sim.ids import blocks, fresh
from hmc.start import Start
from hmc.task import Task
from hmc.worlds import Worlds

Floats = NDArray[np.float64]
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
        stage: stage terms of each step times dt, (n, number of stage terms), on the CPU.
        terminal: terminal terms, (number of terminal terms,), on the CPU; NaN where the world diverged.
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
        rows = np.vstack([np.zeros((1, self.stage.shape[1])), self.stage.numpy()])
        return torch.from_numpy(np.add.accumulate(rows))

    @cached_property
    def terms(self) -> Tensor:
        """Each term's share of the cost, stage terms first, (number of terms,); NaN where it ended early."""
        terms = torch.cat([self.sums[-1], self.terminal])
        # of a cost without terminal terms, what was summed up to there would pass for all of it
        arrived = len(self) == len(self.modes) and bool(self.x[-1].isfinite().all())
        return terms if arrived and bool(terms.isfinite().all()) else torch.full_like(terms, math.nan)

    @cached_property
    def cost(self) -> float:
        """J; inf where the world diverged, or a guard barred a mode."""
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


Traces: TypeAlias = tuple[Trace, ...]  # of one schedule, on each member of an ensemble; as long as each other


@torch.no_grad()
def roots(worlds: Worlds, starts: Sequence[Start]) -> Traces:
    """The traces of no steps at all, that of each member's start made in its first world."""
    return tuple(_root(worlds, start, slice(e, e + 1)) for e, start in enumerate(starts))


def _root(worlds: Worlds, start: Start, at: slice) -> Trace:
    """The trace of no steps at all from `start`, made in world `at`."""
    worlds.reset(start, at)
    stages, names = len(worlds.task.cost.stage), len(worlds.task.cost.names)
    none = torch.full((names,), math.nan, dtype=torch.float64)
    running = torch.tensor([-1 if start.mode is None else start.mode])
    rows = worlds.sim.x(at), worlds.sim.u(at), fresh(worlds.memory, at), running, worlds.sim.save(at)
    situation: dict[str, Any] = dict(zip(SITUATION, rows, strict=True))
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
    """Takes down what happens to worlds while they are rolled out, for the traces of their schedules.

    Branch j of the rollout is, on an ensemble's member e of E, world j E + e.

    Args:
        known: the traces of an earlier schedule from the same starts, E of them.
        path: the one branch to take down at each step i = 0 ... T, -1 for none; None takes down all.
    """

    def __init__(self, known: Traces, path: list[int] | None):
        self.known, self.path = known, path
        # by step: which branches, and what of their worlds
        self._rows: dict[int, tuple[np.ndarray | slice, tuple[Tensor, ...]]] = {}
        self._stage: dict[int, tuple[np.ndarray | slice, Floats]] = {}

    def arrive(
        self, worlds: Worlds, i: int, ids: np.ndarray | slice, at: Tensor | slice, x: Tensor, u: Tensor
    ) -> None:
        """Branches `ids`, in worlds `at`, have come to step i, in states x with last inputs u, (n E, ...)."""
        if self.path is not None:
            place, branch = self._place(ids, self.path[i]), self.path[i]
            if place is None:
                return
            ids, x, u = slice(branch, branch + 1), x[place], u[place]
            at = blocks(ids, len(self.known)) if isinstance(at, Tensor) else place
        self._rows[i] = ids, (x, u, fresh(worlds.memory, at), worlds.sim.save(at))

    def step(self, i: int, ids: np.ndarray | slice, stage: Floats) -> None:
        """Stage terms of branches `ids` in step i, (number of stage terms, n E)."""
        if self.path is not None:
            place, branch = self._place(ids, self.path[i]), self.path[i]
            if place is None:
                return
            ids, stage = slice(branch, branch + 1), stage[:, place].copy()
        self._stage[i] = ids, stage

    def traces(self, modes: tuple[int, ...], path: list[int], terminal: Tensor, barred: bool) -> Traces:
        """The traces of a schedule; none goes on where another one ended.

        Args:
            modes: of the schedule, T.
            path: the branch that it was at each step i = 0 ... T; -1 as long as it agrees with `known`.
            terminal: its terminal terms, (E, number of terminal terms); NaN where it did not come so far.
            barred: whether a guard barred its next mode.
        """
        known, agree = self.known, next(i for i, branch in enumerate(path) if branch >= 0)
        stage: list[Floats] = []
        rows: list[list[Tensor]] = []
        for i in range(agree, len(modes)):
            if i not in self._stage or i + 1 not in self._rows:
                break
            (ids, found), (then, situation) = self._stage[i], self._rows[i + 1]
            place, after = self._place(ids, path[i]), self._place(then, path[i + 1])
            if place is None or after is None:
                break
            stage.append(found[:, place].T)
            alone = len(situation[0]) == len(known)  # to take all of them would be a copy for nothing
            rows.append(list(situation) if alone else [part[after] for part in situation])
        found_stages = np.array(stage)
        good = np.isfinite(found_stages.sum((1, 2))) if rows else np.ones(0, dtype=bool)
        rows = rows if good.all() else rows[: int(good.argmin())]
        # steps first, then members
        stages = torch.stack([each.stage[:agree] for each in known], 1)
        measured = [name for name in SITUATION if name != "mode"]
        parts = {
            name: torch.stack([getattr(each, name)[: agree + 1] for each in known], 1) for name in measured
        }
        if rows:
            stages = torch.cat([stages, torch.from_numpy(found_stages[: len(rows)])])
            for name, column in zip(measured, zip(*rows, strict=True), strict=True):
                parts[name] = torch.cat([parts[name], torch.stack(column)])
        mode = torch.tensor([int(known[0].mode[0]), *modes[: len(stages)]])

        def trace(e: int) -> Trace:
            situation: dict[str, Any] = {name: part[:, e] for name, part in parts.items()}
            return Trace(
                known[e].task,
                modes,
                known[e].k,
                mode=mode,
                stage=stages[:, e],
                terminal=terminal[e],
                ran=known[e].ran,
                barred=barred,
                **situation,
            )

        return tuple(trace(e) for e in range(len(known)))

    def _place(self, ids: np.ndarray | slice, branch: int) -> slice | None:
        """Where among the worlds of branches `ids`, ascending, those of one are; None where they are not."""
        if isinstance(ids, slice):
            place = branch - ids.start if ids.start <= branch < ids.stop else -1
        else:
            place = int(ids.searchsorted(branch))
            place = place if place < len(ids) and ids[place] == branch else -1
        return slice(place * len(self.known), (place + 1) * len(self.known)) if place >= 0 else None
