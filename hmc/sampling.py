"""Sampling MPC (MPPI, CEM, predictive sampling), as a mode and as a planner on its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hmc.cost import Cost, total
from hmc.modes import Mode
from hmc.sim.base import Sim, rollout
from hmc.sim.device import upload
from hmc.spline import interpolate, nearest, spline


@dataclass(frozen=True)
class SamplingCfg:
    """Settings of one sampling MPC.

    Attributes:
        method: how samples move the plan, one of METHODS: mppi, cem (cross-entropy method) or ps
            (predictive sampling).
        horizon: control steps looked ahead, H.
        samples: rollouts an update, the plan itself among them, S.
        temperature: of mppi: lambda of the weights, in units of the samples' cost spread.
        elites: of cem: how many of the best samples the next distribution is fitted to.
        knots: points of the linear spline that a plan is, over the horizon.
        noise: standard deviation of a knot's noise along each row of the noise basis.
        replan_every: control steps between re-plans; in between the plan runs open loop.
        iterations: updates a re-plan.
        worlds: worlds of the simulator it plans in; larger batches are processed in parts.
    """

    method: str = "mppi"
    horizon: int = 20
    samples: int = 25
    temperature: float = 0.1
    elites: int = 5
    knots: int = 5
    noise: float = 0.2
    replan_every: int = 2
    iterations: int = 1
    worlds: int = 256

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"sampling.method must be one of {', '.join(METHODS)}, got {self.method!r}")
        for name in ("horizon", "samples", "elites", "replan_every", "iterations", "worlds"):
            if getattr(self, name) < 1:
                raise ValueError(f"sampling.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("temperature", "noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"sampling.{name} must be a number >= 0, got {getattr(self, name)}")
        if self.method == "cem" and self.elites > self.samples:
            raise ValueError(f"sampling.elites must not exceed the {self.samples} samples, got {self.elites}")
        if not 2 <= self.knots <= self.horizon:
            raise ValueError(
                f"sampling.knots must be between 2 and the horizon {self.horizon}, got {self.knots}"
            )
        if self.replan_every > self.horizon:
            raise ValueError(
                f"sampling.replan_every must not exceed the horizon {self.horizon}, got {self.replan_every}"
            )


Update = Callable[[SamplingCfg, Tensor, Tensor], tuple[Tensor, Tensor | None]]


def mppi(cfg: SamplingCfg, noise: Tensor, costs: Tensor) -> tuple[Tensor, Tensor | None]:
    r"""Model predictive path integral control (Williams et al. 2017): a weighted mean of all samples.

    .. math:: w_s \propto \exp(-(J_s - \min J) / (\lambda \sigma)), \quad
              \sigma^2 = \mathrm{mean}_s (J_s - \min J)^2

    Args:
        cfg: settings.
        noise: of the samples, (n, S, K, d), along the noise basis.
        costs: J of the samples, (n, S); inf where one has no say.

    Returns:
        What the plan moves by, (n, K, d), and the noise's standard deviation in the re-plan's next
        update, (n, K, d), or None where it stays as it is.
    """
    excess = costs - costs.min(1, keepdim=True).values
    finite = (excess.square() * costs.shape[1]).isfinite()  # what cannot be squared would hide all others
    excess = torch.where(finite, excess, 0.0)
    spread = (excess.square().sum(1, keepdim=True) / finite.sum(1, keepdim=True).clamp(min=1)).sqrt()
    weight = torch.exp(-excess / (cfg.temperature * spread).clamp(min=1e-9)) * finite
    weight = weight / weight.sum(1, keepdim=True).clamp(min=1e-9)
    return (weight[:, :, None, None] * noise).sum(1), None


def cem(cfg: SamplingCfg, noise: Tensor, costs: Tensor) -> tuple[Tensor, Tensor | None]:
    """The cross-entropy method (Rubinstein 1999): mean and deviation of eps_s, s in the elites; as `mppi`."""
    order = costs.argsort(dim=1, stable=True)[:, : cfg.elites]
    has_say = costs.gather(1, order).isfinite()[:, :, None, None]
    elites = noise.gather(1, order[:, :, None, None].expand(-1, -1, *noise.shape[2:])) * has_say
    count = has_say.sum(1).clamp(min=1)
    mean = elites.sum(1) / count
    variance = ((elites - mean[:, None]).square() * has_say).sum(1) / count
    # a distribution that has collapsed finds nothing any more
    return mean, variance.sqrt().clamp(min=0.05 * cfg.noise)


def ps(cfg: SamplingCfg, noise: Tensor, costs: Tensor) -> tuple[Tensor, Tensor | None]:
    """Predictive sampling (Howell et al. 2022): eps_s of the best sample, s = argmin J_s; as `mppi`."""
    best = costs.argmin(1)
    has_say = costs.gather(1, best[:, None]).isfinite()[:, :, None]
    return noise[torch.arange(len(noise), device=noise.device), best] * has_say, None


METHODS: dict[str, Update] = {"mppi": mppi, "cem": cem, "ps": ps}


@dataclass(frozen=True, eq=False)
class Solution:
    """What a planner of inputs came to.

    Attributes:
        controls: inputs, (H, nu).
        cost: J of them; inf where every sample diverged.
        control_steps: control steps rolled out.
    """

    controls: Tensor
    cost: float
    control_steps: int


@dataclass(frozen=True, eq=False)
class Constants:
    """What plans are made with, on one device and in one type; see `SamplingMpc`.

    Attributes:
        lower, upper: bounds of the input (nu,).
        spline: weights of the knots at each step (H, K).
        basis: directions of the noise (d, nu).
        later: weights of the knots at where they are when a plan is shifted (K, K).
        inside: how many of them, the first ones, are then within the old plan.
        at: control steps that the knots sit at (K,), float32.
        guess: inputs (G, nu) of the guess, in its own type; None for none.
    """

    lower: Tensor
    upper: Tensor
    spline: Tensor
    basis: Tensor
    later: Tensor
    inside: int
    at: Tensor
    guess: Tensor | None


class SamplingMpc(Mode):
    r"""Sampling MPC on spline knots, batched over worlds and deterministic.

    A plan is K knots theta with u_i = sum_j B_ij theta_j. An update draws noise eps_s (eps_0 = 0) from a
    counter keyed by (seed, k), the same in every world, rolls out the plans theta + eps_s, and moves theta
    by what `cfg.method` makes of their costs J_s.

    Between re-plans the plan runs open loop; a re-plan starts from the plan shifted by the steps taken.
    Memory: the knots, then the number of steps taken since entry. The last `MEMO` re-plans are kept:
    the same situation is never rolled out twice.

    On a GPU a step waits for the device once, to learn in which worlds it re-plans, and whether their
    situations are known: then they are not rolled out. The re-plan itself does not wait.

    Args:
        name: of the mode.
        cfg: settings.
        make_sim: number of worlds -> a simulator to plan in.
        cost: what the rollouts are judged by; k is the task's, so targets may move.
        lower, upper: bounds of the input (nu,).
        guess: inputs (G, nu) by control steps since entry, held at the end: the first plan, and what
            newly appears at each later plan's end, start from it; default: hold u.
        basis: (d, nu) directions of the noise; default: every input by itself.
        seed: of the noise.
    """

    MEMO = 20_000

    def __init__(
        self,
        name: str,
        cfg: SamplingCfg,
        make_sim: Callable[[int], Sim],
        cost: Cost,
        lower: Tensor,
        upper: Tensor,
        *,
        guess: Tensor | None = None,
        basis: Tensor | None = None,
        seed: int = 0,
    ):
        self.name, self.cfg, self.cost, self.seed = name, cfg, cost, seed
        self.lower, self.upper = lower, upper
        self.nu = len(lower)
        self.guess = guess
        self.basis = torch.eye(self.nu) if basis is None else basis
        self.memory_size = cfg.knots * self.nu + 1
        self._make_sim = make_sim
        self._sim: Sim | None = None
        self.spline = spline(cfg.horizon, cfg.knots)
        self._known: dict[bytes, Tensor] = {}
        self._there: dict[tuple[torch.device, torch.dtype], Constants] = {}

    def reset(self, x: Tensor, u: Tensor, k: Tensor) -> Tensor:
        n = len(x)
        if self.guess is None:
            theta = u[:, None].expand(n, self.cfg.knots, self.nu)
        else:
            theta = self._prior(x, x.new_zeros(1)).expand(n, -1, -1)
        return torch.cat([theta.reshape(n, -1).to(x), x.new_zeros(n, 1)], 1)

    def act(self, x: Tensor, u: Tensor, memory: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        n = len(x)
        theta = memory[:, :-1].reshape(n, self.cfg.knots, self.nu).clone()
        taken = memory[:, -1]
        # all that the host must know, in one copy
        situations = torch.cat([taken[:, None], k[:, None].to(x), x, u, memory[:, :-1]], 1)
        rows = situations.cpu().contiguous().numpy()
        due = np.flatnonzero(rows[:, 0].astype(np.int64) % self.cfg.replan_every == 0)
        if len(due):
            now = upload(due, x.device)
            moved = self._shift(theta[now], taken[now]) if rows[due, 0].any() else theta[now]
            theta[now] = self._replan_known(rows[due], x[now], u[now], moved)
        its, phase = self._constants(x), taken.long() % self.cfg.replan_every
        action = (its.spline[phase][:, None] @ theta).squeeze(1).clamp(its.lower, its.upper)
        return action, torch.cat([theta.reshape(n, -1), (taken + 1)[:, None]], 1)

    def forget(self) -> None:
        self._known.clear()

    @torch.no_grad()
    def solve(
        self, x: Tensor, u: Tensor, control_steps: int, k: int = 0, guess: Tensor | None = None
    ) -> Solution:
        """The planner on its own: updates from the first plan on, until the budget is used up.

        Args:
            x: state, (nx,).
            u: input applied last, (nu,).
            control_steps: budget; an update takes S H of them, and one at least is made.
            k: control step since the start of the task.
            guess: inputs (H, nu) to begin from, such as an earlier solution's: the spline nearest to them is
                the first plan. Left out, it begins as the mode does when it is entered.

        Raises:
            ValueError: a guess of another shape, or one that is not finite.
        """
        step, its = torch.tensor([k]), self._constants(x)
        if guess is None:
            theta = self.reset(x[None], u[None], step)[:, :-1].reshape(1, self.cfg.knots, self.nu)
        else:
            expected = self.cfg.horizon, self.nu
            if guess.shape != expected or not guess.isfinite().all():
                raise ValueError(f"guess: expected {expected} finite inputs, got shape {tuple(guess.shape)}")
            theta = nearest(its.spline, guess.to(x))[None]
        std, best = None, (math.inf, theta[0])
        updates = max(1, control_steps // (self.cfg.samples * self.cfg.horizon))
        for iteration in range(updates):
            theta, std, (plans, costs) = self._update(x[None], u[None], theta, std, step, iteration)
            at = int(costs[0].argmin())
            if float(costs[0, at]) < best[0]:
                best = float(costs[0, at]), plans[0, at]
        controls = (its.spline @ best[1]).clamp(its.lower, its.upper)
        return Solution(controls, best[0], updates * self.cfg.samples * self.cfg.horizon)

    def _constants(self, like: Tensor) -> Constants:
        """What plans are made with, once a device and type: to copy it there again would be to wait."""
        key = like.device, like.dtype
        if key not in self._there:
            horizon, knots = self.cfg.horizon, self.cfg.knots
            at = torch.linspace(0, horizon - 1, knots)
            then = at + self.cfg.replan_every
            later = interpolate(then / (horizon - 1) * (knots - 1), knots)
            lower, upper, weights, basis, later = (
                each.to(like) for each in (self.lower, self.upper, self.spline, self.basis, later)
            )
            guess = None if self.guess is None else self.guess.to(like.device)
            inside, at = int((then <= horizon - 1).sum()), at.to(like.device)
            self._there[key] = Constants(lower, upper, weights, basis, later, inside, at, guess)
        return self._there[key]

    def _prior(self, like: Tensor, steps: Tensor, first: int = 0) -> Tensor:
        """Knots from `first` on of the guess, `steps` (n,) after entry, (n, K - first, nu), as `like` is."""
        its = self._constants(like)
        assert its.guess is not None
        at = steps.to(its.at.dtype)[:, None] + its.at[first:]
        low = at.floor().long().clamp(max=len(its.guess) - 1)
        high = (low + 1).clamp(max=len(its.guess) - 1)
        w = (at - at.floor())[..., None]
        return ((1 - w) * its.guess[low] + w * its.guess[high]).to(like)

    def _shift(self, theta: Tensor, taken: Tensor) -> Tensor:
        """Plans `replan_every` steps later; what newly appears comes from the guess, else holds."""
        its, moving = self._constants(theta), taken > 0
        moved = its.later @ theta
        if its.guess is not None:
            moved = torch.cat([moved[:, : its.inside], self._prior(theta, taken, its.inside)], 1)
        return torch.where(moving[:, None, None], moved, theta)

    def _replan_known(self, rows: NDArray[Any], x: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """`_replan`, once for each situation (n, ...) of `rows`, whose second number is k: schedules with a
        common beginning share it, and a search comes back to the same beginnings again and again."""
        keys = [row.tobytes() for row in rows]
        new = {key: i for i, key in enumerate(keys) if key not in self._known}
        if new:
            first = list(new.values())
            at, steps = upload(np.array(first), x.device), torch.from_numpy(rows[first, 1]).long()
            found = self._replan(x[at], u[at], theta[at], steps)
            self._known.update(zip(new, found, strict=True))
        plans = torch.stack([self._known[key] for key in keys])
        while len(self._known) > self.MEMO:
            del self._known[next(iter(self._known))]
        return plans

    def _replan(self, x: Tensor, u: Tensor, theta: Tensor, k: Tensor) -> Tensor:
        std = None
        for iteration in range(self.cfg.iterations):
            theta, std, _ = self._update(x, u, theta, std, k, iteration)
        return theta

    def _update(
        self, x: Tensor, u: Tensor, theta: Tensor, std: Tensor | None, k: Tensor, iteration: int
    ) -> tuple[Tensor, Tensor | None, tuple[Tensor, Tensor]]:
        """Knots and standard deviation of the noise after one update; the plans tried and their costs.

        Control steps k are on the CPU here and in what this calls, because noise is made there.
        """
        noise = self._noise(k, iteration, x) * (self.cfg.noise if std is None else std[:, None])
        plans = theta[:, None] + self._along_basis(noise)
        costs = self._rollout(x, u, plans, k).nan_to_num(torch.inf, torch.inf, torch.inf)
        move, std = METHODS[self.cfg.method](self.cfg, noise, costs)
        return theta + self._along_basis(move), std, (plans, costs)

    def _along_basis(self, noise: Tensor) -> Tensor:
        """Noise (..., d) as noise of the inputs, (..., nu); summed in one order, by numpy as well."""
        here, basis = noise.device.type == "cpu", self._constants(noise).basis
        parts, rows = (noise.numpy(), basis.numpy()) if here else (noise, basis)
        inputs = sum(parts[..., j, None] * row for j, row in enumerate(rows))
        return torch.from_numpy(inputs) if here else inputs

    def _noise(self, k: Tensor, iteration: int, like: Tensor | None = None) -> Tensor:
        """Standard normal noise of each world's samples, (n, S, K, d), by (seed, k, iteration) alone.

        It comes back as float64 on the CPU, or as what and where `like` is.
        """
        steps, inverse = k.unique(return_inverse=True)
        table = []
        for step in steps.tolist():
            counter = (self.seed * 1_000_003 + int(step)) * 101 + iteration
            generator = torch.Generator().manual_seed(counter % 2**63)
            z = torch.randn(
                self.cfg.samples, self.cfg.knots, len(self.basis), generator=generator, dtype=torch.float64
            )
            z[0] = 0
            table.append(z)
        noise = torch.stack(table)
        if like is not None:
            noise, inverse = (upload(each.numpy(), like.device) for each in (noise, inverse))
            noise = noise.to(like)
        return noise[inverse]

    def _rollout(self, x: Tensor, u: Tensor, plans: Tensor, k: Tensor) -> Tensor:
        """Costs of plans (n, S, K, nu) from states x (n, nx), (n, S), in parts of the simulator's size."""
        if self._sim is None:
            self._sim = self._make_sim(self.cfg.worlds)
            self.sims = (self._sim,)
        n, s = plans.shape[:2]
        k = upload(k.numpy(), x.device)
        flat = plans.reshape(n * s, self.cfg.knots, self.nu)
        owner = torch.arange(n, device=x.device).repeat_interleave(s)
        parts = []
        for rows in torch.arange(n * s, device=x.device).split(self._sim.num_worlds):
            mine = owner[rows]
            parts.append(self._rollout_part(self._sim, x[mine], u[mine], flat[rows], k[mine]))
        return torch.cat(parts).reshape(n, s)

    def _rollout_part(self, sim: Sim, x: Tensor, u: Tensor, theta: Tensor, k: Tensor) -> Tensor:
        n, horizon = len(x), self.cfg.horizon
        ids = torch.arange(n, device=sim.device)
        sim.reset(x, u, ids)
        its = self._constants(x)
        controls = (its.spline @ theta).clamp(its.lower, its.upper)
        states = rollout(sim, controls, ids)
        begin = torch.cat([x[:, None], states[:, :-1]], 1).reshape(n * horizon, -1)
        before = torch.cat([u[:, None], controls[:, :-1]], 1).reshape(n * horizon, -1)
        steps = (k[:, None] + torch.arange(horizon, device=k.device)).reshape(-1)
        terms = self.cost.stage_terms(begin, controls.reshape(n * horizon, -1), before, steps)
        self.control_steps += n * horizon
        stages = total((total(terms) * sim.dt).reshape(n, horizon))  # in this order at any n
        return stages + total(self.cost.terminal_terms(states[:, -1], k + horizon))
