"""The stand-in's faults: how often, what of a frame, and the orders that switch them on while it runs."""

from __future__ import annotations

import json
import socket

import numpy as np
import pytest

from deploy.codec import COMMAND_SIZE, decode_command, decode_state, encode_command, encode_state
from deploy.remote import Button
from tests import wire
from tools.robot.faults import Faults, Way
from tools.robot.orders import Desk, obey
from tools.robot.standin import StandIn, ideal

COUNT = 2000


def arrivals(faults: Faults, delay: int = 0) -> list[list[int]]:
    """Ticks of the frames that arrive in each step, when frame i is sent in step i."""
    way = Way(faults, delay, 0.002, np.random.default_rng(0))
    frames = [encode_state(wire.state()._replace(tick=i)) for i in range(COUNT)]
    return [[decode_state(frame).tick for frame in way.send([frame])] for frame in frames]


def test_no_fault_changes_nothing() -> None:
    assert arrivals(Faults()) == [[i] for i in range(COUNT)]


def test_delay() -> None:
    assert arrivals(Faults(), delay=3) == [[]] * 3 + [[i] for i in range(COUNT - 3)]


def test_drop() -> None:
    found = [ticks for step in arrivals(Faults(drop=0.1)) for ticks in step]
    assert found == sorted(set(found))
    assert pytest.approx(len(found), rel=0.03) == 0.9 * COUNT


def test_duplicate() -> None:
    found = arrivals(Faults(duplicate=0.1))
    assert all(step in ([i], [i, i]) for i, step in enumerate(found))
    assert sum(len(step) - 1 for step in found) == pytest.approx(0.1 * COUNT, rel=0.2)


def test_late() -> None:
    """Out of order: a stall of 10 ms puts a frame five steps behind."""
    found = arrivals(Faults(late=0.1, stall=0.01))
    late = [tick for i, step in enumerate(found) for tick in step if tick != i]
    assert all(tick in found[tick + 5] for tick in late)
    assert len(late) == pytest.approx(0.1 * COUNT, rel=0.2)


def test_faults_do_not_change_each_others_pattern() -> None:
    only = [len(step) for step in arrivals(Faults(drop=0.1))]
    both = [len(step) for step in arrivals(Faults(drop=0.1, corrupt=0.5, nan=0.2))]
    assert only == both


def test_corrupt() -> None:
    way = Way(Faults(corrupt=0.5), 0, 0.002, np.random.default_rng(0))
    frame = encode_command(wire.command())
    sent = [way.send([frame])[0] for _ in range(COUNT)]
    assert sum(it != frame for it in sent) == pytest.approx(0.5 * COUNT, rel=0.1)
    good = [decode_command(it).crc_ok for it in sent if it != frame]
    assert np.mean(good) < 0.01  # but for what hits padding alone


@pytest.mark.parametrize("frame", [encode_command(wire.command()), encode_state(wire.state())], ids=len)
def test_nan_comes_under_a_good_checksum(frame: bytes) -> None:
    way = Way(Faults(nan=1.0), 0, 0.002, np.random.default_rng(0))
    places = set()
    for _ in range(200):
        (sent,) = way.send([frame])
        if len(frame) == COMMAND_SIZE:
            command = decode_command(sent)
            intact, numbers = command.crc_ok, np.concatenate(command.motors[:5])
        else:
            state = decode_state(sent)
            intact, numbers = state.crc_ok, np.concatenate(state[1:8])
        assert intact
        assert np.isnan(numbers).sum() == 1
        places.add(int(np.isnan(numbers).argmax()))
    assert len(places) > 20


@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_probabilities(value: float) -> None:
    with pytest.raises(ValueError, match=f"drop of frames must be 0 to 1, got {value}"):
        Faults(drop=value)


def test_orders() -> None:
    robot = StandIn(ideal())
    obey(robot, '{"states": {"drop": 0.25}, "commands": {"late": 0.5, "stall": 0.02}, "loss": "damp"}')
    assert robot.states.faults == Faults(drop=0.25)
    assert robot.commands.faults == Faults(late=0.5, stall=0.02)
    assert robot.loss == "damp"
    obey(
        robot,
        '{"stuck": {"RL": 40}, "strength": {"FL_calf": 0}, "remote": {"buttons": ["L2", "B"], "ry": 1}}',
    )
    assert robot.feet.stuck == {2: 40}
    assert robot.motors.strength.tolist() == [1, 1, 0] + [1] * 9
    assert (robot.remote.buttons, robot.remote.ry) == (Button.L2 | Button.B, 1)
    obey(robot, '{"states": {}, "stuck": {}, "strength": {}, "remote": {}}')
    assert (robot.states.faults, robot.feet.stuck, robot.remote.buttons) == (Faults(), {}, Button(0))
    assert (robot.motors.strength == 1).all()


def test_push_order() -> None:
    robot = StandIn(ideal())
    obey(robot, '{"push": [0, 80, 0, 0.05]}')
    for _ in range(25):
        robot.step([])
    assert robot.truth().qvel[1] > 0.03


@pytest.mark.parametrize(
    ("order", "told"),
    [
        ('{"pull": 1}', "no order 'pull': there are push, strength"),
        ("[1]", "an order is a JSON object"),
        ("{", "Expecting property name"),
        ('{"push": 3}', "order 'push' does not take 3"),
        ('{"push": [1, 2, 3]}', "three finite forces"),
        ('{"stuck": {"XX": 0}}', "no foot XX: there are FL, FR, RL, RR"),
        ('{"states": {"drops": 1}}', "order 'states' does not take .*drops"),
        ('{"loss": "dance"}', "one of hold, damp, limp"),
        ('{"remote": {"buttons": ["Z"]}}', "order 'remote' does not take .*'Z'"),
        ('{"remote": ["L2", "B"]}', "order 'remote' does not take "),
        ('{"remote": {"lx": null}}', "order 'remote' does not take .*float"),
        ('{"remote": {"lx": 1e40}}', "order 'remote' does not take .*too large"),
        ('{"strength": 0.5}', "order 'strength' does not take 0.5"),
        ('{"stuck": ["FL"]}', "order 'stuck' does not take "),
        ('{"stuck": {"FL": 40000}}', "a foot's counts are -32768 to 32767, got 40000"),
        ('{"stuck": {"FL": 1e400}}', "order 'stuck' does not take .*infinity"),
        ('{"push": [50, 0, 0.1]}', "three finite forces"),
        ('{"push": [NaN, 0, 0, 0.1]}', "three finite forces"),
        ('{"push": [50, 0.1]}', "three finite forces"),
        pytest.param("[" * 50_000, "nested too deeply", id="nested"),
        pytest.param('{"loss": "' + 60_000 * "x" + '"}', "one of hold, damp, limp", id="long"),
    ],
)
def test_wrong_orders(order: str, told: str) -> None:
    """An error for who gave it, and nothing else: the robot goes on as it would have."""
    robot, other, desk = StandIn(ideal()), StandIn(ideal()), Desk(0)
    with pytest.raises(ValueError, match=told):
        obey(robot, order)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(2)
        client.sendto(order.encode(), ("127.0.0.1", desk.port))
        desk.serve(robot)
        assert json.loads(client.recv(65536)).keys() == {"error"}
    desk.close()
    assert [robot.step([]) for _ in range(5)] == [other.step([]) for _ in range(5)]
    assert np.array_equal(robot.truth().qpos, other.truth().qpos)


def test_desk_answers() -> None:
    robot, desk = StandIn(ideal()), Desk(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(2)
        client.connect(("127.0.0.1", desk.port))
        for order in ('{"states": {"drop": 0.5}}', "nonsense", "\ufffd"):
            client.send(order.encode("utf-8") if order != "\ufffd" else b"\xff\xfe")
            desk.serve(robot)
            answer = json.loads(client.recv(65536))
            assert ("error" in answer) == (order[0] != "{")
            assert robot.states.faults == Faults(drop=0.5)
    desk.close()
