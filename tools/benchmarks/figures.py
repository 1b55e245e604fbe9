"""Figures by name, and the machine that they were taken on."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime
import torch
from rich.markup import escape
from rich.table import Table

from hmc.schedule import SwitchSpace

# What the project asks of itself: figure -> at least, or at most, this much.
AT_LEAST = {
    "sim_open_loop_efficiency": 0.95,
    "sim_policy_efficiency": 0.80,
    "policy_efficiency": 0.80,
    "open_loop_efficiency": 0.90,
    "train_steps_per_s": 6000.0,
    "env_4096_efficiency": 0.80,
    "env_8192_efficiency": 0.80,
    "exact_t75_efficiency": 0.70,
    "train_8192_steps_per_s": 300_000.0,
}
AT_MOST = {
    "us_per_candidate": 2.0,
    "cartpole_exact_ms": 50.0,
    "cartpole_converged_ms": 1000.0,
    "shared_fraction": 0.30,
    "pruned_fraction": 0.10,
    "shared_time_fraction": 0.36,
    "pruned_time_fraction": 0.12,
    "mppi_overhead": 1.10,
    "crc_us": 5.0,
    "estimator_step_us": 400.0,
    "estimator_step_four_us": 400.0,
    "exact_t75_ms": 250.0,
    "mppi_4096x40_ms": 40.0,
}


NOT_MEASURED = "not measured"
FROM_ZERO = ("threads", "seed", "domain", "warm_up")  # the other whole numbers count what is measured


@dataclass(frozen=True)
class Common:
    """What all measurements take.

    Attributes:
        json: file to write the figures to.
        threads: of the engine, of onnxruntime and, in training, of torch; 0 for all cores.
    """

    json: Path | None = None
    threads: int = 0

    def __post_init__(self) -> None:
        for each in fields(self):
            value, least = getattr(self, each.name), 0 if each.name in FROM_ZERO else 1
            several = isinstance(value, tuple) and each.name != "set"
            counts = value if several else [value] if type(value) is int else []
            if (several and not counts) or any(count < least for count in counts):
                got = "none" if value == () else value
                raise ValueError(f"{each.name} must be at least {least}, got {got}")


@dataclass
class Figures:
    """Figures by name, each with the words that explain it in the table; `missing` are not measured here."""

    values: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, value: float, note: str) -> None:
        """Take down one figure."""
        self.values[name], self.notes[name] = float(value), note

    def table(self, title: str) -> Table:
        """A row a figure, with its target where there is one."""
        view = Table(title=title)
        view.add_column("figure")
        view.add_column("value", justify="right")
        view.add_column("target")
        view.add_column("what")
        for name, value in self.values.items():
            target, digits = "", 3 if abs(value) < 10 else 0
            for sign, targets in ((1, AT_LEAST), (-1, AT_MOST)):
                if name in targets:
                    met = "[green]met[/]" if sign * value >= sign * targets[name] else "[red]not met[/]"
                    target = f"{'>=' if sign > 0 else '<='} {targets[name]:,g}  {met}"
            view.add_row(name, f"{value:,.{digits}f}", target, escape(self.notes[name]))
        for name, note in self.missing.items():
            goal = f">= {AT_LEAST[name]:,g}" if name in AT_LEAST else ""
            goal = f"<= {AT_MOST[name]:,g}" if name in AT_MOST else goal
            view.add_row(name, NOT_MEASURED, goal, escape(note))
        return view


def fits(batches: Sequence[int], name: str, horizon: int) -> None:
    """Raise a ValueError where a batch has more switches than there are, of three modes."""
    size = len(SwitchSpace(3, horizon))
    if max(batches) > size:
        raise ValueError(
            f"{name} must be at most {size}, all switches of T {horizon}, M 3, got {max(batches)}"
        )


def machine(threads: int) -> dict[str, str | int | float]:
    """What the figures were taken on."""
    model = platform.processor() or "unknown"
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    return {
        "cpu": model,
        "cores": os.cpu_count() or 1,
        "cores_allowed": cores(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "threads": threads,
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else -1.0,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "onnxruntime": onnxruntime.__version__,
    }


def cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
