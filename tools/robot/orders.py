"""Orders to a running stand-in: faults and the operator's remote, as JSON objects over UDP."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, get_args

from deploy.remote import Button, Remote, pack
from hmc.go2.facts import LEGS
from tools.robot.faults import Faults
from tools.robot.sensors import COUNTS
from tools.robot.standin import Loss, StandIn


def obey(robot: StandIn, order: str) -> dict[str, Any]:
    """Carry out an order, and say how the robot is.

    An order is a JSON object of any of these; each replaces what was before it:

    ==========  ==========================================  ===============================================
    push        [fx, fy, fz, seconds]                       force on the trunk [N], world frame
    strength    {"FL_calf": 0, "R*": 0.7}                   part of the torque that comes out, 1 for others
    stuck       {"FL": 0}                                   counts that a foot tells, whatever happens
    remote      {"buttons": ["L2", "B"], "lx": 0.5}         what the operator presses
    states      {"drop": 0.01}                              faults of state frames, see `Faults`
    commands    {"late": 0.01, "stall": 0.02}               faults of command frames
    loss        "hold", "damp" or "limp"                    what the motors do when commands stop
    ==========  ==========================================  ===============================================

    Raises:
        ValueError: not such an object; what stands before the fault in it was carried out, and nothing of
            the fault's own.
    """
    try:
        found = json.loads(order)
    except RecursionError:
        raise ValueError("an order is a JSON object, got one that is nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f'an order is a JSON object such as {{"push": [50, 0, 0, 0.1]}}, got {order}')
    for name, value in found.items():
        if name not in ORDERS:
            raise ValueError(f"no order {name!r}: there are {', '.join(ORDERS)}")
        try:
            ORDERS[name](robot, value)
        except (TypeError, KeyError, AttributeError, OverflowError, struct.error) as error:
            raise ValueError(f"order {name!r} does not take {value!r}: {error}") from None
    truth = robot.truth()
    return {
        "tick": truth.tick,
        "released": truth.released,
        "accepted": truth.accepted,
        "refused": dict(robot.refused),
        "states": asdict(robot.states.faults),
        "commands": asdict(robot.commands.faults),
    }


def _push(robot: StandIn, value: list[float]) -> None:
    *force, duration = value
    robot.push(force, duration)


def _strength(robot: StandIn, value: dict[str, float]) -> None:
    robot.motors.weaken(value)


def _stuck(robot: StandIn, value: dict[str, int]) -> None:
    if unknown := set(value) - set(LEGS):
        raise ValueError(f"no foot {', '.join(sorted(unknown))}: there are {', '.join(LEGS)}")
    stuck = {LEGS.index(foot): int(counts) for foot, counts in value.items()}
    low, high = COUNTS
    if beyond := [counts for counts in stuck.values() if not low <= counts <= high]:
        raise ValueError(f"a foot's counts are {low} to {high}, got {beyond[0]}")
    robot.feet.stuck = stuck


def _remote(robot: StandIn, value: dict[str, Any]) -> None:
    buttons = Button(0)
    for name in value.get("buttons", ()):
        buttons |= Button[name]
    remote = Remote(**{**value, "buttons": buttons})
    pack(remote)  # or the next state could not be told
    robot.remote = remote


def _states(robot: StandIn, value: dict[str, float]) -> None:
    robot.states.faults = Faults(**value)


def _commands(robot: StandIn, value: dict[str, float]) -> None:
    robot.commands.faults = Faults(**value)


def _loss(robot: StandIn, value: Loss) -> None:
    if value not in get_args(Loss):
        raise ValueError(f"loss is one of {', '.join(get_args(Loss))}, got {value!r}")
    robot.loss = value


ORDERS: dict[str, Callable[[StandIn, Any], None]] = {
    "push": _push,
    "strength": _strength,
    "stuck": _stuck,
    "remote": _remote,
    "states": _states,
    "commands": _commands,
    "loss": _loss,
}


_LONGEST = 2000  # characters of an error: it tells the order again, and has to fit into a datagram


class Desk:
    """Where orders come in: a UDP port of this machine alone; each datagram is an order, and is answered.

    Args:
        port: 0 for any free one.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, port: int):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._socket.getsockname()[1])

    def serve(self, robot: StandIn) -> None:
        """Carry out the orders that have come."""
        while True:
            try:
                octets, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                return
            try:
                answer = obey(robot, octets.decode())
            except ValueError as error:
                answer = {"error": str(error)[:_LONGEST]}
            self._socket.sendto(json.dumps(answer).encode(), sender)

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()
