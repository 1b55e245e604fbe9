"""Contact of a foot: hysteresis, a zero that drifts, a sensor that is stuck."""

from __future__ import annotations

import math

from deploy.contact import ContactCfg, Fall, FallCfg, FootContact

DT = 0.002
CFG = ContactCfg()


def feed(foot: FootContact, force: float, load: float, seconds: float) -> list[bool]:
    return [foot.update(force, load, DT) for _ in range(round(seconds / DT))]


def test_hysteresis():
    foot = FootContact(CFG)
    middle = 0.5 * (CFG.on + CFG.off)
    assert not foot.update(middle, math.nan, DT)
    assert foot.update(CFG.on + 1, math.nan, DT)
    assert foot.update(middle, math.nan, DT)
    assert not foot.update(CFG.off - 1, math.nan, DT)
    assert not foot.update(middle, math.nan, DT)


def test_a_drifting_zero_is_followed_while_the_foot_hangs():
    foot = FootContact(CFG)
    for k in range(5000):
        assert not foot.update(18.0 * k / 5000, 0.0, DT)
    assert not foot.update(CFG.on + 2.0, 0.0, DT), "what reads 22 now is 4 above its zero"
    assert foot.update(CFG.on + 20.0, 75.0, DT)


def test_a_zero_between_the_thresholds_does_not_keep_a_hanging_foot_on_the_ground():
    """It is not known before the foot first hangs; 16 counts would otherwise be a contact for good."""
    foot, zero = FootContact(CFG), 0.5 * (CFG.on + CFG.off)
    assert all(feed(foot, 75.0 + zero, 75.0, 1.0))
    assert not any(feed(foot, zero, 0.0, 1.0))
    assert not any(feed(foot, zero + CFG.off - 2.0, 0.0, 0.1)), "by now the zero is known"
    assert all(feed(foot, 75.0 + zero, 75.0, 1.0))


def test_contact_is_firm_if_both_senses_tell_it():
    for force, load, firm in ((75.0, 75.0, True), (75.0, 0.0, False), (0.0, 75.0, False)):
        foot = FootContact(CFG)
        foot.update(force, load, DT)
        assert foot.firm is firm


def test_the_zero_does_not_follow_a_load():
    foot = FootContact(CFG)
    assert all(feed(foot, 30.0, 75.0, 5.0))


def test_a_sensor_stuck_at_zero_hands_over_to_the_torques():
    foot = FootContact(CFG)
    seen = feed(foot, 0.0, 75.0, 1.0)
    assert not seen[0]
    assert seen.index(True) * DT <= CFG.stuck + 2 * DT
    assert foot.stuck
    assert not foot.update(0.0, 0.0, DT), "and the torques tell of the lift-off too"


def test_a_sensor_stuck_at_a_load_hands_over_to_the_torques():
    foot = FootContact(CFG)
    feed(foot, 75.0, 75.0, 0.5)
    assert not foot.stuck
    seen = feed(foot, 75.0, 0.0, 1.0)
    assert seen.index(False) * DT <= CFG.stuck + 2 * DT
    assert foot.stuck


def test_a_mended_sensor_is_believed_again():
    foot = FootContact(CFG)
    feed(foot, 0.0, 75.0, 1.0)
    assert foot.stuck
    feed(foot, 75.0, 75.0, 2.0)
    assert not foot.stuck


def test_a_swing_with_torques_of_its_own_is_no_contact():
    """In the air a leg's inertia asks for torque, for less than the time that makes a sensor stuck."""
    foot = FootContact(CFG)
    assert not any(feed(foot, 0.0, 60.0, 0.8 * CFG.stuck))
    assert not foot.stuck


def test_no_reading_leaves_it_to_the_torques():
    foot = FootContact(CFG)
    feed(foot, 75.0, 75.0, 0.1)
    assert foot.update(math.nan, 75.0, DT)
    assert not foot.update(math.nan, 0.0, DT)
    assert foot.update(75.0, 75.0, DT)


def doubts(fall: Fall, seconds: float, used: bool, contact: bool = True, lowest: float = 0.0) -> list[bool]:
    return [fall.update(used, contact, lowest, DT) for _ in range(round(seconds / DT))]


def test_an_estimate_is_lost_when_no_foot_agrees_for_long():
    fall, time = Fall(FallCfg()), FallCfg().time
    assert not any(doubts(fall, time - 2 * DT, used=False))
    assert any(doubts(fall, 4 * DT, used=False))


def test_a_flight_is_no_fall():
    fall = Fall(FallCfg())
    assert not any(doubts(fall, 0.5, used=False, contact=False, lowest=0.4))
    assert not any(doubts(fall, 0.5, used=True))
    assert not any(doubts(fall, 0.5, used=False, contact=False, lowest=0.4))


def test_a_body_that_floats_on_its_feet_or_sinks_is_lost():
    for lowest in (0.3, -0.3, math.nan):
        assert any(doubts(Fall(FallCfg()), 1.0, used=True, lowest=lowest))
    assert not any(doubts(Fall(FallCfg()), 1.0, used=True, lowest=0.05))


def test_feet_that_agree_half_of_the_time_do_not_lose_the_estimate():
    fall = Fall(FallCfg())
    assert not any(fall.update(k % 2 == 0, True, 0.0, DT) for k in range(2000))
