"""How a foot that bears load is allowed to move, by hand."""

from __future__ import annotations

import math

import pytest

from deploy.footing import Footing, FootingCfg

CFG, DT = FootingCfg(), 0.002
FULL, NONE = 80.0, 0.0


def bearing(load: float, mean: float = FULL, seconds: float = 1.0) -> Footing:
    """A foot that has borne so much for a while, of a robot whose feet bear `mean` on average."""
    footing = Footing(CFG)
    for _ in range(round(seconds / DT)):
        footing.bear(load, mean, DT)
    return footing


def test_a_foot_gives_way_to_its_load_with_a_lag():
    assert bearing(FULL).load == pytest.approx(FULL)
    after = CFG.give_time / DT  # ticks of implicit Euler
    assert bearing(FULL, seconds=10 * DT).load == pytest.approx(FULL * (1 - (1 + 1 / after) ** -10))


def test_a_foot_that_bears_its_share_stays_where_it_is():
    assert bearing(FULL).loose(1e-10, DT) == pytest.approx((0.0, 0.0), abs=1e-20)


@pytest.mark.parametrize(
    ("share", "speed"),
    [(0.0, CFG.light), (0.5 * CFG.light_share, 0.5 * CFG.light), (CFG.light_share, 0.0), (2.0, 0.0)],
)
def test_a_foot_that_bears_little_may_slide(share, speed):
    across, down = bearing(share * FULL).loose(0.0, DT)
    assert across == pytest.approx(speed**2 * CFG.slide_time)
    assert down == 0.0


def test_a_foot_that_seems_to_slide_walks_as_far_as_it_would():
    footing, variance, noise = bearing(FULL), 1e-4, 4e-4
    for _ in range(100):
        footing.slide(0.3, -0.4, variance, noise, DT)
    part = DT / (DT + CFG.slide_time)
    beyond = 0.25 - CFG.slide_gate * (variance + part * noise)
    assert footing.loose(0.0, DT)[0] == pytest.approx(0.5 * beyond * CFG.slide_time)


def test_noise_is_no_slide():
    footing = bearing(FULL)
    for k in range(100):
        footing.slide(0.015 * (-1) ** k, 0.0, 0.0, 0.015**2, DT)
    assert footing.loose(0.0, DT)[0] == 0.0


def test_a_landing_is_over_after_a_while_and_forgets_the_slide_before_it():
    footing = bearing(FULL)
    footing.slide(1.0, 0.0, 0.0, 0.0, DT)
    footing.touch_down(-0.5)
    footing.slide(0.0, 0.0, 0.0, 0.0, DT)
    across, down = footing.loose(0.0, DT)
    assert across == pytest.approx(CFG.settle**2 * math.exp(-2 * DT / CFG.settle_time) * CFG.settle_time)
    fallen = math.exp(-2 * DT / CFG.bounce_time) * CFG.bounce_time
    assert down == pytest.approx((CFG.bounce * 0.5) ** 2 * fallen)
    for _ in range(200):
        across, down = footing.loose(0.0, DT)
    assert max(across, down) < 1e-12


def test_a_foot_does_not_bounce_off_ground_that_it_leaves():
    footing = Footing(CFG)
    footing.touch_down(0.5)
    assert footing.bounces == 0.0


def test_a_load_that_changes_moves_a_foot_by_what_is_not_known_of_it():
    footing, give = bearing(FULL), 64e-12
    footing.bear(NONE, FULL, DT)
    rate = -FULL / (DT + CFG.give_time)
    expected = give * (CFG.give_share * rate) ** 2 * CFG.give_time
    assert footing.loose(give, DT)[1] == pytest.approx(expected)


def test_a_load_without_a_number_changes_nothing():
    footing = bearing(30.0)
    before = footing.load, footing.loose(1e-10, DT)
    footing.bear(math.nan, FULL, DT)
    footing.bear(30.0, math.nan, DT)
    assert (footing.load, footing.loose(1e-10, DT)) == before
