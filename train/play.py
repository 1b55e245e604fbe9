"""One episode of a checkpoint, recorded: how long the stance is held, and a video of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hmc.go2.model import load_model
from hmc.go2.policy import Policy
from hmc.go2.stances import FOOTSTAND, HANDSTAND, HOLDS, STANCES
from hmc.sim.mujoco import MujocoSim
from train.evaluate import on_its_legs
from train.export import export
from train.fallen import LegsStarts, LegsStartsCfg
from train.runner import read_checkpoint
from train.starts import Starts, StartsCfg

WALK = (0.6, 0.0, 0.0)  # what a walk is recorded at: forward, sideways [m/s], turn [rad/s]
TOLD = 100  # control step at which the policy without modes is told to flip
RENDER = Path(__file__).resolve().parents[1] / "tools" / "render.py"


@torch.no_grad()
def play(
    checkpoint: Path, mode: str, out: Path, *, seconds: float = 10.0, seed: int = 1, threads: int = 0
) -> str:
    """Record an episode of a checkpoint, as its policy file would act, from a start as in training.

    Writes play.json, and with OpenGL play.mp4 and play.png, into `out`; says what came of it.
    """
    meta = read_checkpoint(checkpoint)["infos"]["meta"]
    cfg = json.loads(meta["config"])["env"]
    if cfg["mode"] != mode:
        raise ValueError(
            f"checkpoint {checkpoint}: trained for {cfg['mode']}, not for {mode}: pass --mode {cfg['mode']}"
        )
    torch.manual_seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        export(checkpoint, Path(folder) / "policy.onnx")
        policy = Policy(Path(folder) / "policy.onnx", command=COMMAND.get(mode))
    good = on_its_legs if mode == "walk" else HANDSTAND.held if mode == "unified" else HOLDS[mode].held
    start = _starts(mode, cfg.get("starts", {})).sample(1)
    sim = MujocoSim(load_model(), 1, threads=threads)
    sim.reset(start.x, start.u)
    k = torch.zeros(1, dtype=torch.long)
    memory = policy.reset(sim.x(), sim.u(), k)
    steps, held = [], []
    for step in range(round(seconds / sim.dt)):
        steps.append({"mode": mode, "x": [round(v, 6) for v in sim.x()[0].tolist()]})
        action, memory = policy.act(sim.x(), sim.u(), memory, k + step)
        sim.step(action)
        held.append(bool(good(sim.x())[0]))
    out.mkdir(parents=True, exist_ok=True)
    log = out / "play.json"
    partial = log.with_suffix(".partial")
    partial.write_text(json.dumps({"steps": steps}) + "\n", encoding="utf-8")
    os.replace(partial, log)
    line = f"{mode}: held for {sum(held) * sim.dt:.2f} of {seconds:g} s"
    if True in held:
        line += f", first after {(held.index(True) + 1) * sim.dt:.2f} s"
    drawn = subprocess.run([sys.executable, str(RENDER), str(log)], capture_output=True, text=True)
    return f"{line}\n{(drawn.stdout or drawn.stderr).strip()}"


COMMAND: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "walk": lambda x, k: x.new_tensor(WALK).expand(len(x), 3),
    "unified": lambda x, k: torch.where(k < TOLD, -1.0, 1.0)[:, None].to(x),
}


def _starts(mode: str, cfg: dict[str, Any]) -> Starts | LegsStarts:
    """Where episodes began in training."""
    if mode == "unified":
        return Starts(FOOTSTAND, StartsCfg(stance=1.0, home=0.0), torch.device("cpu"))
    if mode in STANCES:
        cfg = {**cfg, "recorded": 0.0, "records": ""}
        return Starts(STANCES[mode], StartsCfg(**cfg), torch.device("cpu"), unlocked=True)
    return LegsStarts(LegsStartsCfg(**cfg), torch.device("cpu"))
