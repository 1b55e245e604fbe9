"""Which worlds a call is about: a few by index, a stretch of them, or all."""

from __future__ import annotations

from typing import TypeAlias

from torch import Tensor

# distinct world indices (n,), long; a slice; None for all worlds in order
Ids: TypeAlias = Tensor | slice | None


def where(ids: Ids) -> Tensor | slice:
    """What indexes an array with a row a world."""
    return slice(None) if ids is None else ids


def count(ids: Ids, worlds: int) -> int:
    """How many of `worlds` worlds they are."""
    if ids is None:
        return worlds
    return len(range(worlds)[ids]) if isinstance(ids, slice) else len(ids)


def fresh(buffer: Tensor, ids: Ids, dim: int = 0) -> Tensor:
    """A copy of what `buffer` holds for worlds `ids`, which it has along `dim`, 0 or 1."""
    if isinstance(ids, Tensor):
        return buffer.index_select(dim, ids)
    return (buffer[where(ids)] if dim == 0 else buffer[:, where(ids)]).clone()
