"""What the worlds of a rollout cost so far, found out for several control steps at a time."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import torch
from torch import Tensor

from hmc.sim.device import upload
from hmc.sim.ids import joined
from hmc.task import Task
from hmc.trace import Floats, Recorder
from hmc.worlds import Indices, finite


class Account:
    """Sums of stage terms, one a world: a call for few worlds takes as long as one for many, so that steps
    wait until several of them are priced together. Worlds lie side by side, those born last at the end.

    Args:
        task: whose cost it is.
        worlds: most that there ever are.
        dt: duration of a control step [s].
        recorder: that what steps cost is told to; None for none.
        judge: whether a step whose states or inputs are no numbers is to cost NaN, whatever the cost says.
        near: whether one may look at a number without waiting for a device.

    Attributes:
        sums: stage terms of the steps that are priced, (number of stage terms, worlds).
    """

    def __init__(
        self, task: Task, worlds: int, dt: float, recorder: Recorder | None, judge: bool, near: bool
    ):
        self.sums = np.empty((len(task.cost.stage), worlds))
        self._cost, self._dt, self._recorder, self._judge = task.cost, dt, recorder, judge
        self._near = near
        self._priced = 0  # steps
        # of those after them which one it is, who made it, x, u and u before; and after how many steps worlds
        # were born
        self._steps: list[tuple[int, Indices | slice, Tensor, Tensor, Tensor]] = []
        self._births: deque[tuple[int, slice, Indices]] = deque()

    def __len__(self) -> int:
        """Steps that are not priced yet."""
        return len(self._steps)

    def step(self, i: int, branches: Indices | slice, x: Tensor, u: Tensor, u_prev: Tensor) -> None:
        """Take down step i of these branches, one or more worlds each: states (n, nx), inputs (n, nu)."""
        self._steps.append((i, branches, x, u, u_prev))

    def born(self, children: slice, parents: Indices) -> None:
        """Worlds go on from what others cost so far."""
        self._births.append((self._priced + len(self), children, parents))
        self._inherit()

    def costs(self, first: int) -> Tensor:
        """Stage terms of the steps that are not priced yet, (m, number of stage terms), on the device.

        Args:
            first: control step of the rollout's step 0.
        """
        widths = [len(x) for _, _, x, _, _ in self._steps]
        x, u, u_prev = map(joined, zip(*[step[2:] for step in self._steps], strict=True))
        ks = upload(np.array([first + step[0] for step in self._steps]).repeat(widths), x.device)
        found = self._cost.stage_terms(x, u, u_prev, ks).to(torch.float64)
        # a finite sum has finite parts
        if not self._judge or (self._near and math.isfinite(float(x.sum()) + float(u.sum()))):
            return found
        return found.masked_fill(~(finite(x) & finite(u))[:, None], math.nan)

    def settle(self, costs: Floats) -> None:
        """Add what `costs` came to."""
        terms, done = costs.T * self._dt, 0  # not in place: a cost may keep what it gave
        steps, self._steps = self._steps, []
        for i, branches, x, _, _ in steps:
            stage = terms[:, done : done + len(x)]
            done += len(x)
            sums = self.sums[:, : len(x)]
            sums += stage
            if self._recorder is not None:
                self._recorder.step(i, branches, stage)
            self._priced += 1
            self._inherit()

    def keep(self, worlds: Indices) -> None:
        """Only these go on."""
        self.sums[:, : len(worlds)] = self.sums.take(worlds, 1)

    def _inherit(self) -> None:
        """Give worlds the sums of those that they were born from, where these are known by now."""
        while self._births and self._births[0][0] == self._priced:
            _, children, parents = self._births.popleft()
            self.sums[:, children] = self.sums.take(parents, 1)
