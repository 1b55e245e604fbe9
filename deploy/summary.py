"""What a run came to, from its log; and, where the robot was a stand-in, from what really happened."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from deploy.control import TICK
from deploy.ekf import PHI, R, V
from deploy.log import read
from deploy.modes import HAND, NAMES, NONE
from deploy.safety import Phase
from deploy.so3 import matrix
from deploy.timing import Lateness
from hmc.go2.model import DT
from hmc.go2.stages import judge


def summarise(log: Path, truth: Path | None = None) -> dict[str, Any]:
    """Stages, ticks, lateness, plans, faults and the end of a run.

    Args:
        log: of the control process.
        truth: of the stand-in, an .npz file; None on a robot.

    Raises:
        LogError: not a log of this version.
    """
    ticks: list[dict[str, Any]] = []
    plans: list[dict[str, Any]] = []
    events: list[dict[str, Any]] = []
    into = {"tick": ticks, "plan": plans, "event": events}
    for topic, _, content in read(log):
        if topic in into:
            into[topic].append(content)
    hybrid = [tick for tick in ticks if tick["phase"] == Phase.HYBRID]
    end = next((event for event in events if event["what"] == "end"), {})
    reasons = [event["reason"] for event in events if event["what"] == "phase" and event["reason"]]
    own, response = ([], []) if truth is None else responses(truth, ticks)
    seconds = [plan["seconds"] for plan in plans] or [0.0]
    compute = [tick["compute"] for tick in ticks] or [0.0]
    return {
        "stages": stages(np.array([tick["x"] for tick in hybrid]), [tick["mode"] for tick in hybrid]),
        "stages_true": None if truth is None else _true(truth, hybrid),
        "estimate": None if truth is None else accuracy(truth, hybrid),
        "ticks": len(ticks),
        "missed": end.get("missed"),
        "late_ms": _percentiles([tick["late"] for tick in ticks]),
        "late_own_ms": _percentiles(own),
        "response_ms": _percentiles(response),
        "compute_ms_p50": round(float(np.median(compute)), 3),
        "plans": len(plans),
        "plans_per_s": round(len(plans) / max(DT * len(hybrid), DT), 1),
        "plan_s": dict(
            zip(("p50", "p90", "max"), np.quantile(seconds, (0.5, 0.9, 1.0)).round(3).tolist(), strict=True)
        ),
        "plans_used": end.get("plans"),
        "faults": end.get("faults"),
        "lost_records": end.get("lost"),
        "modes": _runs(hybrid),
        "end": end.get("phase"),
        "reasons": reasons,
    }


def responses(path: Path, ticks: list[dict[str, Any]]) -> tuple[list[float], list[float]]:
    """What of a tick's time is the deployment's own, where the stand-in's log says when its states left.

    Returns:
        How late each tick is, as `deploy.timing.Lateness` has it, but for what the stand-in was late with the
        state that was due; and the time from when that left until the command did [ms]. Delays that the
        stand-in was told to have count as on the way.
    """
    with np.load(path) as truth:
        left = dict(zip(truth["tick"].tolist(), truth["left"].tolist(), strict=True))
    lateness, own, response = Lateness(), [], []
    for tick in ticks:
        if tick["due"] in left:
            own.append(lateness.add(left[tick["due"]], tick["left"]))
            response.append(1e3 * (tick["left"] - left[tick["due"]]))
    return own, response


def _percentiles(values: list[float]) -> dict[str, float] | None:
    """Of some times; None for none."""
    if not values:
        return None
    found = np.quantile(values, (0.5, 0.99, 0.999, 1.0)).round(3).tolist()
    return dict(zip(("p50", "p99", "p99.9", "max"), found, strict=True))


def stages(x: np.ndarray, modes: list[int]) -> dict[str, bool] | None:
    """Stages of the flip in states (n, 37) and the modes chosen at them; None for no states."""
    if len(x) < 2:
        return None
    states = torch.from_numpy(np.vstack([x, x[-1:]]))
    found = judge(states, torch.tensor(modes), DT, HAND)
    return {**vars(found), "success": found.success}


def _true(path: Path, hybrid: list[dict[str, Any]]) -> dict[str, bool] | None:
    """Stages of what really happened at the ticks of the hybrid phase."""
    known, x = _meet(path, hybrid)
    return stages(x, [tick["mode"] for tick in known])


def accuracy(path: Path, hybrid: list[dict[str, Any]]) -> dict[str, float] | None:
    """How far the estimate was from the truth at the ticks of the hybrid phase; None where there are none.

    Velocity in the body frame [m/s], as a heading cannot be known; height [m]; tilt, the error of gravity's
    direction [deg]; heading [rad] and place [m], which cannot be known: how far they drifted. `sigmas`: in
    standard deviations, of velocity and tilt the root mean square over axes and ticks, 1 where the covariance
    is right; of a drift those of what was added since the first tick.
    """
    known, x = _meet(path, hybrid)
    if not known:
        return None
    estimate, variance = (np.array([tick[name] for tick in known]) for name in ("x", "variance"))
    told, true = (np.array([matrix(q) for q in each[:, 3:7]]) for each in (estimate, x))
    height = np.abs(estimate[:, 2] - x[:, 2])
    body = np.einsum("nij,ni->nj", told, estimate[:, 19:22]) - np.einsum("nij,ni->nj", true, x[:, 19:22])
    # in the world that the estimate has, as the variances are; world z by the true attitude is z - phi x z
    velocity, up = np.einsum("nij,nj->ni", told, body), np.einsum("nij,nj->ni", told, true[:, 2])
    tilt = up[:, :2]

    def sigmas(error: np.ndarray, of: slice) -> float:
        return round(float(np.sqrt(np.mean(error**2 / np.maximum(variance[:, of], 1e-12)))), 2)

    # the turn from the true world to the estimate's
    turn = np.einsum("nij,nkj->nik", told, true)
    heading = np.unwrap(np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1]))
    c, s = math.cos(heading[0]), math.sin(heading[0])
    place = estimate[-1, :2] - estimate[0, :2] - np.array([[c, -s], [s, c]]) @ (x[-1, :2] - x[0, :2])

    def drift(name: str, error: float, *of: int) -> dict[str, float]:
        added = max(float((variance[-1] - variance[0])[list(of)].sum()), 1e-12)
        return {f"{name}_last": round(error, 3), f"{name}_sigmas": round(error / math.sqrt(added), 2)}

    return {
        "velocity_rms": round(float(np.sqrt(np.mean(np.sum(velocity**2, 1)))), 4),
        "velocity_sigmas": sigmas(velocity, V),
        "tilt_rms": round(float(np.degrees(np.sqrt(np.mean(np.sum(tilt**2, 1))))), 3),
        "tilt_sigmas": sigmas(tilt[:, ::-1], slice(0, 2)),
        "height_max": round(float(height.max()), 4),
        "height_last": round(float(height[-1]), 4),
        "height_sigmas_max": round(
            float((height / np.sqrt(np.maximum(variance[:, R.stop - 1], 1e-12))).max()), 2
        ),
        **drift("heading", float(abs(heading[-1] - heading[0])), PHI.stop - 1),
        **drift("place", float(np.hypot(*place)), R.start, R.start + 1),
    }


def _meet(path: Path, hybrid: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], np.ndarray]:
    """The ticks at which the truth is known, and it, (n, 37)."""
    with np.load(path) as truth:
        row = {int(tick): i for i, tick in enumerate(truth["tick"])}
        known = [tick for tick in hybrid if tick["ms"] in row]
        rows = [row[tick["ms"]] for tick in known]
        x = np.hstack([truth["qpos"][rows], truth["qvel"][rows]]) if rows else np.empty((0, 37))
    return known, x


def _runs(hybrid: list[dict[str, Any]]) -> str:
    """Modes that ran, with their durations."""
    runs: list[tuple[int, int]] = []
    for tick in hybrid:
        if runs and runs[-1][0] == tick["mode"]:
            runs[-1] = (runs[-1][0], runs[-1][1] + 1)
        else:
            runs.append((tick["mode"], 1))
    return " | ".join(f"{NAMES[mode]} {0.001 * TICK * n:.2f} s" for mode, n in runs if mode != NONE)


def write(path: Path, summary: dict[str, Any]) -> None:
    """Write it as JSON."""
    path.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
