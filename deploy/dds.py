"""DDS transport: publishers and subscribers of whole frames, and who else publishes a topic.

Frames cross as octets. The message types only announce a topic's type to its peers: building their
objects costs a Python process about 0.3 ms a message, and `deploy.codec` reads what matters in 0.02 ms.
"""

from __future__ import annotations

import socket
from collections.abc import Collection
from functools import cache
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

ROBOT_DOMAIN, SIMULATION_DOMAIN = 0, 1
LOOPBACK = "lo"

# Cyclone DDS 0.10 never uses multicast on the loopback interface, 11 does: they find each other only by
# asking every port of the address in turn.
_ON_LOOPBACK = (
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>"
    '<Peers><Peer Address="127.0.0.1"/></Peers>'
)
# A process that was killed counts as there until its lease ends; 10 s, the default, delays a restart.
_CONFIG = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces>
<AllowMulticast>{multicast}</AllowMulticast></General>
<Discovery><LeaseDuration>3s</LeaseDuration>{discovery}</Discovery>
</Domain></CycloneDDS>"""

# Plain CDR is all that the robot's firmware reads. A writer offers reliability to whoever asks for it.
_REPRESENTATION = Policy.DataRepresentation(use_cdrv0_representation=True)
_RELIABLE = Policy.Reliability.Reliable(max_blocking_time=1_000_000)  # ns
_ALL = 1000  # endpoints of a domain that are new, at most


class LinkError(RuntimeError):
    """The network is not as the program was told."""


class Frame:
    """Octets in place of a message object, as cyclonedds sees them."""

    __slots__ = ("octets", "sample_info")

    def __init__(self, octets: bytes):
        self.octets = octets
        self.sample_info: Any = None  # set by cyclonedds

    def serialize(self, use_version_2: bool | None = None) -> bytes:
        """The octets: a frame was serialised before it came here."""
        del use_version_2
        return self.octets

    @classmethod
    def deserialize(cls, octets: bytes) -> Frame:
        """The frame as it came."""
        return cls(octets)

    deserialize_key = deserialize


class Publisher:
    """Sends frames on one topic; made by `Link.publisher`."""

    def __init__(self, participant: DomainParticipant, topic: Topic[Any]):
        self._topic: str = topic.name
        self._writer = DataWriter(
            participant, topic, Qos(_RELIABLE, Policy.History.KeepLast(1), _REPRESENTATION)
        )

    @property
    def peers(self) -> int:
        """How many subscribers were found so far."""
        return len(self._writer.get_matched_subscriptions())

    def write(self, frame: bytes) -> None:
        """Send a frame, encapsulation header included; it does not wait for anybody.

        Raises:
            LinkError: the octets are no frame of the topic's message type.
        """
        try:
            self._writer.write(Frame(frame))
        except DDSException as error:
            raise LinkError(
                f"DDS cannot send {len(frame)} octets on {self._topic} ({error}): are they a frame of its "
                "message type?"
            ) from error


class Subscriber:
    """Receives frames of one topic; made by `Link.subscriber`."""

    def __init__(self, participant: DomainParticipant, topic: Topic[Any], depth: int, reliable: bool):
        reliability = _RELIABLE if reliable else Policy.Reliability.BestEffort
        qos = Qos(reliability, Policy.History.KeepLast(depth), _REPRESENTATION)
        self._reader = DataReader(participant, topic, qos)
        self._depth = depth
        self._any = ReadCondition(self._reader, ViewState.Any | SampleState.Any | InstanceState.Any)
        self._news = WaitSet(participant)
        self._news.attach(self._any)

    @property
    def peers(self) -> int:
        """How many publishers were found so far."""
        return len(self._reader.get_matched_publications())

    def take(self, timeout: float = 0.0) -> list[bytes]:
        """Frames that came since the last call, oldest first.

        Args:
            timeout: how long to wait for the first one [s]; the list is empty when it passes without any.
        """
        if timeout > 0:
            self._news.wait(int(timeout * 1e9))
        # a writer that left shows as a sample without data
        return [frame.octets for frame in self._reader.take(self._depth) if isinstance(frame, Frame)]


class Link:
    """One participant in a DDS domain, on one network interface.

    The robot is in domain 0 behind a network card, a simulation in domain 1 on the loopback interface.

    Args:
        domain: 0 to 232.
        interface: name of the network interface, as `ip address` lists it.

    Raises:
        LinkError: no such interface, or DDS cannot use it, or this process uses the domain on another one.
    """

    def __init__(self, domain: int = SIMULATION_DOMAIN, interface: str = LOOPBACK):
        if not 0 <= domain <= 232:
            raise ValueError(f"a DDS domain is a number from 0 to 232, got {domain}")
        names = [name for _, name in socket.if_nameindex()]
        if interface not in names:
            raise LinkError(
                f"no network interface {interface!r}: this machine has {', '.join(names)}. The robot is "
                "behind the one with an address in 192.168.123.0/24 (`ip address` shows them)."
            )
        try:
            _configure(domain, interface)
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise LinkError(
                f"DDS cannot use the network interface {interface!r} in domain {domain} ({error}): is the "
                "interface up, and is the domain used on another interface in this process?"
            ) from error
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._participants = BuiltinDataReader(self._participant, BuiltinTopicDcpsParticipant)
        # the publishers and participants that there are, by their keys
        self._writers: dict[Any, Any] = {}
        self._present: dict[Any, Any] = {}

    def publisher(self, topic: str, message: type[IdlStruct]) -> Publisher:
        """A publisher of frames of this message type."""
        return Publisher(self._participant, self._topic(topic, message))

    def subscriber(
        self, topic: str, message: type[IdlStruct], *, depth: int = 64, reliable: bool = False
    ) -> Subscriber:
        """A subscriber to frames of this message type.

        Args:
            topic: its name.
            message: the type its publishers announce.
            depth: the newest frames that are kept until they are taken.
            reliable: whether lost frames are sent again. For a stream they would come too late, and a reader
                that stalls would hold up the writer.
        """
        return Subscriber(self._participant, self._topic(topic, message), depth, reliable)

    def rivals(self, topic: str, ours: Collection[int] = (), most: int = _ALL) -> list[str]:
        """Who else publishes a topic: a name, host and process for each publisher outside this link.

        Two controllers on rt/lowcmd would both move the motors: ask before commanding, and while doing so.
        To be found takes a new process about 0.2 s; one that was killed is listed for 3 s more, 10 s with
        other programs' settings.

        Args:
            topic: its name.
            ours: numbers of processes on this machine that may.
            most: publishers, of any topic, that are looked at for the first time in this call: each takes
                0.1 ms, and a robot may have hundreds.
        """
        _follow(self._publications, self._writers, most)
        _follow(self._participants, self._present, _ALL)  # after their publishers, which nobody then lacks
        own, found = self._participant.guid, self._present
        keys = [
            it.participant_key
            for it in self._writers.values()
            if it.topic_name == topic and it.participant_key != own
        ]
        foreign = [key for key in keys if key not in found or _process(found[key].qos) not in ours]
        return [_name(found[key].qos) if key in found else f"participant {key}" for key in foreign]

    def _topic(self, name: str, message: type[IdlStruct]) -> Topic[Any]:
        topic: Topic[Any] = Topic(self._participant, name, message, Qos(_REPRESENTATION))
        topic.data_type = Frame
        return topic


def _follow(reader: BuiltinDataReader, known: dict[Any, Any], most: int) -> None:
    """Take down what has come to a domain and what has left it since the last call."""
    for _ in range(most):
        try:
            news = reader.take(1)
        except UnicodeDecodeError:  # of a name that is no UTF-8: who has it stays nameless, others do not
            continue
        if not news:
            return
        (it,) = news
        if it.sample_info.instance_state == InstanceState.Alive:
            known[it.key] = it
        else:
            known.pop(it.key, None)


@cache
def _host() -> str:
    """This machine's name when it was first asked for: DHCP may change it, not what participants say."""
    return socket.gethostname()


@cache
def _configure(domain: int, interface: str) -> Domain:
    """The domain's settings in this process: made once, kept until it ends."""
    multicast, discovery = ("false", _ON_LOOPBACK) if interface == LOOPBACK else ("default", "")
    return Domain(domain, _CONFIG.format(interface=interface, multicast=multicast, discovery=discovery))


def _told(qos: Qos) -> dict[str, str]:
    """What a participant says of itself."""
    return {policy.key: policy.value for policy in qos if isinstance(policy, Policy.Property)}


def _process(qos: Qos) -> int:
    """Number of a participant's process on this machine; -1 on another one, or if it does not say."""
    told = _told(qos)
    here = told.get("__Hostname") == _host()
    return int(told["__Pid"]) if here and told.get("__Pid", "").isdecimal() else -1


def _name(qos: Qos) -> str:
    """Process, number and host of a participant, as far as it says."""
    told = _told(qos)
    process, number = told.get("__ProcessName", "a process"), told.get("__Pid", "?")
    return f"{process} (process {number} on {told.get('__Hostname', 'an unnamed host')})"
