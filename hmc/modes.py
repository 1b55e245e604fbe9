"""Modes: anything that can be called to control the robot for a while."""

from __future__ import annotations

import difflib
import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from hmc.sim.base import Sim
from hmc.sim.device import constant


class Mode(ABC):
    """A controller, batched over worlds.

    A mode is a deterministic function of (x, u, memory, k): called again with the same arguments, in
    a batch of any size and order, it returns the same action. Random modes draw their noise from a
    counter keyed by a seed and k. Proposition 1 of the paper rests on that. Mind matrix products: torch
    may round a network's output differently in a batch of another size; onnxruntime was seen not to.

    What a mode remembers between steps is one row of ``memory_size`` numbers a world. It belongs to
    the rolled-out state: it is saved, restored and branched with it, and made anew by `reset` exactly
    where a schedule enters the mode.
    """

    name: str
    memory_size: int = 0
    control_steps: int = 0  # rolled out inside the mode so far: a planner counts them as its own
    sims: tuple[Sim, ...] = ()  # that it rolls out in: a planner tells of what did not fit there, too

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        """Memory at entry, (n, memory_size).

        Args:
            x: state on entry, (n, nx).
            u: input applied last, by whichever mode ran before, (n, nu).
            k: control step since the start of the task, (n,) long.
        """
        return torch.zeros(len(x), self.memory_size, dtype=x.dtype, device=x.device)

    @abstractmethod
    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        """Action for this control step, (n, nu), and the memory after it, (n, memory_size)."""

    def forget(self) -> None:  # noqa: B027
        """Drop what was kept from earlier calls for speed's sake.

        A search calls it first, so that what it spends does not depend on what ran before it.
        """


class ConstantInput(Mode):
    """The same input at every step, whatever the state.

    Args:
        name: of the mode.
        value: of each number of the input.
    """

    def __init__(self, name: str, value: float):
        self.name, self._value = name, value

    @property
    def value(self) -> float:
        """Of each number of the input; it stays, since a `ModeSet` looks it up once."""
        return self._value

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(u, self.value), memory


class Motion(Mode):
    """Plays inputs, one a control step since entry, and then holds the last one.

    Memory: the number of steps taken since entry.

    Args:
        name: of the mode.
        inputs: what it plays, (G, nu).
    """

    memory_size = 1

    def __init__(self, name: str, inputs: Tensor):
        if inputs.ndim != 2 or len(inputs) == 0 or not bool(inputs.isfinite().all()):
            raise ValueError(
                f"mode {name!r}: a motion is (G, nu) finite inputs, G >= 1, got shape {tuple(inputs.shape)}"
            )
        self.name, self.inputs = name, inputs

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        step = memory[:, 0].long().clamp(max=len(self.inputs) - 1)
        return constant(self.inputs, x)[step], memory + 1


class ModeSet:
    """An ordered set of modes; a schedule refers to them by index.

    Attributes:
        names: of the modes.
        memory_size: of the mode that remembers most.
        constants: where all modes are constant inputs, their values, (M,): who acts where need not be looked
            up then, world by world; None otherwise.
    """

    def __init__(self, modes: Sequence[Mode]):
        if not modes:
            raise ValueError("a mode set needs at least one mode, got none: pass ModeSet([mode, ...])")
        if classes := [mode.__name__ for mode in modes if isinstance(mode, type)]:
            raise ValueError(f"mode {classes[0]} is a class: pass an object of it, {classes[0]}(...)")
        names = [mode.name for mode in modes]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two modes are called {name!r}: names in a mode set must differ")
        self._modes = tuple(modes)
        self.names = tuple(names)
        self.memory_size = max(mode.memory_size for mode in modes)
        values = [mode.value for mode in modes if type(mode) is ConstantInput and math.isfinite(mode.value)]
        self.constants = np.array(values) if len(values) == len(modes) else None

    def __len__(self) -> int:
        return len(self._modes)

    def __iter__(self) -> Iterator[Mode]:
        return iter(self._modes)

    def __getitem__(self, name: str | int) -> Mode:
        return self._modes[self.index(name)]

    def index(self, name: str | int) -> int:
        """Index of the mode called `name`; an index is checked and comes back as it is."""
        if isinstance(name, str) and name in self.names:
            return self.names.index(name)
        if not isinstance(name, str) and 0 <= operator.index(name) < len(self):
            return operator.index(name)
        near = difflib.get_close_matches(str(name), self.names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise KeyError(f"unknown mode {name!r}: this set has {', '.join(self.names)}{hint}")
