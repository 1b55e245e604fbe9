"""A device that is not the CPU, without one: tensors that say so, and refuse what a GPU would refuse."""

from __future__ import annotations

from collections import Counter
from typing import Any, Self

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

from hmc.sim.base import Sim
from hmc.sim.ids import Ids

THERE = torch.device("meta", 1)  # of all names that torch has for devices, one that needs none
# what makes the host wait for numbers of a GPU
WAITING = {"_local_scalar_dense", "nonzero", "_unique2", "unique_dim", "masked_select", "equal", "is_nonzero"}


class Far(Tensor):
    """A tensor that says that it is THERE; its numbers are in `near`, on the CPU."""

    near: Tensor

    @staticmethod
    def __new__(cls, near: Tensor) -> Far:
        return Tensor._make_wrapper_subclass(
            cls, near.size(), near.stride(), near.storage_offset(), dtype=near.dtype, device=THERE
        )

    def __init__(self, near: Tensor):
        self.near = near

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        raise AssertionError(f"{func} of what is far, outside of `Device`")


def near(values: Any) -> Any:
    """What is within."""
    return values.near if isinstance(values, Far) else values


class _Made(TorchFunctionMode):
    """Makes tensors of Python's numbers here and copies them there: torch does not show such copies."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") == THERE:
            del kwargs["device"]
            return func(*args, **kwargs).to(THERE)
        return func(*args, **kwargs)


class Device(TorchDispatchMode):
    """Computes on THERE, on the CPU in truth; errors for operands on two devices, counts what waits.

    Attributes:
        waits: by operation.
        uploads: copies from the host that do not wait.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self.uploads = 0
        self._made = _Made()

    def __enter__(self) -> Self:
        self._made.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._made.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = kwargs or {}, func.overloadpacket.__name__
        given = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        far = [each for each in given if isinstance(each, Far)]
        here = [each for each in given if not isinstance(each, Far)]
        assert all(each.device.type == "cpu" for each in here), f"{name}: made of numbers of the host"
        to = kwargs.get("device")
        stays = (to is None or to == THERE) if far else to == THERE
        if not far and not stays:
            return func(*args, **kwargs)
        if name in ("_to_copy", "copy_") and (here or not stays):
            free = stays and (kwargs.get("non_blocking") or args[2:] == (True,))
            self.uploads += bool(free)
            if not free:
                self.waits[name] += 1
            stays = stays if name == "_to_copy" else isinstance(args[0], Far)
        elif name in WAITING:
            self.waits[name] += 1
        elif name in ("index", "index_put_", "index_put", "_index_put_impl_"):
            picked = [each for each in args[1] if each is not None]
            if any(each.dtype == torch.bool or not isinstance(each, Far) for each in picked):
                self.waits["index by flags, or of the host"] += 1
            here = [each for each in here if all(each is not other for other in picked)]
        if name not in ("_to_copy", "copy_"):
            assert all(each.ndim == 0 for each in here), f"{name}: operands on two devices"
        inside = {key: "cpu" if key == "device" else value for key, value in kwargs.items()}
        out = func(*tree_map(near, args), **tree_map(near, inside))
        if stays:
            out = tree_map(lambda each: Far(each) if isinstance(each, Tensor) else each, out)
        return return_and_correct_aliasing(func, args, kwargs, out) if far and stays else out


class FarSim:
    """A simulator of the CPU whose tensors are THERE."""

    device = THERE

    def __init__(self, sim: Sim):
        self.sim = sim
        self.num_worlds, self.nx, self.nu, self.dt = sim.num_worlds, sim.nx, sim.nu, sim.dt
        self.dtype = sim.dtype

    def x(self, ids: Ids = None) -> Tensor:
        return Far(self.sim.x(self._near(ids)))

    def u(self, ids: Ids = None) -> Tensor:
        return Far(self.sim.u(self._near(ids)))

    def save(self, ids: Ids = None) -> Tensor:
        return Far(self.sim.save(self._near(ids)))

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        self.sim.reset(self._near(x), self._near(u), self._near(ids))

    def step(self, u: Tensor, ids: Ids = None) -> None:
        self.sim.step(self._near(u), self._near(ids))

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        self.sim.load(self._near(rows), self._near(ids))

    def _near(self, values: Any) -> Any:
        assert not isinstance(values, Tensor) or isinstance(values, Far), "of the host"
        return near(values)
