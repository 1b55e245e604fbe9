"""A small nonlinear system, modes with and without memory, and a planner-free way to get a cost."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from hmc.cost import Cost
from hmc.modes import Mode, ModeSet
from hmc.start import make_start
from hmc.task import Task
from tests.naive import naive_cost


class ToySim:
    """x = (position, velocity), u (n, 1); a filtered input h that is not part of x drives the velocity.

    h is what an engine's warm start or actuator state is: a snapshot has it, `reset` clears it. It acts
    with strength `hidden`, of all worlds or of each. Everything is elementwise, hence the same in a batch of
    any size.
    """

    nx, nu, dt = 2, 1, 0.5
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(
        self,
        num_worlds: int,
        hidden: float | Sequence[float] = 0.0,
        blow_up: float | Sequence[float] = math.inf,
        cheap: bool = False,
    ):
        self.num_worlds, self.cheap = num_worlds, cheap
        self.hidden, self.blow_up = (
            torch.tensor(value, dtype=torch.float64).expand(num_worlds) for value in (hidden, blow_up)
        )
        self.rows = torch.zeros(num_worlds, 4, dtype=torch.float64)
        self.stepped: list[list[int]] = []

    def _at(self, ids):
        return slice(None) if ids is None else ids

    def x(self, ids=None):
        return self.rows[self._at(ids), :2].clone()

    def u(self, ids=None):
        return self.rows[self._at(ids), 2:3].clone()

    def reset(self, x, u, ids=None):
        self.rows[self._at(ids)] = torch.cat([x, u, torch.zeros_like(u)], dim=1)

    def save(self, ids=None):
        return self.rows[self._at(ids)].clone()

    def load(self, rows, ids=None):
        self.rows[self._at(ids)] = rows

    def step(self, u, ids=None):
        p, v, _, h = self.save(ids).unbind(1)
        h = 0.5 * h + u[:, 0]
        v = v + self.dt * (u[:, 0] + self.hidden[self._at(ids)] * h - torch.sin(2.0 * p))
        p = p + self.dt * v
        p = torch.where(p.abs() > self.blow_up[self._at(ids)], math.nan, p)
        self.rows[self._at(ids)] = torch.stack([p, v, u[:, 0], h], dim=1)
        self.stepped.append(torch.arange(self.num_worlds)[self._at(ids)].tolist())


class Push(Mode):
    """A constant input."""

    def __init__(self, value: float, name: str = ""):
        self.value, self.name = value, name or f"push{value:g}"

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(u, self.value), memory


class Damp(Mode):
    """State feedback."""

    name = "damp"

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        return -1.5 * x[:, 1:2] - 0.3 * x[:, :1], memory


class Ramp(Mode):
    """Memory (steps since entry, position, input and step at entry): all of them shape the input."""

    name = "ramp"
    memory_size = 4

    def __init__(self) -> None:
        self.entries: list[tuple[int, float, float]] = []

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        self.entries += zip(k.tolist(), x[:, 0].tolist(), u[:, 0].tolist(), strict=True)
        return torch.stack([torch.zeros(len(x), dtype=x.dtype), x[:, 0], u[:, 0], k.to(x.dtype)], dim=1)

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        count, position, pushed, since = memory.unbind(1)
        assert torch.equal(count, k.to(x.dtype) - since)
        action = 0.3 * count + position - x[:, 0] - 0.2 * pushed + 0.1 * torch.cos(k.to(x.dtype))
        return action[:, None], torch.stack([count + 1, position, pushed, since], dim=1)


class Bad(Mode):
    """Acts like a push until step `after`, then returns `value`: NaN, usually."""

    name = "bad"

    def __init__(self, after: int, value: float = math.nan):
        self.after, self.value = after, value

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        return torch.where(k[:, None] < self.after, 0.5, self.value).to(x.dtype), memory


COST = Cost(
    stage={
        "position": lambda x, u, u_prev, k: (x[:, 0] - torch.cos(0.9 * k.to(x.dtype))) ** 2,
        "velocity": lambda x, u, u_prev, k: 0.1 * x[:, 1] ** 2,
        "rate": lambda x, u, u_prev, k: 0.02 * (u - u_prev)[:, 0] ** 2,
    },
    terminal={"arrival": lambda x, k: 0.5 * x[:, 0] ** 2 + 0.01 * k.to(x.dtype)},
    nonnegative=True,
)


def toy_task(horizon: int = 6, modes: list[Mode] | None = None, cost: Cost = COST, **sim: float) -> Task:
    """A task on `ToySim`; by default with modes that push, damp and ramp."""
    chosen = ModeSet(modes or [Push(1.0), Damp(), Ramp()])
    return Task("toy", chosen, cost, horizon, lambda n: ToySim(n, **sim))


def slow_cost(task: Task, modes, x, u=(0.0,), mode=None, memory=None, k=0) -> float:
    """J of one schedule by its definition, see `naive_cost`."""
    return naive_cost(task, modes, make_start(task, task.make_sim(1), x, u, mode, memory, k))


def all_schedules(num_modes: int, horizon: int) -> Tensor:
    """M^T, every schedule, (M^T, T)."""
    return torch.tensor(list(itertools.product(range(num_modes), repeat=horizon)))
