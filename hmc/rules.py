"""Which schedules may run: dwell times, forbidden changes, a limit on changes, guards on the state."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.modes import ModeSet
from hmc.sim.device import upload

Guard = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Rules:
    """What a schedule has to respect, besides being cheap. Modes are given by name.

    To stay in the running mode breaks no rule, so that there is always a schedule to go on with.

    Attributes:
        dwell: fewest control steps that a mode runs before another one takes over; the end of the horizon
            may cut it short.
        forbidden: changes (from, to) that must not be made.
        max_changes: most changes of mode within a horizon; None for any number.
        guards: f(x, k) -> (n,) bool, from states x (n, nx) at control steps k (n,): whether the mode may be
            entered there.
        fallback: the mode that runs if no schedule has a finite cost, whatever the other rules say of it;
            None: the incumbent goes on.
    """

    dwell: Mapping[str, int] = field(default_factory=dict)
    forbidden: Collection[tuple[str, str]] = ()
    max_changes: int | None = None
    guards: Mapping[str, Guard] = field(default_factory=dict)
    fallback: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "forbidden", tuple(self.forbidden))  # what zip() gives can be read once only

    def check(self, modes: ModeSet) -> None:
        """Refuse names that `modes` does not have, and numbers that mean nothing."""
        for pair in self.forbidden:
            if isinstance(pair, str) or len(pair) != 2:
                raise ValueError(f"rules.forbidden has {pair!r}: expected pairs of modes, (from, to)")
        pairs = [name for pair in self.forbidden for name in pair]
        for name in (*self.dwell, *pairs, *self.guards, *filter(None, [self.fallback])):
            modes.index(name)
        for name, steps in self.dwell.items():
            if not _whole(steps, 1):
                raise ValueError(
                    f"rules.dwell of mode {name!r} must be a whole number of control steps >= 1, got {steps}"
                )
        for pair in self.forbidden:
            if pair[0] == pair[1]:
                raise ValueError(f"rules.forbidden has {pair!r}, which is no change: leave it out")
        if self.max_changes is not None and not _whole(self.max_changes, 0):
            raise ValueError(f"rules.max_changes must be a whole number >= 0, got {self.max_changes}")

    def broken(self, modes: ModeSet, schedules: Tensor, mode: int | None, ran: int | None) -> Tensor:
        """Which of schedules (N, T) break a rule, whatever the states will be, (N,) bool.

        Args:
            modes: what the indices mean.
            schedules: mode indices.
            mode: the mode now running; None if none is.
            ran: control steps that it has been running; None for long enough.
        """
        # steps first, as a planner lays them out; a call of numpy's takes a fraction of the time of torch's
        steps = schedules.cpu().numpy().T
        horizon, n = steps.shape
        before = np.empty_like(steps)
        before[1:], before[:1] = steps[:-1], steps[:1] if mode is None else mode
        change, bad = steps != before, np.zeros(n, dtype=bool)
        if self.max_changes is not None:
            bad |= change.sum(0) > self.max_changes
        for one, other in self.forbidden:
            bad |= ((before == modes.index(one)) & (steps == modes.index(other))).any(0)
        if self.dwell:
            fewest = np.zeros(len(modes), dtype=np.int64)
            for name, least in self.dwell.items():
                fewest[modes.index(name)] = least
            begun = 0 if mode is None else -(horizon + int(fewest.max()) if ran is None else ran)
            step = np.arange(horizon)[:, None]
            since = np.empty(steps.shape, dtype=np.int64)
            since[:1], since[1:] = begun, np.maximum.accumulate(np.where(change, step, begun), 0)[:-1]
            bad |= (change & (step - since < fewest[before])).any(0)
        return torch.from_numpy(bad).to(schedules.device)

    def reasons(self, modes: ModeSet, schedules: Tensor, mode: int | None, ran: int | None) -> dict[str, int]:
        """How many of schedules (N, T) break each rule, guards aside; who breaks several counts at the first.

        Arguments as of `broken`.
        """
        found = {}
        for name, alone in self._apart():
            bad = alone.broken(modes, schedules, mode, ran)
            if bad.any():
                found[name], schedules = int(bad.sum()), schedules[~bad]
        return found

    def _apart(self) -> Iterator[tuple[str, Rules]]:
        """Each rule but the guards by itself, and what it is called."""
        if self.max_changes is not None:
            yield f"max_changes {self.max_changes}", Rules(max_changes=self.max_changes)
        for one, other in self.forbidden:
            yield f"forbidden {one} to {other}", Rules(forbidden=[(one, other)])
        for name, steps in self.dwell.items():
            yield f"dwell of {name}", Rules(dwell={name: steps})

    def barred(
        self, modes: ModeSet, entered: NDArray[np.bool_], chosen: NDArray[np.integer], x: Tensor, k: int
    ) -> Tensor | None:
        """Which worlds enter a mode whose guard says no, (n,) bool where x is; None where no guard is asked.

        Args:
            modes: what the indices mean.
            entered: whether a world enters its mode at this step, (n,).
            chosen: its mode, (n,).
            x: its state, (n, nx).
            k: control step.
        """
        bad = None
        for name, guard in self.guards.items():
            found = np.flatnonzero(entered & (chosen == modes.index(name)))
            if len(found) > 0:
                rows = upload(found, x.device)
                bad = torch.zeros(len(x), dtype=torch.bool, device=x.device) if bad is None else bad
                may = guard(x.index_select(0, rows), torch.full_like(rows, k))
                if not isinstance(may, Tensor) or may.dtype != torch.bool or may.shape != rows.shape:
                    got = f"{may.dtype} {tuple(may.shape)}" if isinstance(may, Tensor) else repr(may)
                    raise ValueError(
                        f"rules.guards of mode {name!r}: expected a tensor of bool, ({len(rows)},), got {got}"
                    )
                bad[rows] = ~may
        return bad


def _whole(number: float, least: int) -> bool:
    """Whether it is a whole number, `least` or more."""
    return number >= least and float(number).is_integer()
