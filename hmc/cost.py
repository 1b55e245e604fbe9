"""Costs as named terms, so that a total can always be taken apart again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

StageFn = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
TerminalFn = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Cost:
    r"""J = sum_k l(x_k, u_k, k) dt + c_f(x_T, T), with l the sum of named terms.

    Attributes:
        stage: name -> f(x, u, u_prev, k) -> (n,), each already weighted; x (n, nx) is the state at the
            start of the step, u (n, nu) the input applied during it, u_prev (n, nu) the one before,
            k (n,) the control step since the start of the task (targets may depend on it).
        terminal: name -> f(x, k) -> (n,).
        nonnegative: whether every term is >= 0 everywhere, which lets the planner stop a rollout as
            soon as its partial cost exceeds the best one known.
        on_cpu: the stage terms in order of `stage`, (n, number of stage terms), in one call: the same numbers
            to the bit in less time, from float64 on the CPU, without derivatives; None: they are asked for
            one after the other.
    """

    stage: Mapping[str, StageFn]
    terminal: Mapping[str, TerminalFn] = field(default_factory=dict)
    nonnegative: bool = False
    on_cpu: StageFn | None = None

    def __post_init__(self) -> None:
        if not self.stage and not self.terminal:
            raise ValueError("a cost needs at least one term, got none: pass stage= or terminal=")
        for name in self.stage:
            if name in self.terminal:
                raise ValueError(f"a stage and a terminal term are both called {name!r}: names must differ")

    def stage_terms(self, x: Tensor, u: Tensor, u_prev: Tensor, k: Tensor) -> Tensor:
        """Stage terms in order of `stage`, (n, number of stage terms)."""
        if not self.stage:
            return x.new_zeros(len(x), 0)
        if self.on_cpu is not None and x.device.type == "cpu" and x.dtype == torch.float64:
            return checked("cost on_cpu", self.on_cpu(x, u, u_prev, k), (len(x), len(self.stage)))
        return torch.stack([_term(name, f(x, u, u_prev, k), x) for name, f in self.stage.items()]).T

    def terminal_terms(self, x: Tensor, k: Tensor) -> Tensor:
        """Terminal terms in order of `terminal`, (n, number of terminal terms)."""
        if not self.terminal:
            return x.new_zeros(len(x), 0)
        return torch.stack([_term(name, f(x, k), x) for name, f in self.terminal.items()]).T

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all terms, stage terms first."""
        return (*self.stage, *self.terminal)


def _term(name: str, found: Tensor, x: Tensor) -> Tensor:
    return checked(f"cost term {name!r}", found, (len(x),))


def checked(what: str, found: Tensor, shape: tuple[int, ...]) -> Tensor:
    """What a user's function made of n states, if it is of the shape that is asked for."""
    if not isinstance(found, Tensor) or found.shape != shape:
        got = tuple(found.shape) if isinstance(found, Tensor) else repr(found)
        raise ValueError(f"{what}: expected a tensor of shape {shape} for {shape[0]} states, got {got}")
    return found


def total(terms: Tensor) -> Tensor:
    """Sum over terms (n, number of terms) -> (n,), in one fixed order whatever n is.

    Every addend enters by one monotone rounding, so that with terms >= 0 a partial cost never exceeds
    the final one: pruning by it is exact, in floating point too.
    """
    if terms.device.type == "cpu" and terms.dtype == torch.float64 and not terms.requires_grad:
        return torch.from_numpy(total_by_term(terms.numpy().T))
    cost = terms.new_zeros(len(terms))
    for column in terms.unbind(1):
        cost = cost + column
    return cost


def total_by_term(terms: NDArray[np.float64]) -> NDArray[np.float64]:
    """`total` of terms (number of terms, n), (n,): to the bit, which numpy's own sum is not."""
    if len(terms) == 0:
        return np.zeros(terms.shape[1])
    cost: NDArray[np.float64] = terms[0] + 0.0  # a sum that begins with 0 is never -0
    for term in terms[1:]:
        cost += term
    return cost
