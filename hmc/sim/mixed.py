"""Several simulators as one, for worlds of unlike models on engines that have one model in all of theirs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from hmc.sim.base import Sim
from hmc.sim.check import check
from hmc.sim.ids import Ids, count, where


class Mixed:
    """Worlds that each are one of a simulator of their kind; see `hmc.sim.base.Sim`.

    A call is one call of each simulator that has a world in it. Snapshot rows are as wide as the widest,
    and go into worlds of the kind that they are from.

    Args:
        make_sims: of each kind, number of worlds -> a simulator; they agree in nx, nu, dt, device and dtype.
        kinds: which kind each world is of, W numbers from 0 to the number of kinds - 1.

    Raises:
        ValueError: no world, a kind that is not there, or simulators that do not go together.
    """

    def __init__(self, make_sims: Sequence[Callable[[int], Sim]], kinds: Sequence[int]):
        if len(kinds) == 0 or not 0 <= min(kinds) <= max(kinds) < len(make_sims):
            raise ValueError(f"expected kinds of 0 to {len(make_sims) - 1}, one a world, got {list(kinds)}")
        used = sorted(set(kinds))
        self._sims = [make_sims[kind](list(kinds).count(kind)) for kind in used]
        first = self._sims[0]
        for name in ("nx", "nu", "dt", "device", "dtype"):
            values = [getattr(sim, name) for sim in self._sims]
            if any(value != values[0] for value in values):
                raise ValueError(f"simulators that are to be one must agree in {name}, got {values}")
        # of each world: which simulator it is in, and its place there
        self._sim = torch.tensor([used.index(kind) for kind in kinds], device=first.device)
        self._place = torch.zeros_like(self._sim)
        for i in range(len(used)):
            mine = self._sim == i
            self._place[mine] = torch.arange(int(mine.sum()), device=first.device)
        self._widths = [sim.save(slice(0, 1)).shape[1] for sim in self._sims]

    @property
    def num_worlds(self) -> int:
        return len(self._sim)

    @property
    def nx(self) -> int:
        return self._sims[0].nx

    @property
    def nu(self) -> int:
        return self._sims[0].nu

    @property
    def dt(self) -> float:
        return self._sims[0].dt

    @property
    def device(self) -> torch.device:
        return self._sims[0].device

    @property
    def dtype(self) -> torch.dtype:
        return self._sims[0].dtype

    def x(self, ids: Ids = None) -> Tensor:
        return self._gather(lambda sim, at: sim.x(at), self.nx, ids)

    def u(self, ids: Ids = None) -> Tensor:
        return self._gather(lambda sim, at: sim.u(at), self.nu, ids)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        for i, rows, at in self._parts(ids):
            self._sims[i].reset(x[rows], u[rows], at)

    def step(self, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, u=(u, self.nu))
        for i, rows, at in self._parts(ids):
            self._sims[i].step(u[rows], at)

    def save(self, ids: Ids = None) -> Tensor:
        return self._gather(lambda sim, at: sim.save(at), max(self._widths), ids)

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, rows=(rows, max(self._widths)))
        for i, mine, at in self._parts(ids):
            self._sims[i].load(rows[mine, : self._widths[i]], at)

    def overflow(self) -> dict[str, int]:
        """World-steps that were spoiled since the last call, in simulators that tell it, by what for."""
        lost: Counter[str] = Counter()
        for sim in self._sims:
            lost.update(getattr(sim, "overflow", dict)())
        return dict(lost)

    def _gather(self, read: Callable[[Sim, Tensor], Tensor], width: int, ids: Ids) -> Tensor:
        """What is read of worlds `ids`, (n, width), zero where a simulator has fewer columns."""
        out = torch.zeros(count(ids, self.num_worlds), width, dtype=self.dtype, device=self.device)
        for i, rows, at in self._parts(ids):
            part = read(self._sims[i], at)
            out[rows, : part.shape[1]] = part
        return out

    def _parts(self, ids: Ids) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Simulators that have some of worlds `ids`: which, rows (n,) of the call, and worlds (n,) there."""
        sim, place = self._sim[where(ids)], self._place[where(ids)]
        for i in range(len(self._sims)):
            rows = (sim == i).nonzero().squeeze(1)
            if len(rows) > 0:
                yield i, rows, place[rows]
