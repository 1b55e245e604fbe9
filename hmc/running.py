"""A robot's running mode between control steps: which one, for how long, and what it remembers."""

from __future__ import annotations

import torch
from torch import Tensor

from hmc.modes import ModeSet


class Running:
    """Executes modes one control step at a time; a mode keeps its memory as long as it runs.

    Attributes:
        mode: index of the mode that ran last; None before the first step.
        ran: control steps that it has been running; None before the first step.
        memory: what it remembers, (its memory_size,).
        u: input of the last step, (nu,).

    Args:
        modes: to choose from.
    """

    def __init__(self, modes: ModeSet):
        self.modes = modes
        self.mode: int | None = None
        self.ran: int | None = None
        self.memory: Tensor | None = None
        self.u: Tensor | None = None

    def act(self, mode: int, x: Tensor, u: Tensor, k: int) -> Tensor:
        """The input of a mode, which is entered first if it was not running, (nu,).

        Args:
            mode: index.
            x: state, (nx,).
            u: input applied last, (nu,).
            k: control step since the start of the task.
        """
        chosen = self.modes[mode]
        step = torch.tensor([k], device=x.device)
        if self.memory is None or mode != self.mode:
            ran, memory = 1, chosen.reset(x[None], u[None], step)
        else:
            ran, memory = (self.ran or 0) + 1, self.memory[None].clone()  # which a mode may change in place
        action, memory = chosen.act(x[None], u[None], memory, step)
        # copies: the mode may use its tensors again, for a planner's rollouts in between
        action, memory = (part[0].to(x.dtype, copy=True) for part in (action, memory))
        self.mode, self.ran, self.memory, self.u = mode, ran, memory, action  # or none, if the mode fails
        return action.clone()
