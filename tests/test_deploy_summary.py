"""What a run came to: memory, and the estimate against the truth."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import pytest

from deploy import memory, so3, timing
from deploy.ekf import N, R, V
from deploy.memory import Memory
from deploy.summary import _percentiles, accuracy, responses
from deploy.timing import Stolen
from hmc.go2.stances import FOOTSTAND


def test_memory_is_the_most_in_a_minute_once_it_is_warm(monkeypatch):
    """What is taken for a moment counts in its minute, whenever somebody looks; what is kept counts on."""
    now = [0.0]
    monkeypatch.setattr("deploy.memory.time.monotonic", lambda: now[0])
    it = Memory()
    it.look()  # nothing is there to look at yet
    it.begin({"this": os.getpid(), "none": 2**22 - 1})

    def after(seconds: float) -> None:
        now[0] += seconds
        it.look()

    def after_a_minute() -> None:
        for _ in range(memory.WINDOW):
            after(memory.EVERY)

    after(memory.WARM / 2)
    assert it.found == {}
    after(memory.WARM / 2)
    base, _ = it.found["this"]
    assert base > 10
    assert np.ones(2**23).any(), "64 MiB, gone before the next look"
    after(memory.EVERY / 2)  # too soon
    assert it.found["this"] == (base, base)
    after_a_minute()
    first, last = it.found["this"]
    assert base + 60 < first == last < base + 100
    after_a_minute()
    after_a_minute()
    assert it.found["this"][0] == first
    assert it.found["this"][1] == pytest.approx(base, abs=10)
    kept = np.ones(2**24)  # 128 MiB
    after(memory.EVERY)
    assert it.found["this"][1] == pytest.approx(base + 128, abs=20)
    assert "none" not in it.found
    assert kept.any()


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_the_estimate_against_the_truth(tmp_path, heading):
    """Off by (0.3, 0.4, 0) m/s and 10 mrad about x, by 2 cm at the end; sure to 0.1, 0.005, and 1 cm.

    The estimate's world may be turned about the vertical, and shifted: nobody can know its heading. By 0.03
    rad and half a metre more at the end than at first; it is so much more unsure by 0.01 and 0.2.
    """
    x = np.tile(FOOTSTAND.state().numpy(), (4, 1))
    x[:, 0] = np.arange(4.0)
    np.savez(tmp_path / "truth.npz", tick=[20, 40, 60, 80], qpos=x[:, :19], qvel=x[:, 19:])
    lean, at = so3.quaternion(np.array([0.01, 0.0, 0.0])), so3.exp(np.array([0.0, 0.0, heading]))
    ticks: list[dict[str, Any]] = []
    for i in range(4):
        told, variance = x[i].copy(), np.full(N, 7.0)
        last = float(i == 3)
        turn = so3.quaternion(np.array([0.0, 0.0, heading + 0.03 * last]))
        told[:3] = at @ told[:3] + last * np.array([0.3, -0.4, 0.0])
        told[3:7] = so3.multiply(turn, so3.multiply(lean, told[3:7]))
        told[19:22] = so3.matrix(turn) @ (told[19:22] + np.array([0.3, 0.4, 0.0]))
        told[2] += 0.02 if i == 3 else -0.001
        variance[:2], variance[V] = 0.005**2, 0.01
        variance[2], variance[R] = 1.0 + 1e-4 * last, (9.0, 9.0 + 0.04 * last, 1e-4)
        ticks.append({"ms": 20 * (i + 1), "x": told.tolist(), "variance": variance.tolist()})
    ticks.append({**ticks[0], "ms": 999})  # whose truth is not known
    found = accuracy(tmp_path / "truth.npz", ticks)
    expected = {
        "velocity_rms": 0.5,
        "velocity_sigmas": math.sqrt((3.0**2 + 4.0**2) / 3.0),
        "tilt_rms": math.degrees(0.01),
        "tilt_sigmas": math.sqrt(2.0**2 / 2.0),
        "height_max": 0.02,
        "height_last": 0.02,
        "height_sigmas_max": 2.0,
        "heading_last": 0.03,
        "heading_sigmas": 3.0,
        "place_last": 0.5,
        "place_sigmas": 2.5,
    }
    assert found == pytest.approx(expected, abs=0.006)
    assert accuracy(tmp_path / "truth.npz", ticks[4:]) is None


def test_what_the_stand_in_was_late_is_not_the_deployments(tmp_path):
    """Of three states one leaves 5 ms late; the commands follow 1, 1.5 and 4 ms after their states."""
    np.savez(tmp_path / "truth.npz", tick=[20, 40, 60], left=[7.020, 7.045, 7.060])
    ticks = [{"due": ms, "left": left} for ms, left in ((20, 7.021), (40, 7.0465), (60, 7.064), (999, 8.0))]
    own, response = responses(tmp_path / "truth.npz", ticks)
    assert response == pytest.approx([1.0, 1.5, 4.0])
    assert own == pytest.approx([0.0, 0.5, 3.0])
    assert _percentiles(own) == pytest.approx({"p50": 0.5, "p99": 2.95, "p99.9": 2.995, "max": 3.0})
    assert _percentiles([]) is None


def test_time_that_the_host_took(tmp_path, monkeypatch):
    stat = tmp_path / "stat"
    monkeypatch.setattr(timing, "_STAT", stat)
    assert Stolen().share is None, "a kernel that does not tell"
    stat.write_text("cpu  100 0 50 800 0 0 0 40 0 0\ncpu0 1 2 3\n", encoding="ascii")
    stolen = Stolen()
    assert stolen.share is None, "no time has passed"
    stat.write_text("cpu  160 0 60 810 0 0 0 60 0 0\ncpu0 1 2 3\n", encoding="ascii")
    assert stolen.share == pytest.approx(20 / 100)
