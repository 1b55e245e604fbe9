"""Which of the robot's own controllers runs: the motion switcher service, from both of its sides.

While one does, the robot ignores rt/lowcmd. Requests and answers are messages on two topics; an answer
repeats its request's number, and carries JSON text and a code that is 0 when all went well.

Source: unitree_sdk2's motion switcher client and its list of codes.
"""

from __future__ import annotations

import itertools
import json
import time
from typing import TypeVar

from deploy.dds import Link
from deploy.messages import (
    Request_,
    RequestHeader_,
    RequestIdentity_,
    Response_,
    ResponseHeader_,
    ResponseStatus_,
)

REQUEST, RESPONSE = "rt/api/motion_switcher/request", "rt/api/motion_switcher/response"
CHECK_MODE, SELECT_MODE, RELEASE_MODE = 1001, 1002, 1003
OK, NOT_IMPLEMENTED, BAD_PARAMETER = 0, 3203, 3204
_MEANING = {NOT_IMPLEMENTED: "it has no such function", BAD_PARAMETER: "it does not take this parameter"}
RESEND = 0.5  # s without an answer


class MotionSwitcherError(RuntimeError):
    """The motion switcher did not answer, or refused."""


class MotionSwitcher:
    """The robot's motion switcher, seen from a controller.

    Args:
        link: where the robot is.
        timeout: how long to wait for the service and for each answer [s].
    """

    def __init__(self, link: Link, timeout: float = 3.0):
        self._requests = link.publisher(REQUEST, Request_)
        self._responses = link.subscriber(RESPONSE, Response_, reliable=True)
        self._timeout = timeout
        # numbers of requests that no other client uses, nor this one after a restart
        self._numbers = itertools.count(time.monotonic_ns())

    def active(self) -> str:
        """Name of the controller that runs, such as "mcf"; empty when none does and the motors are free."""
        data = self._call(CHECK_MODE, "CheckMode", {})
        try:
            return str(json.loads(data)["name"])
        except (ValueError, KeyError, TypeError):
            raise MotionSwitcherError(
                f'the motion switcher answered CheckMode with {data!r}, expected JSON like {{"name": ""}}: '
                "is its firmware another version's?"
            ) from None

    def select(self, name: str) -> None:
        """Start one of the robot's own controllers."""
        self._call(SELECT_MODE, "SelectMode", {"name": name})

    def release(self, attempts: int = 5, pause: float = 1.0) -> None:
        """Stop the robot's own controllers, until none runs. They let go of the legs: lie down before.

        Args:
            attempts: how often to ask.
            pause: what the robot gets for each [s].

        Raises:
            MotionSwitcherError: one still runs.
        """
        for _ in range(attempts):
            if not self.active():
                return
            self._call(RELEASE_MODE, "ReleaseMode", {})
            deadline = time.monotonic() + pause
            while self.active() and time.monotonic() < deadline:
                time.sleep(0.02)
        if name := self.active():
            raise MotionSwitcherError(
                f"the robot's own controller {name!r} still runs after {attempts} requests to release it: "
                "stop it in Unitree's app, or restart the robot"
            )

    def _call(self, function: int, name: str, parameter: dict[str, str]) -> str:
        """The data of the answer to a request."""
        deadline = time.monotonic() + self._timeout
        self._meet(deadline, name)
        identity = RequestIdentity_(next(self._numbers), function)
        request = Request_(RequestHeader_(identity), json.dumps(parameter)).serialize()
        while time.monotonic() < deadline:
            # a service that has not found us yet hears nothing; to hear a request twice does no harm
            self._requests.write(request)
            for octets in self._responses.take(RESEND):
                answer = _understood(Response_, octets)
                if answer is not None and answer.header.identity == identity:
                    return _accepted(answer, f"{name} {parameter}")
        raise MotionSwitcherError(
            f"the motion switcher did not answer {name} within {self._timeout:g} s: is the robot still "
            "starting, or another program calling its services?"
        )

    def _meet(self, deadline: float, name: str) -> None:
        """Wait for the service to be found."""
        while not (self._requests.peers and self._responses.peers):
            if time.monotonic() > deadline:
                raise MotionSwitcherError(
                    f"found no motion switcher within {self._timeout:g} s to call {name}: is the robot on, "
                    "and are the DDS domain and the network interface right (0 and its cable's; 1 and lo "
                    "for the stand-in)?"
                )
            time.sleep(0.01)


class MotionSwitcherService:
    """The motion switcher of a stand-in: answers requests, runs no controller itself.

    Args:
        link: where controllers look for it.
        name: the robot's own controller that runs at first; empty for none.
    """

    def __init__(self, link: Link, name: str = "mcf"):
        self._requests = link.subscriber(REQUEST, Request_, reliable=True)
        self._responses = link.publisher(RESPONSE, Response_)
        self.name = name

    def serve(self, timeout: float = 0.0) -> None:
        """Answer the requests that have come, waiting so long for the first one [s]."""
        for octets in self._requests.take(timeout):
            request = _understood(Request_, octets)
            if request is None:
                continue
            code, data = self._answer(request.header.identity.api_id, request.parameter)
            if not request.header.policy.noreply:
                header = ResponseHeader_(request.header.identity, ResponseStatus_(code))
                self._responses.write(Response_(header, data).serialize())

    def _answer(self, function: int, parameter: str) -> tuple[int, str]:
        """Code and data of the answer to a request."""
        if function == CHECK_MODE:
            return OK, json.dumps({"form": "0", "name": self.name})
        if function == RELEASE_MODE:
            self.name = ""
            return OK, ""
        if function != SELECT_MODE:
            return NOT_IMPLEMENTED, ""
        try:
            self.name = str(json.loads(parameter)["name"])
        except (ValueError, KeyError, TypeError):
            return BAD_PARAMETER, ""
        return OK, ""


M = TypeVar("M", Request_, Response_)


def _understood(kind: type[M], octets: bytes) -> M | None:
    """The message, or None where the octets are none of its kind, such as text that is not UTF-8."""
    try:
        return kind.deserialize(octets)
    except Exception:  # cyclonedds has no type of its own for what is wrong with octets
        return None


def _accepted(answer: Response_, request: str) -> str:
    """The answer's data, or MotionSwitcherError if the request was refused."""
    if (code := answer.header.status.code) != OK:
        meaning = _MEANING.get(code, "see Unitree's list of codes")
        raise MotionSwitcherError(f"the motion switcher refused {request} with code {code}: {meaning}")
    return answer.data
