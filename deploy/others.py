"""Other robots that the robot might be: a flip is tried on them before it is sent."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hmc import Start, Task
from hmc.go2.ensemble import EnsembleCfg
from hmc.go2.model import load_model
from hmc.go2.stances import HANDSTAND
from hmc.go2.variants import draw
from hmc.sim.mujoco import MujocoSim
from hmc.worlds import Worlds


class Others:
    """Go2s with other bodies, each in a state beside the estimated one.

    Args:
        task: whose modes run.
        cfg: how many, and how far they are from the nominal one.
        seed: of the robots.
        threads: of the engine; 0 for all cores.
    """

    def __init__(self, task: Task, cfg: EnsembleCfg, *, seed: int = 0, threads: int = 0):
        self.count = cfg.members
        if self.count == 0:
            return
        generator = torch.Generator().manual_seed(seed)
        robots = draw(cfg.variants, self.count, generator)
        self._error = torch.zeros(self.count, 37, dtype=torch.float64)
        wide = 2 * torch.rand(self.count, 15, generator=generator, dtype=torch.float64) - 1
        # the robot is where it measures itself less the error of its zeros
        zeros = torch.tensor([robot.zeros for robot in robots], dtype=torch.float64)
        self._error[:, 7:19] = cfg.joints * wide[:, :12] - zeros
        self._error[:, 19:22] = cfg.velocity * wide[:, 12:]
        self._sim = MujocoSim(
            load_model(),
            self.count,
            threads=threads,
            latency=[robot.late() for robot in robots],
            models=[robot.model() for robot in robots],
        )
        self._worlds = Worlds(task, self._sim)

    @torch.no_grad()
    def landed(self, start: Start, schedule: Sequence[int]) -> int:
        """How many of them are in the handstand after a schedule from `start`."""
        if self.count == 0:
            return 0
        worlds, sim = self._worlds, self._sim
        worlds.reset(Start(start.x, start.u, start.mode, start.memory, start.k), None)
        sim.reset(start.x + self._error, start.u.expand(self.count, -1))
        crew, before = None, None
        for k, mode in enumerate(schedule, start.k):
            if crew is None or mode != before:
                crew, before = worlds.crew(None, torch.full((self.count,), mode)), mode
            x = sim.x()
            # what has diverged stays lost, and no mode has to bear it
            lost = ~x.isfinite().all(1)
            u = worlds.act(crew, torch.where(lost[:, None], start.x, x), sim.u(), k)
            sim.step(u)
        return int(HANDSTAND.held(sim.x().nan_to_num(0.0)).sum())
