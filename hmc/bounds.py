"""What the rest of a horizon costs at least, as far as a task can tell."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hmc.branches import Branches
from hmc.cost import checked
from hmc.sim.device import upload
from hmc.task import Task
from hmc.worlds import Indices


class Rest:
    """Lower bounds of what the branches of a tree cost from a step on.

    What parts from a branch later ends with it: a bound has to hold for that as well.

    Args:
        task: whose bounds they are.
        tree: the branches.
    """

    def __init__(self, task: Task, tree: Branches):
        self._task, self._modes = task, tree.modes.numpy().T
        self._settled = None if task.tail_bound is None else tree.settled

    def __call__(self, i: int, branches: Indices | slice, x: Tensor, k: int) -> Tensor | None:
        """Of branches (n,) at step i, control step k, whose n E worlds are in states x; None for no bound.

        Returns:
            (n E,).
        """
        steps, ks = len(self._modes) - i, torch.full((len(x),), k, device=x.device)
        any_way = self._task.lower_bound
        least = None if any_way is None else checked("lower_bound", any_way(x, ks, steps), (len(x),))
        if self._settled is None or self._task.tail_bound is None:
            return least
        alone, modes = self._settled[branches] <= i, self._modes[i, branches]
        for index in np.bincount(modes[alone]).nonzero()[0].tolist():
            # of all rather than of some of them: to pick those out takes longer
            found = self._task.tail_bound(self._task.modes[index], x, ks, steps)
            if found is not None:
                checked("tail_bound", found, (len(x),))
                here = upload((alone & (modes == index)).repeat(len(x) // len(modes)), x.device)
                known = torch.zeros_like(found) if least is None else least
                least = torch.where(here, torch.fmax(known, found), known)
        return least
