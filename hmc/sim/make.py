"""Choosing an engine by name and device, with an error in one line for what is not there."""

from __future__ import annotations

import re
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING

import torch

from hmc.sim.device import devices, find_device

if TYPE_CHECKING:
    from collections.abc import Sequence

    import mujoco

    from hmc.sim.base import Sim

ENGINES = ("auto", "mujoco", "warp")


def installed() -> str:
    """The packages behind engine warp with their versions, in words."""
    names = ("mujoco", "mujoco-warp", "warp-lang")
    return ", ".join(f"{name} {metadata.version(name)}" for name in names)


@cache
def misfit() -> str:
    """What mujoco-warp wants of the packages that it works on and does not get; mostly nothing."""
    for wanted in metadata.requires("mujoco-warp") or ():
        found = re.fullmatch(r"(mujoco|warp-lang)>=([\d.]+)", wanted)
        if found is not None and _numbers(metadata.version(found[1])) < _numbers(found[2]):
            return f"mujoco-warp wants {wanted}"
    return ""


def _numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)[:3]]


def choose(engine: str, device: str | torch.device | None = None) -> tuple[str, torch.device | None]:
    """The engine that a name stands for on this machine, and the device if one is named; see `make_sim`."""
    if engine not in ENGINES:
        raise ValueError(f"unknown engine {engine!r}: choose one of {', '.join(ENGINES)}")
    there = None if device is None else find_device(device)
    if engine == "auto":
        cuda = torch.cuda.is_available() if there is None else there.type == "cuda"
        engine = "warp" if cuda else "mujoco"
    if engine == "mujoco" and there is not None and there.type != "cpu":
        raise ValueError(f"engine mujoco runs on the CPU, not on {device}: leave device out, or take warp")
    if engine == "warp" and there is None and not torch.cuda.is_available():
        raise ValueError(f"engine warp wants a GPU and {devices()}: take engine mujoco, its fast CPU sibling")
    return engine, there


def make_sim(
    model: mujoco.MjModel,
    num_worlds: int,
    engine: str = "auto",
    *,
    device: str | torch.device | None = None,
    substeps: int = 4,
    threads: int = 0,
    latency: int | Sequence[int] = 0,
    models: Sequence[mujoco.MjModel] | None = None,
) -> Sim:
    """Worlds of a MuJoCo model on the engine asked for; see `hmc.sim.base.Sim`.

    Args:
        model: compiled model.
        num_worlds: number of worlds W.
        engine: "mujoco" (C, on the CPU), "warp" (MuJoCo Warp), or "auto": warp on a GPU, mujoco elsewhere.
        device: where to simulate; left out, a GPU if there is one, unless the engine is "mujoco".
        substeps: physics steps a control step.
        threads: of the C engine; 0 for all cores.
        latency: physics steps of a control step in which the input before it still acts; one of all worlds
            or one of each.
        models: a model of each world with other values than `model`, of which engine warp takes those in
            `hmc.sim.variety.OWN`; None for `model` in all of them.

    Raises:
        ValueError: an engine that is not known, a device that does not exist, or the two do not fit.
    """
    engine, there = choose(engine, device)
    if engine == "mujoco":
        from hmc.sim.mujoco import MujocoSim

        return MujocoSim(
            model, num_worlds, substeps=substeps, threads=threads, latency=latency, models=models
        )
    try:
        from hmc.sim.warp import WarpSim

        if wrong := misfit():
            raise ImportError(wrong)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"engine warp needs {error.name}: pip install 'hmc[warp]', or take mujoco"
        ) from error
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"engine warp: {installed()} do not go together ({error}): pip install 'hmc[warp]' -c "
            "constraints.txt for a tested set, or take engine mujoco"
        ) from error
    return WarpSim(
        model, num_worlds, device=there or "cuda", substeps=substeps, latency=latency, models=models
    )
