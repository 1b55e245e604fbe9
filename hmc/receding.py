"""The receding-horizon loop: shift the schedule, plan again, run the first step's mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hmc.budget import Budget
from hmc.memory import make_worlds
from hmc.planner import Plan, Progress, batch_of, plan, worlds_for
from hmc.running import Running
from hmc.sim.base import Sim
from hmc.solvers import ORDERS
from hmc.start import Vector, make_start
from hmc.task import Task
from hmc.trace import Trace


@dataclass(frozen=True)
class SearchCfg:
    """The search at each control step.

    Attributes:
        samples: switches drawn a batch.
        order: of the draws, see `hmc.plan`.
        pairs: further draws beside each batch, into a mode and on to a third.
        moves: further draws beside each batch that move a stretch of the schedule.
        draws: switches that a tick's search may draw.
        control_steps: control steps that it may roll out.
        seconds: wall-clock time that it may take [s]; 0 for any.
    """

    samples: int = 16
    order: str = "tails"
    pairs: int = 8
    moves: int = 0
    draws: int = 16
    control_steps: int = 8000
    seconds: float = 0.0

    def __post_init__(self) -> None:
        if self.order not in ORDERS:
            raise ValueError(f"order must be one of {', '.join(ORDERS)}, got {self.order!r}")
        for name, least in {"samples": 1, "draws": 1, "control_steps": 1, "pairs": 0, "moves": 0}.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not 0.0 <= self.seconds < math.inf:
            raise ValueError(f"seconds must be a time, or 0 for any, got {self.seconds}")

    def options(self) -> dict[str, Any]:
        """Arguments of `Receding`."""
        budget = Budget(self.draws, self.control_steps, self.seconds or None)
        return {
            "samples": self.samples,
            "order": self.order,
            "pairs": self.pairs,
            "moves": self.moves,
            "budget": budget,
        }


@dataclass(frozen=True, eq=False)
class Tick:
    """One control step of the loop.

    Attributes:
        u: the input to apply, (nu,).
        mode: index of the mode that chose it.
        plan: the plan whose first step this is.
    """

    u: Tensor
    mode: int
    plan: Plan


class Receding:
    """Plans at every control step and keeps, between steps, what the next plan goes on from.

    At each tick the last schedule moves one step on (its last mode is repeated at the end) and is the
    incumbent of the next search. The running mode keeps its memory as long as the schedule stays in it,
    so a world that follows the prediction makes the plan's own trajectory.

    Attributes:
        k: control steps since the start of the task.
        schedule: incumbent of the next tick; None before the first one: `plan`'s default.
        running: the mode now running, and its memory.

    Args:
        task: what to plan.
        schedule: incumbent of the first tick, T modes by index or name.
        seed: of the draws; each tick draws from (seed, k).
        k: control step of the first tick.
        sim: simulator to plan in; made once if left out.
        room: bytes that its worlds may then take, as in `plan`.
        solver, samples, max_samples, order, pairs, moves, iterations, budget, tolerance, progress: as in
            `plan`, for every tick.
    """

    def __init__(
        self,
        task: Task,
        *,
        schedule: Sequence[int | str] | None = None,
        seed: int = 0,
        k: int = 0,
        sim: Sim | None = None,
        room: float | None = None,
        solver: str = "sample",
        samples: int | None = None,
        max_samples: int = 0,
        order: str = "uniform",
        pairs: int = 0,
        moves: int = 0,
        iterations: int | None = None,
        budget: Budget | None = None,
        tolerance: float = 1e-6,
        progress: Progress | None = None,
    ):
        self.task, self.seed, self.k, self.schedule = task, seed, k, schedule
        samples = batch_of(task, solver, samples)
        wanted = worlds_for(task, samples, max_samples, pairs + moves)
        self.sim = sim if sim is not None else make_worlds(task, wanted, room)
        self.running = Running(task.modes)
        self._known: Trace | None = None
        self._plan = partial(
            plan,
            task,
            sim=self.sim,
            solver=solver,
            samples=samples,
            max_samples=max_samples,
            order=order,
            pairs=pairs,
            moves=moves,
            iterations=iterations,
            budget=budget,
            tolerance=tolerance,
            progress=progress,
        )

    def rewind(self, k: int) -> None:
        """Go on at control step k of the task, wherever the loop was: goals come again, or are skipped.

        The incumbent and the running mode stay; what was priced for other steps is forgotten.
        """
        self.k, self._known = k, None

    @torch.no_grad()
    def tick(self, x: Vector, u: Vector | None = None, snapshot: Tensor | None = None) -> Tick:
        """Plan from state x and give the input for this control step.

        Args:
            x: state, (nx,).
            u: input applied last, (nu,), if it is not the one that the last tick gave.
            snapshot: the engine's snapshot row of x, if the world is simulated by the same engine.
        """
        now = self.running
        last = now.u if u is None else u
        start = make_start(self.task, self.sim, x, last, now.mode, now.memory, self.k, snapshot, now.ran)
        first = self._known is None
        known = self._known.since(1) if self._known is not None and len(self._known) > 0 else None
        result = self._plan(
            start, schedule=self.schedule, seed=(self.seed, self.k), forget=first, known=known
        )
        self._known = result.known
        action = now.act(result.schedule[0], start.x, start.u, self.k)
        self.schedule = result.schedule.shift()
        self.k += 1
        return Tick(action, result.schedule[0], result)
