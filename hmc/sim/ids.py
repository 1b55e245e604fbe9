"""Which worlds a call is about: a few by index, a stretch of them, or all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import torch
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


def blocks(ids: Tensor | slice, size: int) -> Tensor | slice:
    """The worlds of blocks of `size` side by side, of which `ids` are a few by index or a stretch."""
    if size == 1:
        return ids
    if isinstance(ids, slice):
        return slice(ids.start * size, ids.stop * size)
    return (ids[:, None] * size + torch.arange(size, device=ids.device)).flatten()


def fresh(buffer: Tensor, ids: Ids) -> Tensor:
    """A copy of what `buffer` holds for worlds `ids`, a row a world."""
    if isinstance(ids, Tensor):
        return buffer.index_select(0, ids)
    return buffer.clone() if ids is None else buffer[ids].clone()


def joined(parts: Sequence[Tensor]) -> Tensor:
    """The rows of all parts (n, ...), laid out as those are: by columns, if so."""
    if len(parts) == 1:
        return parts[0]
    return torch.cat([part.T for part in parts], 1).T if parts[0].stride(0) == 1 else torch.cat(list(parts))
