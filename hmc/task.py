"""A task: what the planner needs to know besides the state it starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from hmc.cost import Cost
from hmc.ensemble import Ensemble
from hmc.modes import Mode, ModeSet
from hmc.rules import Rules
from hmc.sim.base import Sim


@dataclass(frozen=True)
class Task:
    """Modes, cost and horizon on one kind of simulator.

    Attributes:
        name: for messages and files.
        modes: the controllers to choose from.
        cost: what to minimise.
        horizon: length T of a schedule in control steps.
        make_sim: number of worlds -> a simulator to plan in.
        rules: what schedules have to respect; None for nothing.
        lower_bound: f(x, k, steps) -> (n,), at most what any schedule costs from states x (n, nx) at control
            steps k (n,) over the `steps` that are left, terminal cost included: rollouts that cannot get
            below the best known cost end sooner. Used where the cost says that it is non-negative.
        tail_bound: f(mode, x, k, steps) -> (n,), the same where one mode runs to the end, as it does in most
            of what a search rolls out; None where nothing is known of that mode. Either bound holds for
            every model of an ensemble. Who replaces the cost or the simulator replaces the bounds as well.
        ensemble: models that schedules are judged on in place of one from `make_sim`; None for that one.
    """

    name: str
    modes: ModeSet
    cost: Cost
    horizon: int
    make_sim: Callable[[int], Sim]
    rules: Rules | None = None
    lower_bound: Callable[[Tensor, Tensor, int], Tensor] | None = None
    tail_bound: Callable[[Mode, Tensor, Tensor, int], Tensor | None] | None = None
    ensemble: Ensemble | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.modes, ModeSet):
            raise ValueError(
                f"task {self.name!r}: modes must be a ModeSet, got {type(self.modes).__name__}: pass "
                "ModeSet([mode, ...])"
            )
        if self.horizon <= 0:
            raise ValueError(
                f"task {self.name!r}: horizon must be at least 1 control step, got {self.horizon}"
            )
        if self.rules is not None:
            self.rules.check(self.modes)
