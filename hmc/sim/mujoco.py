"""The CPU engine: C MuJoCo, many worlds on a thread pool."""

from __future__ import annotations

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

from hmc.sim.check import check
from hmc.sim.ids import Ids, fresh, where


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
        latency: physics steps of a control step in which the input before it still acts.
    """

    def __init__(
        self, model: mujoco.MjModel, num_worlds: int, *, substeps: int = 4, threads: int = 0, latency: int = 0
    ):
        if num_worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {num_worlds}")
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, got {substeps}")
        if not 0 <= latency <= substeps:
            raise ValueError(f"latency must be 0 to {substeps} physics steps, a control step, got {latency}")
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET:
            raise ValueError(
                "the model resets diverged worlds by itself, which would hide them from the planner: "
                'set <option><flag autoreset="disable"/></option>'
            )
        # diverged worlds are the caller's to report; MuJoCo's own line per substep and world is not
        mujoco.set_mju_user_warning(_quiet)
        self.model = model
        self.batch = Batch(model, num_worlds, threads)
        self._substeps, self._latency = substeps, latency
        self._row = torch.from_numpy(self.batch.state)
        self._qpos = torch.from_numpy(self.batch.bind("qpos"))
        self._qvel = torch.from_numpy(self.batch.bind("qvel"))
        self._ctrl = torch.from_numpy(self.batch.bind("ctrl"))
        self._force = self.batch.bind("actuator_force")  # filled by steps after the bind, so bind now
        self._fresh = self._row[0].clone()
        self._all = torch.arange(num_worlds)

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
        return torch.cat([self._qpos[where(ids)], self._qvel[where(ids)]], dim=1)

    def u(self, ids: Ids = None) -> Tensor:
        return fresh(self._ctrl, ids)

    def reset(self, x: Tensor, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, x=(x, self.nx), u=(u, self.nu))
        ids = where(ids)
        self._row[ids] = self._fresh
        self._qpos[ids] = x[:, : self.model.nq].to(torch.float64)
        self._qvel[ids] = x[:, self.model.nq :].to(torch.float64)
        self._ctrl[ids] = u.to(torch.float64)

    def step(self, u: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, u=(u, self.nu))
        index = self._all[ids] if isinstance(ids, slice) else ids
        # the engine takes indices in ascending order only
        order = None if index is None else index.sort().values.numpy()
        if self._latency > 0:
            self.batch.step(order, nstep=self._latency)
        self._ctrl[where(ids)] = u.to(torch.float64)
        if self._latency < self._substeps:
            self.batch.step(order, nstep=self._substeps - self._latency)

    def rollout(self, controls: Tensor, ids: Tensor) -> Tensor:
        """States after each control step under given inputs, as `hmc.sim.base.rollout`, in one call."""
        check(self.num_worlds, ids, controls=(controls[:, 0], self.nu))
        order = ids.argsort()  # the engine takes indices in ascending order only
        held = controls[order].repeat_interleave(self._substeps, 1).to(torch.float64)
        steps, late = held.shape[1], self._latency
        if late > 0:
            before = self._ctrl[ids[order]][:, None].expand(-1, late, -1)
            held = torch.cat([before, held[:, : steps - late]], 1)
        found = self.batch.rollout(steps, held.numpy(), record=("qpos", "qvel"), ids=ids[order].numpy())
        x = torch.cat([torch.from_numpy(found[part]) for part in ("qpos", "qvel")], 2)
        # a world that the engine gave up repeats its last state, although it moves there
        stuck = (x[:, 1:] == x[:, :-1]).all(2) & (x[:, 1:, self.model.nq :] != 0).any(2)
        x[:, 1:][stuck] = torch.nan
        if late > 0:
            self._ctrl[ids] = controls[:, -1].to(torch.float64)
        return x[order.argsort(), self._substeps - 1 :: self._substeps]

    def save(self, ids: Ids = None) -> Tensor:
        return fresh(self._row, ids)

    def load(self, rows: Tensor, ids: Ids = None) -> None:
        check(self.num_worlds, ids, rows=(rows, self._row.shape[1]))
        self._row[where(ids)] = rows

    def actuator_force(self, ids: Ids = None) -> Tensor:
        """Joint torque in the last substep [N m], (n, nu): what a motor's current sensor sees."""
        return torch.tensor(self._force)[where(ids)]


def _quiet(message: str) -> None:
    del message
