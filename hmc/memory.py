"""How many worlds a search has: as many as its batches want, or as fit into the memory of their device."""

from __future__ import annotations

from hmc.rollout import RECORDED
from hmc.sim.base import Sim
from hmc.sim.device import free_memory
from hmc.task import Task

# Of what a device has free: drivers and allocators want some of it, and steps priced at once some 10 MiB.
SHARE = 0.9
# Bytes that a step works with for a world: copies of its row, what its mode and its cost come to on the way.
# All that a policy of the Go2 and its cost ever make in a step is 29 KiB; other modes may take more.
WORKING = 64 * 1024


def make_worlds(task: Task, wanted: int, room: float | None = None) -> Sim:
    """A simulator to plan in, of `wanted` worlds, or of as many as fit.

    A batch that does not fit is rolled out in parts, at the same costs.

    Args:
        task: what to plan.
        wanted: worlds that the largest batch takes.
        room: bytes that they may take; None for nine tenths of what the device has free, on a CPU for any.

    Raises:
        ValueError: not even one schedule fits.
    """
    one = task.make_sim(1)
    fixed, each = needs(task, one)
    free = SHARE * free_memory(one.device) if room is None else room
    if free < fixed + each:
        limit = f"{SHARE:.0%} of what {one.device} has free" if room is None else "the limit of the search"
        raise ValueError(
            f"task {task.name!r}: to roll out one schedule takes {(fixed + each) / 2**20:.2f} MiB, and "
            f"{limit} is {max(free, 0.0) / 2**20:.2f} MiB: free some memory, or take a shorter horizon, "
            "fewer models in the ensemble, or engine mujoco"
        )
    return task.make_sim(int(min(wanted, (free - fixed) / each)))


def needs(task: Task, one: Sim) -> tuple[float, float]:
    """Bytes that a search takes whatever its size, and a schedule at a time, on the device of a simulator.

    Engines that say what a world of theirs takes (`world_bytes`) are believed; of others it is the snapshot.
    """
    number = one.dtype.itemsize
    snapshot = one.save(slice(0, 1)).shape[1]
    situation = number * (one.nx + one.nu + task.modes.memory_size + snapshot)
    world = getattr(one, "world_bytes", number * snapshot) + situation + WORKING
    members = 1 if task.ensemble is None else task.ensemble.size
    # an ensemble has a simulator of its own beside the task's
    worlds = members + (0 if task.ensemble is None else 1)
    return RECORDED * members * (task.horizon + 1) * situation, worlds * world
