"""Start states on four legs: standing, lying as the robot fell, and coming down from two legs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.stances import FOOTSTAND, HANDSTAND, STAND
from hmc.sim.device import constant
from hmc.sim.mujoco import MujocoSim
from train.chosen import choose, put
from train.env import Start
from train.starts import average

STANDING, FALLEN, STANCES = range(3)
SETTLE = 60  # control steps in which a dropped robot comes to rest
ROLL = 5.0  # rad/s, at most, with which it is dropped
LEVEL = torch.tensor([1.0, 1.0, 0.0])  # axes about which a robot is tilted


@dataclass(frozen=True)
class LegsStartsCfg:
    """How episodes begin.

    Attributes:
        standing: share that begins on four feet, disturbed.
        fallen: share that begins as a robot falls or lies that was dropped in any attitude.
        stances: share that begins in the foot stand or the handstand, disturbed.
        tilt: disturbance of roll and pitch, uniform [rad].
        speed: of linear [m/s] and angular [rad/s] velocity, uniform.
        joints: of joint positions, uniform [rad].
        drops: robots that are dropped; their states are what `fallen` draws from.
    """

    standing: float = 1.0
    fallen: float = 0.0
    stances: float = 0.0
    tilt: float = 0.2
    speed: float = 0.4
    joints: float = 0.15
    drops: int = 1024

    def __post_init__(self) -> None:
        shares = (self.standing, self.fallen, self.stances)
        if min(shares) < 0 or sum(shares) <= 0:
            raise ValueError(f"shares of starts must be >= 0 and not all 0, got {shares}")


class LegsStarts:
    """Draws start states; there is no curriculum."""

    kinds = ("standing", "fallen", "stances")

    def __init__(self, cfg: LegsStartsCfg, device: torch.device):
        self.cfg, self.device = cfg, device
        self.shares = torch.tensor([cfg.standing, cfg.fallen, cfg.stances], device=device)
        self.rates = torch.zeros(3, device=device)
        self._rest = torch.stack([each.state() for each in (STAND, FOOTSTAND, HANDSTAND)]).float().to(device)
        self._fallen = dropped(cfg.drops).to(device) if cfg.fallen > 0 else None

    def draw(self, n: int) -> Start:
        """The next n starts."""
        return self.sample(n)

    def sample(self, n: int) -> Start:
        """n starts."""
        kind = torch.multinomial(self.shares, n, replacement=True)
        which = torch.where(kind == STANCES, 1 + torch.randint(2, (n,), device=self.device), 0)
        x = disturbed(self._rest[which], self.cfg)
        u = x[:, 7:19].clone()
        if self._fallen is not None:
            lying = choose(kind == FALLEN)
            picked = self._fallen[torch.randint(len(self._fallen), (len(lying),), device=self.device)]
            put(x, lying, picked[:, :37])
            put(u, lying, picked[:, 37:])
        return Start(x, u, kind, torch.zeros_like(kind))

    def report(self, kind: Tensor, cell: Tensor, success: Tensor, ended: Tensor) -> None:
        """Average of the successes of each kind lately."""
        average(self.rates, kind, success, ended, 0.995)

    def log(self) -> dict[str, Tensor]:
        """Nothing but the rates."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint must keep."""
        return {"rates": self.rates}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint."""
        self.rates.copy_(state["rates"])


def disturbed(x: Tensor, cfg: LegsStartsCfg) -> Tensor:
    """States x (n, 37) at rest, disturbed, and set onto the ground."""

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(shape, device=x.device) - 1

    n, x = len(x), x.clone()
    tilt = 0.5 * cfg.tilt * uniform(n, 3) * constant(LEVEL, x)
    turn = torch.cat([x.new_ones(n, 1), tilt], 1)
    x[:, 3:7] = go2.product(x[:, 3:7], turn / turn.norm(dim=1, keepdim=True))
    low, high = constant(go2.Q_LOWER, x), constant(go2.Q_UPPER, x)
    x[:, 7:19] = (x[:, 7:19] + cfg.joints * uniform(n, 12)).clamp(low, high)
    x[:, 19:25] += cfg.speed * uniform(n, 6)
    x[:, 25:37] += cfg.speed * uniform(n, 12)
    x[:, 2] += 0.001 - go2.lowest(x)
    return x


def dropped(n: int, threads: int = 0) -> Tensor:
    """States and inputs (n, 37 + 12) of robots that were dropped, in any attitude and rolling.

    Half of them lie there, most at rest; the others are taken at any moment on the way: from their sides, and
    while they roll, a policy learns what one on its back has to reach. They hold any pose: joints uniform
    over their ranges, targets not far from them.
    """
    x = torch.zeros(n, 37)
    turn = torch.randn(n, 4)
    x[:, 3:7] = turn / turn.norm(dim=1, keepdim=True)
    x[:, 7:19] = go2.Q_LOWER + (go2.Q_UPPER - go2.Q_LOWER) * torch.rand(n, 12)
    x[:, 2] += 0.1 - go2.lowest(x)
    x[:, 22] = ROLL * (2 * torch.rand(n) - 1)
    u = (x[:, 7:19] + 0.5 * torch.randn(n, 12)).clamp(go2.Q_LOWER, go2.Q_UPPER)
    sim = MujocoSim(go2.load_model(), n, threads=threads)
    sim.reset(x, u)
    moment = torch.randint(1, 2 * SETTLE, (n,)).clamp(max=SETTLE)
    for step in range(SETTLE):
        sim.step(u)
        x[moment == step + 1] = sim.x()[moment == step + 1].float()
    rows = torch.cat([x, u], 1)
    return rows[rows.isfinite().all(1)]
