"""Where engine warp steps its worlds: batches on the device that rows go into, in recorded graphs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp
from torch import Tensor

from hmc.sim.cuda import Recorded

# A snapshot row: what decides how a world goes on, and the joint torques that brought it there.
FIELDS = (
    *("time", "qpos", "qvel", "act", "history", "plastic", "qacc_warmstart", "ctrl"),
    "actuator_force",
)

# Overflows that drop contacts or constraints; a solver at its iteration limit drops nothing, nor do sensors.
_FLAGS = mjw.OverflowType
LOSSES = {
    "constraints": _FLAGS.NEFC | _FLAGS.NJMAX_NNZ | _FLAGS.NVMAX,
    "contacts": _FLAGS.BROADPHASE | _FLAGS.NARROWPHASE | _FLAGS.CCD | _FLAGS.HFIELD | _FLAGS.EPA_HORIZON,
}


# What mypy passes over in kernels is Warp's language, whose types index and add otherwise than Python's.


@wp.kernel
def take(
    worlds: wp.array[wp.int64],
    count: wp.array[int],
    rows: wp.array2d[float],
    first: int,
    to: wp.array2d[float],
) -> None:
    """Fill a field from columns `first` on of the rows of worlds; slots beyond `count` copy slot 0, which
    costs less than strays would."""
    slot, i = wp.tid()  # type: ignore[misc]
    of = wp.where(slot < count[0], slot, 0)
    to[slot, i] = rows[int(worlds[of]), first + i]  # type: ignore[index]


@wp.kernel
def arrive(
    now: int,
    late: wp.array2d[float],
    inputs: wp.array2d[float],
    count: wp.array[int],
    ctrl: wp.array2d[float],
) -> None:
    """Let the inputs act whose latency is over by physics step `now`."""
    slot, i = wp.tid()  # type: ignore[misc]
    of = wp.where(slot < count[0], slot, 0)
    if late[slot, 0] <= float(now):  # type: ignore[index]
        ctrl[slot, i] = inputs[of, i]  # type: ignore[index]


@wp.kernel
def crowd(
    rows: wp.array[int],
    most_rows: int,
    pairs: wp.array[int],
    contacts: wp.array[int],
    most_contacts: int,
    overflow: wp.array[int],
) -> None:
    """Mark the worlds whose constraint rows or contacts did not fit, which mujoco_warp does where a step ends
    and not where a forward pass does."""
    slot = wp.tid()
    if rows[slot] > most_rows:
        overflow[slot] = overflow[slot] | wp.static(int(_FLAGS.NEFC))  # type: ignore[index]
    if wp.max(pairs[0], contacts[0]) > most_contacts:
        overflow[slot] = overflow[slot] | wp.static(int(_FLAGS.NARROWPHASE))  # type: ignore[index]


@wp.kernel
def lose(
    count: wp.array[int],
    overflow: wp.array[int],
    kinds: wp.array[int],
    every: int,
    one: wp.array2d[float],
    other: wp.array2d[float],
    lost: wp.array[wp.int64],
) -> None:
    """Count the worlds in which something did not fit, by kind; what is known of these becomes NaN."""
    slot = wp.tid()
    if slot >= count[0] or overflow[slot] & every == 0:
        return
    for kind in range(kinds.shape[0]):
        if overflow[slot] & kinds[kind] != 0:
            wp.atomic_add(lost, kind, wp.int64(1))  # type: ignore[call-overload]
    for i in range(one.shape[1]):  # type: ignore[attr-defined]
        one[slot, i] = wp.nan  # type: ignore[index]
    for i in range(other.shape[1]):  # type: ignore[attr-defined]
        other[slot, i] = wp.nan  # type: ignore[index]


@wp.kernel
def give(
    worlds: wp.array[wp.int64],
    count: wp.array[int],
    field: wp.array2d[float],
    first: int,
    to: wp.array2d[float],
) -> None:
    """Put a field into columns `first` on of the rows of worlds."""
    slot, i = wp.tid()  # type: ignore[misc]
    if slot < count[0]:
        to[int(worlds[slot]), first + i] = field[slot, i]  # type: ignore[index]


@wp.kernel
def add_forces(
    contacts: wp.array[int],
    world: wp.array[int],
    geoms: wp.array[wp.vec2i],
    force: wp.array[wp.spatial_vector],  # type: ignore[valid-type]
    found: wp.array2d[wp.vec3],
) -> None:
    """Add each contact's force to the geom that it pushes, and to the other one its opposite."""
    contact = wp.tid()
    if contact < contacts[0]:
        push = wp.spatial_top(force[contact])
        wp.atomic_add(found, world[contact], geoms[contact][1], push)  # type: ignore[call-overload]
        wp.atomic_sub(found, world[contact], geoms[contact][0], push)  # type: ignore[call-overload]


class Workspace:
    """A batch of worlds on the device that rows are copied into, stepped in, and copied out of.

    All that a control step does is one graph: to take the rows of the worlds that it is about, to step
    them, to find those that are lost, and to put the rows back. A forward pass is another, which puts
    nothing back.

    Args:
        params, data: model and arrays of mujoco_warp.
        rows: of all worlds of the simulator, (W, ns), in the order of FIELDS.
        own: what they have of their own, (W, no): the latency, then the fields `varied`.
        varied: names of the model's fields that differ from world to world.
        substeps: physics steps a control step.
        arrivals: physics steps that inputs begin to act at.
        lost: world-steps lost so far, of each kind of LOSSES, long; counted on the device.
        captured: whether graphs can be recorded.
    """

    def __init__(
        self,
        params: Any,
        data: Any,
        *,
        rows: Tensor,
        own: Tensor,
        varied: Sequence[str],
        substeps: int,
        arrivals: Sequence[int],
        lost: Tensor,
        captured: bool,
    ):
        self._params, self._data, self._captured = params, data, captured
        self._substeps, self._arrivals, self._device = substeps, arrivals, data.qpos.device
        self._rows, self._of_own, self._lost = (wp.from_torch(each) for each in (rows, own, lost))
        size = data.nworld
        with wp.ScopedDevice(self._device):
            self._losses: Any = wp.array([int(bits) for bits in LOSSES.values()], dtype=int)
            self._every = sum(map(int, LOSSES.values()))  # their bits are apart
            self._late = wp.zeros((size, 1), dtype=float)
            self._inputs = wp.zeros_like(data.ctrl)
            self._worlds, self._count = wp.zeros(size, dtype=wp.int64), wp.zeros(1, dtype=int)
        self._fields = fields(data, FIELDS)
        self._own = {"late": self._late, **fields(params, varied)}
        # what torch writes, on a stream of its own, and reads
        self._here, self._n, self._u = (
            wp.to_torch(each) for each in (self._worlds, self._count, self._inputs)
        )
        self._steps: Recorded | None = None
        self._looks: Recorded | None = None
        wp.synchronize_device(self._device)  # Warp filled these on a stream of its own

    def step(self, ids: Tensor, u: Tensor) -> None:
        """One control step of worlds (n,) with inputs (n, nu)."""
        if self._steps is None:
            self._steps = self._recorded(self._control_step)
        self._choose(ids)
        self._u[: len(ids)] = u
        self._steps()

    def contact_forces(self, ids: Tensor) -> Tensor:
        """Net contact force on each geom of worlds (n,) as they are [N], (n, ngeom, 3)."""
        if self._looks is None:
            data, ngeom = self._data, self._params.ngeom
            with wp.ScopedDevice(self._device):
                self._forces = wp.zeros((data.nworld, ngeom), dtype=wp.vec3)
                self._contacts: Any = wp.array(np.arange(data.naconmax, dtype=np.int32))
                self._wrenches = wp.zeros(data.naconmax, dtype=wp.spatial_vector)
            self._found = wp.to_torch(self._forces)
            self._looks = self._recorded(self._forward)
        self._choose(ids)
        self._looks()
        return self._found[: len(ids)].clone()

    def _recorded(self, work: Any) -> Recorded:
        self._n.zero_()  # to record it changes no world
        return Recorded(work, self._device, self._captured)

    def _choose(self, ids: Tensor) -> None:
        """The next graph is about these worlds."""
        self._here[: len(ids)] = ids
        self._n.fill_(len(ids))

    def _control_step(self) -> None:
        with wp.ScopedDevice(self._device):
            self._take()
            for i in range(self._substeps):
                if i in self._arrivals:
                    self._arrive(i)
                mjw.step(self._params, self._data)
            self._arrive(self._substeps)  # what comes only with the next step is the last input all the same
            self._lose(self._data.qpos, self._data.qvel)
            begin = 0
            for field in self._fields.values():
                inputs = [self._worlds, self._count, field, begin, self._rows]
                wp.launch(give, field.shape, inputs=inputs)
                begin += field.shape[1]

    def _forward(self) -> None:
        data = self._data
        with wp.ScopedDevice(self._device):
            self._take()
            mjw.forward(self._params, data)
            found = [data.nefc, data.njmax, data.ncollision, data.nacon, data.naconmax, data.overflow]
            wp.launch(crowd, data.nworld, inputs=found)
            self._forces.zero_()
            mjw.contact_force(self._params, data, self._contacts, True, self._wrenches)
            contact = data.contact
            inputs = [data.nacon, contact.worldid, contact.geom, self._wrenches, self._forces]
            wp.launch(add_forces, data.naconmax, inputs=inputs)
            forces = flat(self._forces)
            self._lose(forces, forces)

    def _take(self) -> None:
        for rows, found in ((self._rows, self._fields), (self._of_own, self._own)):
            begin = 0
            for field in found.values():
                wp.launch(take, field.shape, inputs=[self._worlds, self._count, rows, begin, field])
                begin += field.shape[1]
        self._data.overflow.zero_()

    def _arrive(self, i: int) -> None:
        ctrl = self._data.ctrl
        wp.launch(arrive, ctrl.shape, inputs=[i, self._late, self._inputs, self._count, ctrl])

    def _lose(self, one: Any, other: Any) -> None:
        flags = self._data.overflow
        inputs = [self._count, flags, self._losses, self._every, one, other, self._lost]
        wp.launch(lose, len(flags), inputs=inputs)


def fields(structure: Any, names: Sequence[str]) -> dict[str, Any]:
    """Arrays of a mujoco_warp structure with a row of numbers a world, (size, k) each."""
    return {name: flat(getattr(structure, name)) for name in names}


def flat(array: Any) -> Any:
    """The same memory as floats, (rows, k)."""
    return wp.from_torch(wp.to_torch(array).view(array.shape[0], -1))


def slices(widths: dict[str, int]) -> dict[str, slice]:
    """Where the columns of each are when they lie side by side."""
    ends = list(accumulate(widths.values()))
    return {name: slice(begin, end) for name, begin, end in zip(widths, [0, *ends], ends, strict=False)}
