"""The GPU engine: MuJoCo Warp, thousands of worlds in captured graphs; its CPU device for parity."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from typing import Any

import mujoco
import torch
import warp as wp
from torch import Tensor

from hmc.sim.check import check, check_latency
from hmc.sim.cuda import Recorded, check_memory, graphs, num_bytes
from hmc.sim.device import find_device
from hmc.sim.ids import Ids, count, fresh, where
from hmc.sim.variety import own_values

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # not one line a compiled kernel

import mujoco_warp as mjw  # noqa: E402

from hmc.sim.workspace import FIELDS, LOSSES, Workspace, fields, slices  # noqa: E402

# Most contacts that one pair of geoms can make; any pair that is not listed makes at most 8.
PLANE, SPHERE, CAPSULE, BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "SPHERE", "CAPSULE", "BOX")
)
PAIR_CONTACTS = {
    (PLANE, SPHERE): 1,
    (PLANE, CAPSULE): 2,
    (SPHERE, SPHERE): 1,
    (SPHERE, CAPSULE): 1,
    (SPHERE, BOX): 1,
    (CAPSULE, CAPSULE): 2,
    (CAPSULE, BOX): 2,
}
MAX_CONTACTS = 128  # a world; more than that is sized by hand


@wp.kernel
def begin(flags: wp.array[bool], start: wp.array2d[float], rows: wp.array2d[float]) -> None:
    """Put the worlds that are flagged at their start."""
    world, i = wp.tid()  # type: ignore[misc]
    if flags[world]:
        rows[world, i] = start[world, i]  # type: ignore[index]


class WarpSim:
    """W worlds of a MuJoCo model on `mujoco_warp`; see `hmc.sim.base.Sim`.

    x is qpos then qvel, u is ctrl, all float32 on `device`. Worlds live as rows of one torch tensor, so
    that save, load and reset are indexing on the device. A step is one captured graph that copies the rows
    it is about into a workspace, runs the substeps there and copies them back; 82 floats a
    world for the Go2, against some 30,000 that a substep touches. A step of n of the W worlds uses the
    smallest workspace that holds n, one of W, W/2, W/4, ... worlds (made at first use), so that it costs
    at most twice the step of n worlds, and all workspaces together at most twice the memory.

    Nothing in step, save, load, reset, x, u waits for the device, but the first step in a workspace, which
    is recorded.

    A world whose contacts or constraints do not fit is no longer physics: its state becomes NaN, as if
    it had diverged, and `overflow` counts it. Contacts are pooled: where they do not fit, some are missing
    in nobody knows which of the worlds that step together, and all of these are lost. The default sizes hold
    every contact that the geoms of the model can make at once, so that this happens only to sizes set by
    hand.

    The last bits of results on a GPU depend on the order in which threads finish; on Warp's CPU device they
    are the same in every run. That device is for parity tests: 4 to 5 times slower than one thread of the
    C engine, at any number of worlds.

    Attributes:
        contacts: room for contacts, per world but pooled over the worlds of a workspace.
        constraints: room for constraint rows of each world.

    Args:
        model: compiled model.
        num_worlds: number of worlds W.
        device: "cuda", "cuda:1", "cpu", or a torch device.
        substeps: physics steps a control step.
        contacts: None for all that the geoms can make at once.
        constraints: None for what so many contacts and all limits come to.
        deterministic: all that mujoco_warp has against that, slower; None for what torch is set to
            (`torch.use_deterministic_algorithms`). Version 4.0 sums up in a fixed order then, but does not
            sort contacts and constraint rows yet, so that a GPU's bits may differ still.
        latency: physics steps of a control step in which the input before it still acts; one of all worlds
            or one of each.
        models: a model of each world, which may differ from `model` in what `hmc.sim.variety.OWN` names;
            None for `model` in all of them.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        *,
        device: str | torch.device = "cuda",
        substeps: int = 4,
        contacts: int | None = None,
        constraints: int | None = None,
        deterministic: bool | None = None,
        latency: int | Sequence[int] = 0,
        models: Sequence[mujoco.MjModel] | None = None,
    ):
        if num_worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {num_worlds}")
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, got {substeps}")
        late = check_latency(latency, num_worlds, substeps)
        if models is not None and len(models) != num_worlds:
            raise ValueError(f"models must be one of each of the {num_worlds} worlds, got {len(models)}")
        self._device = find_device(device)
        wp.init()
        self._captured, loops = graphs(self._device)
        self._on_warp = wp.device_from_torch(self._device)
        self.model = copy.copy(model)
        # mujoco_warp never resets a diverged world, and refuses the flag that asks C MuJoCo not to
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._num_worlds, self._substeps = num_worlds, substeps
        with wp.ScopedDevice(self._on_warp), warnings.catch_warnings(action="ignore"):
            self._params = mjw.put_model(self.model)  # its warning about drivers is several lines long
        self._params.opt.warn_overflow = 0  # counted below instead of printed by the device
        self._params.opt.graph_conditional = loops
        if deterministic is None:
            deterministic = torch.are_deterministic_algorithms_enabled()
        if deterministic and self._device.type == "cuda":
            self._params.opt.deterministic = mjw.DeterminismType.ALL
        most = most_contacts(model, self._params.nxn_geom_pair_filtered.numpy())
        self.contacts = most if contacts is None else contacts
        self.constraints = most_constraints(model, self.contacts) if constraints is None else constraints
        # what a world has of its own besides its state: columns that go into a workspace with it
        own = {} if models is None else own_values(model, models)
        self._varied = tuple(own)
        columns = [torch.tensor(late)[:, None], *map(torch.from_numpy, own.values())]
        self._own = torch.cat([values.flatten(1).float() for values in columns], 1).to(self._device)
        self._arrivals = sorted({0, *late} - {substeps})  # physics steps that inputs come at
        self._one = self._data(1)  # a world's arrays, to see what so many take
        check_memory(self._one, num_worlds, self._device)
        wp.synchronize_device(self._on_warp)  # filled on a stream of Warp's, read on torch's
        first = fields(self._one, FIELDS)
        self._slices = slices({name: field.shape[1] for name, field in first.items()})
        self._moving = slice(self._slices["qpos"].start, self._slices["qvel"].stop)
        self._fresh = torch.cat([wp.to_torch(field) for field in first.values()], 1)
        self._rows = self._fresh.repeat(num_worlds, 1)
        self._lost = torch.zeros(len(LOSSES), dtype=torch.long, device=self._device)
        self._all = torch.arange(num_worlds, device=self._device)
        self._begin: Recorded | None = None
        self._spaces: dict[int, Workspace] = {}
        self._space(num_worlds)

    @property
    def num_worlds(self) -> int:
        return self._num_worlds

    @property
    def world_bytes(self) -> int:
        """What a world takes on the device when all workspaces are made."""
        return 2 * num_bytes(self._one) + self._rows[0].nbytes + self._own[0].nbytes

    @property
    def nx(self) -> int:
        return self.model.nq + self.model.nv

    @property
    def nu(self) -> int:
        return self.model.nu

    @property
    def dt(self) -> float:
        return self.model.opt.timestep * self._substeps

    @property
    def device(self) -> torch.device:
        return self._device

    @property
    def dtype(self) -> torch.dtype:
        return torch.float32

    def x(self, ids: Ids = None) -> Tensor:
        return fresh(self._rows[:, self._moving], ids)

    def u(self, ids: Ids = None) -> Tensor:
        return fresh(self._rows[:, self._slices["ctrl"]], ids)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        check(self._num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        rows = self._fresh.repeat(len(x), 1)
        self._begin_at(rows, x, u)
        self.load(rows, ids)

    def reset_flagged(self, flags: Tensor, x: Tensor, u: Tensor) -> None:
        """Put the worlds that are flagged, of flags (W,) bool, at their states of x (W, nx) with last inputs
        u (W, nu), as `reset` does; the others go on. One graph, however many they are."""
        check(self._num_worlds, None, x=(x, self.nx), u=(u, self.nu))
        if self._begin is None:
            self._flags = torch.zeros(self._num_worlds, dtype=torch.bool, device=self._device)
            self._start = self._fresh.repeat(self._num_worlds, 1)
            arrays = [wp.from_torch(each) for each in (self._flags, self._start, self._rows)]
            shape = tuple(self._rows.shape)
            self._begin = Recorded(
                lambda: wp.launch(begin, shape, inputs=arrays, device=self._on_warp),
                self._on_warp,
                self._captured,
            )
        self._flags.copy_(flags)
        self._begin_at(self._start, x, u)
        self._begin()

    def save(self, ids: Ids = None) -> Tensor:
        return fresh(self._rows, ids)

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        check(self._num_worlds, ids, rows=(rows, self._rows.shape[1]))
        self._rows[where(ids)] = rows

    def step(self, u: Tensor, ids: Ids = None) -> None:
        check(self._num_worlds, ids, u=(u, self.nu))
        if len(u) > 0:
            self._space(self._size(len(u))).step(self._worlds(ids), u)

    def actuator_force(self, ids: Ids = None) -> Tensor:
        """Joint torque in the last substep [N m], (n, nu): what a motor's current sensor sees; 0 after a
        reset, its parent's in a branch."""
        return fresh(self._rows[:, self._slices["actuator_force"]], ids)

    def contact_forces(self, ids: Ids = None) -> Tensor:
        """Net force of all contacts on each geom [N], (n, ngeom, 3), in world axes.

        Of the worlds as they are, with their last input: right after a reset or a load, too. It takes a
        forward pass, a graph of its own, that changes nothing of a world. NaN where contacts or constraints
        do not fit, which `overflow` counts.
        """
        n = count(ids, self._num_worlds)
        if n == 0:
            return torch.zeros(0, self.model.ngeom, 3, device=self._device)
        return self._space(self._size(n)).contact_forces(self._worlds(ids))

    def overflow(self) -> dict[str, int]:
        """World-steps spoiled since the last call because contacts or constraints did not fit.

        Waits for the device. Any count above 0 means: give `contacts` or `constraints` more room.
        """
        counts = dict(zip(LOSSES, self._lost.tolist(), strict=True))
        self._lost.zero_()
        return counts

    def _size(self, n: int) -> int:
        """Worlds of the smallest workspace for n worlds."""
        # below some hundred worlds a GPU takes the same time, and each size is a graph to capture
        floor = 256 if self._device.type == "cuda" else 1
        size = self._num_worlds
        while size > 1 and (size + 1) // 2 >= max(n, floor):
            size = (size + 1) // 2
        return size

    def _worlds(self, ids: Ids) -> Tensor:
        """Their indices, (n,)."""
        return ids if isinstance(ids, Tensor) else self._all[where(ids)]

    def _begin_at(self, rows: Tensor, x: Tensor, u: Tensor) -> None:
        """Write states and inputs into fresh rows."""
        rows[:, self._moving] = x.to(rows)
        rows[:, self._slices["ctrl"]] = u.to(rows)

    def _data(self, size: int) -> Any:
        """Arrays of so many worlds."""
        with wp.ScopedDevice(self._on_warp):
            return mjw.make_data(self.model, nworld=size, nconmax=self.contacts, njmax=self.constraints)

    def _space(self, size: int) -> Workspace:
        if size not in self._spaces:
            check_memory(self._one, size, self._device)
            with wp.ScopedDevice(self._on_warp):
                params = with_fields(self._params, self._varied, size)
            self._spaces[size] = Workspace(
                params,
                self._data(size),
                rows=self._rows,
                own=self._own,
                varied=self._varied,
                substeps=self._substeps,
                arrivals=self._arrivals,
                lost=self._lost,
                captured=self._captured,
            )
        return self._spaces[size]


def with_fields(params: Any, names: Sequence[str], worlds: int) -> Any:
    """A model on the device in which every world has these values of its own; all others are shared."""
    params = copy.copy(params)
    for name in names:
        shared = getattr(params, name)
        field = wp.zeros((worlds, *shared.shape[1:]), dtype=shared.dtype)
        field._is_batched = True  # as mujoco_warp marks those that it makes
        setattr(params, name, field)
    return params


def most_contacts(model: mujoco.MjModel, pairs: Any) -> int:
    """Contacts that all pairs of geoms (p, 2) can make at once in one world, at least 1."""
    most = 0
    for pair in pairs:
        low, high = sorted(int(model.geom_type[geom]) for geom in pair)
        most += PAIR_CONTACTS.get((low, high), 8)
    return max(1, min(most, MAX_CONTACTS))


def most_constraints(model: mujoco.MjModel, contacts: int) -> int:
    """Constraint rows of one world with that many contacts, at least 1."""
    dim = int(model.geom_condim.max(initial=1))
    pyramid = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    rows = max(1, 2 * (dim - 1)) if pyramid else dim
    friction = int((model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum())
    limits = int(model.jnt_limited.sum() + 2 * model.tendon_limited.sum())
    equalities = 6 * model.neq
    return max(1, contacts * rows + friction + 2 * limits + equalities)
