"""The CPU engine: C MuJoCo, many worlds on a thread pool."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray
from torch import Tensor

from hmc.sim.check import check, check_latency
from hmc.sim.ids import Ids, where

_STATE = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)


class MujocoSim:
    """W worlds of one MuJoCo model on `mujoco.batch.Batch`; see `hmc.sim.base.Sim`.

    x is qpos then qvel, u is ctrl, both float64. A snapshot row is the engine's whole integration state
    (time, qpos, qvel, actuator states, warm start, ctrl), so a loaded copy steps bit-identically to its
    original at any thread count.

    Args:
        model: compiled model; its autoreset flag must be off, so that a diverged world stays visible.
        num_worlds: number of worlds W.
        substeps: physics steps a control step.
        threads: threads that step worlds, the caller's included; 0 for all cores.
        latency: physics steps of a control step in which the input before it still acts; one of all worlds
            or one of each.
        models: a model of each world, compiled from the same file as `model` with other values; None for
            `model` in all of them.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        *,
        substeps: int = 4,
        threads: int = 0,
        latency: int | Sequence[int] = 0,
        models: Sequence[mujoco.MjModel] | None = None,
    ):
        if num_worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {num_worlds}")
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, got {substeps}")
        late = check_latency(latency, num_worlds, substeps)
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET:
            raise ValueError(
                "the model resets diverged worlds by itself, which would hide them from the planner: "
                'set <option><flag autoreset="disable"/></option>'
            )
        # diverged worlds are the caller's to report; MuJoCo's own line per substep and world is not
        mujoco.set_mju_user_warning(_quiet)
        self.model = model
        self.batch = Batch(model, num_worlds, threads)
        if models is not None:
            self.batch.set_models(list(models))
        self._substeps, self._late = substeps, np.array(late)
        # a control step's stretches: after so many physics steps, the inputs that arrive then begin to act
        self._arrivals = sorted({0, *late})
        # read and written in numpy: for few worlds a torch operation takes several times as long
        self._row = self.batch.state
        self._x = self._row[:, 1 : 1 + self.nx]  # a row begins with time, qpos, qvel
        self._ctrl = self.batch.bind("ctrl")
        self._force = self.batch.bind("actuator_force")  # filled by steps after the bind, so bind now
        self._fresh = self._row[0].copy()
        self._each = np.arange(num_worlds, dtype=np.int32)

    @property
    def num_worlds(self) -> int:
        return self.batch.nsim

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
        return torch.device("cpu")

    @property
    def dtype(self) -> torch.dtype:
        return torch.float64

    def x(self, ids: Ids = None) -> Tensor:
        return _copied(self._x, ids)

    def u(self, ids: Ids = None) -> Tensor:
        return _copied(self._ctrl, ids)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        at = _where(ids)
        self._row[at], self._x[at], self._ctrl[at] = self._fresh, x.numpy(), u.numpy()

    def step(self, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, u=(u, self.nu))
        at, given = _where(ids), u.numpy()
        # the engine takes indices in ascending order only
        order = None if ids is None else self._each[at] if isinstance(at, slice) else np.sort(at)
        if len(self._arrivals) == 1:
            self._ctrl[at] = given
            self.batch.step(order, nstep=self._substeps)
            return
        late, before = self._late[at, None], self._ctrl[at].copy()
        for begin, end in pairwise([*self._arrivals, self._substeps]):
            self._ctrl[at] = np.where(late <= begin, given, before)
            if end > begin:
                self.batch.step(order, nstep=end - begin)

    def rollout(self, controls: Tensor, ids: Tensor) -> Tensor:
        """States after each control step under given inputs, as `hmc.sim.base.rollout`, in one call."""
        check(self.num_worlds, ids, controls=(controls[:, 0], self.nu))
        at, given = ids.numpy(), controls.numpy()
        order = at.argsort()  # the engine takes indices in ascending order only
        at, held = at[order], given[order].repeat(self._substeps, 1).astype(np.float64, copy=False)
        if len(self._arrivals) > 1:
            # what each physics step sees: the input from before it, `late` physics steps ago
            held = np.concatenate([self._ctrl[at][:, None], held], 1)
            seen = (np.arange(1, held.shape[1]) - self._late[at, None]).clip(min=0)
            held = held[np.arange(len(at))[:, None], seen]
        warned = self.batch.warning[at]
        states = self.batch.rollout(held.shape[1], held, record=(_STATE,), ids=at)[_STATE]
        # a world that the engine warned of and gave up repeats its last state, although it moves there
        for row in np.flatnonzero((self.batch.warning[at] != warned).any((1, 2))):
            now, then = states[row, 1:], states[row, :-1]
            now[(now == then).all(1) & (now[:, self.model.nq :] != 0).any(1)] = np.nan
        if len(self._arrivals) > 1:
            self._ctrl[ids.numpy()] = given[:, -1]
        found = states[:, self._substeps - 1 :: self._substeps]
        return torch.from_numpy(found if (order[1:] > order[:-1]).all() else found[order.argsort()])

    def save(self, ids: Ids = None) -> Tensor:
        return _copied(self._row, ids)

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, rows=(rows, self._row.shape[1]))
        self._row[_where(ids)] = rows.numpy()

    def actuator_force(self, ids: Ids = None) -> Tensor:
        """Joint torque in the last substep [N m], (n, nu): what a motor's current sensor sees."""
        return torch.tensor(self._force)[where(ids)]


def _where(ids: Ids) -> NDArray[np.int64] | slice:
    """What indexes an array of numpy's with a row a world."""
    return ids.numpy() if isinstance(ids, Tensor) else slice(None) if ids is None else ids


def _copied(buffer: NDArray[np.float64], ids: Ids) -> Tensor:
    """A copy of what `buffer` holds for worlds `ids`."""
    rows = buffer[_where(ids)]
    return torch.from_numpy(rows if isinstance(ids, Tensor) else rows.copy())


def _quiet(message: str) -> None:
    del message
