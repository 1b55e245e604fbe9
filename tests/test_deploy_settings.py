"""Settings of the deployment: what a robot cannot be told in earnest is refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.settings import DeployCfg
from hmc.cfg import CfgError, load

FILE = Path("cfg/deploy.toml")
REFUSED = {
    "output.damping=-5": "output: damping must be 1 to 20, got -5",
    "output.damping=0": "output: damping must be 1 to 20, got 0",
    "output.damping=500": "output: damping must be 1 to 20, got 500",
    "output.step=0": "output: step must be 0.001 to ",
    "lie.kp=-30": "lie: kp must be 0 to 200, got -30",
    "stand.kp=201": "stand: kp must be 0 to 200, got 201",
    "stand.kd=21": "stand: kd must be 0 to 20, got 21",
    "lie.step=-0.1": "lie: step must be 0.001 to ",
    "lie.seconds=0": "lie: seconds must be 0.001 to 3600, got 0",
    "stand.seconds=inf": "stand: seconds must be 0.001 to 3600, got inf",
    "stand.pose=[0.0, 0.9, -0.8]": "stand: pose of the calf must be -2.7227 to -0.83776, got -0.8",
    "lie.pose=[0.0, -0.6, -2.0]": "lie: pose of the thigh must be -0.5236 to 3.4907, got -0.6",  # the rear's
    "plan.quantile=2": "plan: quantile must be 0 to 1, got 2",
    "plan.longest=-3": "plan: longest must be 1 to 128, got -3",
    "plan.expires=0": "plan: expires must be 1 to 128, got 0",
    "watchdog.period=-1": "watchdog: period must be 0.001 to 0.1, got -1",
    "watchdog.hang=0": "watchdog: hang must be 0.001 to 3600, got 0",
    "watchdog.lost=inf": "watchdog: lost must be 0.001 to 3600, got inf",
    "input.temperature=inf": "input: temperature must be 0 to 255, got inf",
    "input.max_age=-0.1": "input: max_age must be 0.001 to 3600, got -0.1",
    "input.min_charge=101": "input: min_charge must be 0 to 100, got 101",
    "envelope.foot.patience=inf": "envelope.foot: patience must be 0 to 3600, got inf",
    "envelope.ready.pitch=[25,-25]": "pitch must rise from its least to its most, got 25 to -25",
    "envelope.hand.height=[0.3, inf]": "envelope.hand: height must be -10 to 10, got inf",
    "envelope.hand.joint_low=[2, -1.65, -2.8]": "joint_low to joint_high of the hip must rise",
    "envelope.hand.lean=-1": "envelope.hand: lean must be 0 to 180, got -1",
}


@pytest.mark.parametrize("setting", REFUSED)
def test_what_is_not_sensible_is_named(setting: str) -> None:
    with pytest.raises(CfgError) as refused:
        load(FILE, DeployCfg, (setting,))
    assert f"{setting}: " in str(refused.value)
    assert REFUSED[setting] in str(refused.value)


def test_limits_that_outlive_the_pauses_of_a_machine_are_allowed() -> None:
    words = ["input.temperature=250", "input.max_age=0.3", "input.stall=0.5"]
    words += ["watchdog.hang=0.3", "watchdog.stall=0.5", "watchdog.lost=0.3"]
    cfg = load(FILE, DeployCfg, words)
    assert (cfg.input.temperature, cfg.watchdog.lost) == (250.0, 0.3)
