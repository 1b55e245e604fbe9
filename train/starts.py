"""Start states: the stance, states on the way to it, the four-legged stand, recorded states.

The states on the way form a grid over (place, energy) whose cells open one by one, backwards from the
stance, as the policy learns to reach it from their neighbours; cells that are neither mastered nor
hopeless are drawn most often.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from hmc.go2 import model as go2
from hmc.go2.stances import FOOTSTAND, HANDSTAND, Stance
from hmc.sim.device import constant
from train.chosen import choose, put
from train.env import Start

ROOT = Path(__file__).resolve().parents[1]
GRAVITY = 9.81
GYRATION2 = 0.033  # squared radius of gyration about the pitch axis [m^2]

STANCE, WAY, HOME, RECORDED = range(4)
KINDS = ("stance", "way", "home", "recorded")


@dataclass(frozen=True)
class StartsCfg:
    """How episodes begin.

    Attributes:
        stance: share of episodes that begin in the stance, disturbed.
        way: share on the way to the stance, with the body already rotating towards it.
        home: share in the four-legged stand.
        recorded: share drawn from the file of recorded states.
        furthest: place where the way begins: 1 the stance, 0 horizontal, -1 the other stance.
        tilt: disturbance of roll and pitch in the stance, uniform [rad].
        speed: disturbance of linear [m/s] and angular [rad/s] velocity, uniform.
        joints: disturbance of joint positions, uniform [rad].
        records: .pt file of tools/record_flips.py, with states "x" (n, 37) and inputs "u" (n, 12); a path
            that is not absolute begins at the repository; empty for none.
    """

    stance: float = 0.5
    way: float = 0.0
    home: float = 0.5
    recorded: float = 0.0
    furthest: float = 0.0
    tilt: float = 0.26
    speed: float = 0.4
    joints: float = 0.1
    records: str = ""


class Starts:
    """Draws start states for one stance and learns from how the episodes ended.

    Args:
        stance: what the policy is to hold.
        cfg: shares and disturbances.
        device: where the tensors live.
        unlocked: to measure a policy: draw all kinds from the beginning, and each recorded state once.
    """

    WIDTH, ENERGIES = 0.1, 7  # of a place; number of energies
    ENERGY_LOW, ENERGY_HIGH = 0.0, 1.4
    AHEAD = 256  # sampled at once; the curriculum moves little in the time that they last
    HORIZONTAL = 0.2  # four-legged starts wait until the way is open up to here
    kinds = KINDS

    def __init__(self, stance: Stance, cfg: StartsCfg, device: torch.device, *, unlocked: bool = False):
        self.stance, self.cfg, self.device = stance, cfg, device
        self.unlocked = unlocked
        self.other = FOOTSTAND if stance is HANDSTAND else HANDSTAND
        self.places = round((1.0 - cfg.furthest) / self.WIDTH)
        if not math.isclose(self.places * self.WIDTH, 1.0 - cfg.furthest) or not 0 < self.places <= 20:
            raise ValueError(
                f"starts.furthest must be -1, -0.9 ... 0.9, in steps of {self.WIDTH}; got {cfg.furthest}"
            )
        self.success = torch.zeros(self.places, self.ENERGIES, device=device)
        self.rates = torch.zeros(len(KINDS), device=device)
        self.shares = torch.tensor([cfg.stance, cfg.way, cfg.home, cfg.recorded], device=device)
        self._ahead: Start | None = None
        self.records: dict[str, Tensor] | None = None
        if cfg.records:
            self.records = _read(ROOT / cfg.records, device)
        elif cfg.recorded > 0:
            raise ValueError("starts.recorded > 0 needs starts.records, the file with the recorded states")

    def draw(self, n: int) -> Start:
        """The next n starts. They are sampled in advance: one takes as long as hundreds."""
        if self._ahead is None or len(self._ahead.kind) < n:
            self._ahead = self.sample(max(n, self.AHEAD))
        start = Start(*(part[:n] for part in self._ahead))
        self._ahead = Start(*(part[n:] for part in self._ahead))
        return start

    def sample(self, n: int) -> Start:
        """n starts as the curriculum stands now."""
        kind = torch.multinomial(self._shares(), n, replacement=True)
        place = torch.ones(n, device=self.device)
        energy = torch.zeros(n, device=self.device)
        cell = torch.multinomial(self.weights().flatten(), n, replacement=True)
        column = torch.div(cell, self.ENERGIES, rounding_mode="floor")
        on_way = kind == WAY
        place = torch.where(on_way, 1.0 - (column + self._uniform(n, 0, 1)) * self.WIDTH, place)
        width = (self.ENERGY_HIGH - self.ENERGY_LOW) / self.ENERGIES
        share = self.ENERGY_LOW + (cell % self.ENERGIES + self._uniform(n, 0, 1)) * width
        energy = torch.where(on_way, share, energy)
        place = torch.where(kind == HOME, 0.0, place)
        x = self._place(place, energy, hop=on_way & (self._uniform(n, 0, 1) < 0.5))
        u = within(x[:, 7:19] + self._uniform((n, 12), -0.3, 0.3))
        if self.records is not None:
            recorded = choose(kind == RECORDED)
            many = len(self.records["x"])
            pick = torch.randint(many, (len(recorded),), device=self.device)
            if self.unlocked and len(recorded) <= many:
                pick = torch.arange(len(recorded), device=self.device)
            put(x, recorded, self.records["x"][pick].to(x))
            put(u, recorded, self.records["u"][pick].to(u))
        return Start(x, u, kind, cell)

    def weights(self) -> Tensor:
        """Weight of each cell of the way, (places, energies): open cells by how much is to be learned."""
        p = self.success
        near = torch.nn.functional.max_pool2d(p[None, None], 3, 1, 1)[0, 0]
        opened = near > 0.35
        opened[:2] = True
        return (p * (1 - p) + 0.04) * opened

    def _shares(self) -> Tensor:
        """Shares of the kinds: recorded starts wait until the stance is held, four-legged ones until it is
        reached from nearly horizontal.

        Their early episodes are long and teach nothing; they would be most of a batch.
        """
        if self.unlocked:
            return self.shares
        held, ready = self.rates[STANCE] > 0.5, torch.ones_like(self.shares)
        ready[RECORDED] = held
        ready[HOME] = held & (self.frontier() <= self.HORIZONTAL) if self.cfg.way > 0 else held
        return self.shares * ready

    def report(self, kind: Tensor, cell: Tensor, success: Tensor, ended: Tensor) -> None:
        """Learn from episodes that `ended`: kind, cell and whether they ended standing, all (n,)."""
        average(self.success.view(-1), cell, success, ended & (kind == WAY), 0.95)
        average(self.rates, kind, success, ended, 0.995)

    def frontier(self) -> Tensor:
        """Furthest place from which some energy succeeds in more than a third of the episodes, ()."""
        good = (self.success > 0.35).any(1)
        rows = (good * torch.arange(1, self.places + 1, device=self.device)).amax()
        return 1.0 - rows.double() * self.WIDTH

    def log(self) -> dict[str, Tensor]:
        """How far the way is open."""
        return {"frontier": self.frontier()}

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint must keep."""
        return {"success": self.success, "rates": self.rates}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint.

        Raises:
            ValueError: its way is longer or shorter.
        """
        places = len(state["success"])
        if places != self.places:
            raise ValueError(
                f"its starts on the way to the {self.stance.name} begin at {1 - places * self.WIDTH:.1f}; "
                f"expected {self.cfg.furthest}: set furthest of the starts as it was"
            )
        self._ahead = None
        self.success.copy_(state["success"])
        self.rates.copy_(state["rates"])

    def _uniform(self, shape: int | tuple[int, ...], low: float, high: float) -> Tensor:
        return torch.empty(shape, device=self.device).uniform_(low, high)

    def _place(self, place: Tensor, energy: Tensor, hop: Tensor) -> Tensor:
        r"""States on the line from this stance (place 1) over horizontal (0) to the other one (-1).

        The body turns towards the stance about the feet that support it there. From horizontal on,
        `energy` is the rotation's share of what lifts the base to the stance's height h:
        omega^2 (r^2 + rho^2) = 2 energy g (h - z); before that it is the share of what a fall from
        the other stance gives, plus a push. Hopping states are lifted off the ground, moving up or down.
        """
        n, cfg, stance = len(place), self.cfg, self.stance
        wobble = (0.4 + 0.6 * (energy == 0)) * cfg.tilt
        own, pose, home = (constant(each, place) for each in (stance.pose, self.other.pose, go2.HOME))
        toward = place[:, None]
        q = home + toward.clamp(min=0) * (own - home) + (-toward).clamp(min=0) * (pose - home)
        q = within(q + self._uniform((n, 12), -1, 1) * cfg.joints)
        pitch = stance.sign * place * math.pi / 2 + self._uniform(n, -1, 1) * wobble
        roll = self._uniform(n, -1, 1) * 0.5 * wobble
        x = torch.zeros(n, 37, device=self.device)
        cp, sp, cr, sr = (pitch / 2).cos(), (pitch / 2).sin(), (roll / 2).cos(), (roll / 2).sin()
        x[:, 3:7] = torch.stack([cp * cr, cp * sr, sp * cr, -sp * sr], -1)
        x[:, 7:19] = q
        lift = hop * self._uniform(n, 0, 0.2)
        gap = go2.clearances(x)
        lowest = torch.cat([gap["foot"], gap["thigh"], gap["calf"], gap["trunk"][:, None]], 1).amin(1)
        x[:, 2] = lift + 0.001 - lowest
        feet = go2.leg_points(q)[:, :, 2] @ go2.rotation(x[:, 3:7]).transpose(1, 2)
        near = torch.where(toward[:, :, None] >= 0, feet[:, stance.standing], feet[:, stance.swing])
        arm = -near.mean(1)  # from the pivot to the base
        rise = (go2.STANCE_HEIGHT - x[:, 2]).clamp(min=0.02)
        inertia = arm.square().sum(1) + GYRATION2
        push = torch.where(place < 0, 1.0 * energy, torch.zeros_like(energy))
        omega = stance.sign * ((2 * energy * GRAVITY * rise / inertia).sqrt() + push) * (energy > 0)
        x[:, 19] = omega * arm[:, 2]
        x[:, 21] = -omega * arm[:, 0] + hop * self._uniform(n, -0.8, 1.0)
        x[:, 19:22] += self._uniform((n, 3), -1, 1) * cfg.speed
        x[:, 22:25] = self._uniform((n, 3), -1, 1) * cfg.speed
        x[:, 23] += omega
        x[:, 25:37] = self._uniform((n, 12), -1, 1) * cfg.speed
        return x


def _read(path: Path, device: torch.device) -> dict[str, Tensor]:
    """Recorded states and inputs."""
    if not path.is_file():
        raise ValueError(
            f"starts.records: no such file {path}: make one with python tools/record_flips.py --out FILE"
        )
    found = torch.load(path, map_location=device, weights_only=True)
    if not {"x", "u"} <= found.keys() or found["x"].shape[1:] != (37,) or found["u"].shape[1:] != (12,):
        raise ValueError(f'starts.records: {path} lacks states "x" (n, 37) and inputs "u" (n, 12)')
    return found


def within(q: Tensor) -> Tensor:
    """Joint positions (n, 12), no further than the joints go [rad]."""
    return q.clamp(constant(go2.Q_LOWER, q), constant(go2.Q_UPPER, q))


def average(values: Tensor, index: Tensor, samples: Tensor, counted: Tensor, keep: float) -> None:
    """Move each entry of `values` towards the mean of the samples at its index, by their number.

    Args:
        values: averages so far, (v,).
        index: of each sample, where it belongs, (n,).
        samples: true or false, (n,) bool.
        counted: which samples there are, (n,) bool; the others' indices mean nothing.
        keep: share of the old average that one sample leaves.
    """
    index = torch.where(counted, index, 0)
    count, total = (
        torch.zeros_like(values).index_add_(0, index, each.to(values))
        for each in (counted, samples & counted)
    )
    kept = keep**count
    values.mul_(kept).add_((1 - kept) * total / count.clamp(min=1))
