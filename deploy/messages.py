"""The Go2's DDS messages as IDL types, named and laid out as its firmware announces them.

Octets are `byte`, never `uint8`: Cyclone DDS 11 announces `uint8` as a type that the robot's 0.10.2 does
not know, and a 0.10.2 process that discovers it dies. On the wire both are one octet.

Source: the IDL of unitree_sdk2 (unitree_go and unitree_api), whose types are final with sequential ids.
"""

from dataclasses import dataclass, field
from typing import Any, TypeVar

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import array, byte, float32, int16, int32, int64, sequence, uint16, uint32

# Without `from __future__ import annotations`: the package reads the fields' types when a class is made.

T = TypeVar("T")

MOTORS = 20  # slots of a message; a Go2 fills the first 12


def zeros(count: int) -> Any:
    """A field of `count` zeros."""
    return field(default_factory=lambda: [0] * count)


def octets(count: int) -> Any:
    """A field of `count` zero octets."""
    return field(default_factory=lambda: bytes(count))


def message(cls: type[T]) -> type[T]:
    """A final IDL type, its members numbered in their order."""
    return dataclass(final(autoid("sequential")(cls)))


@message
class MotorCmd_(IdlStruct, typename="unitree_go.msg.dds_.MotorCmd_"):
    """Set point of one motor: angle, speed, torque [rad, rad/s, N m] and the two gains."""

    mode: byte = 0
    q: float32 = 0.0
    dq: float32 = 0.0
    tau: float32 = 0.0
    kp: float32 = 0.0
    kd: float32 = 0.0
    reserve: array[uint32, 3] = zeros(3)


@message
class BmsCmd_(IdlStruct, typename="unitree_go.msg.dds_.BmsCmd_"):
    """Command to the battery."""

    off: byte = 0
    reserve: array[byte, 3] = octets(3)


@message
class LowCmd_(IdlStruct, typename="unitree_go.msg.dds_.LowCmd_"):
    """What a controller sends on rt/lowcmd."""

    head: array[byte, 2] = octets(2)
    level_flag: byte = 0
    frame_reserve: byte = 0
    sn: array[uint32, 2] = zeros(2)
    version: array[uint32, 2] = zeros(2)
    bandwidth: uint16 = 0
    motor_cmd: array[MotorCmd_, 20] = field(default_factory=lambda: [MotorCmd_() for _ in range(MOTORS)])
    bms_cmd: BmsCmd_ = field(default_factory=BmsCmd_)
    wireless_remote: array[byte, 40] = octets(40)
    led: array[byte, 12] = octets(12)
    fan: array[byte, 2] = octets(2)
    gpio: byte = 0
    reserve: uint32 = 0
    crc: uint32 = 0


@message
class IMUState_(IdlStruct, typename="unitree_go.msg.dds_.IMUState_"):
    """Attitude (w, x, y, z), angular velocity [rad/s], specific force [m/s^2], roll pitch yaw [rad]."""

    quaternion: array[float32, 4] = zeros(4)
    gyroscope: array[float32, 3] = zeros(3)
    accelerometer: array[float32, 3] = zeros(3)
    rpy: array[float32, 3] = zeros(3)
    temperature: byte = 0


@message
class MotorState_(IdlStruct, typename="unitree_go.msg.dds_.MotorState_"):
    """What one motor measured."""

    mode: byte = 0
    q: float32 = 0.0
    dq: float32 = 0.0
    ddq: float32 = 0.0
    tau_est: float32 = 0.0
    q_raw: float32 = 0.0
    dq_raw: float32 = 0.0
    ddq_raw: float32 = 0.0
    temperature: byte = 0
    lost: uint32 = 0
    reserve: array[uint32, 2] = zeros(2)


@message
class BmsState_(IdlStruct, typename="unitree_go.msg.dds_.BmsState_"):
    """What the battery measured: charge [%], current [mA], temperatures [deg C], cell voltages [mV]."""

    version_high: byte = 0
    version_low: byte = 0
    status: byte = 0
    soc: byte = 0
    current: int32 = 0
    cycle: uint16 = 0
    bq_ntc: array[byte, 2] = octets(2)
    mcu_ntc: array[byte, 2] = octets(2)
    cell_vol: array[uint16, 15] = zeros(15)


@message
class LowState_(IdlStruct, typename="unitree_go.msg.dds_.LowState_"):
    """What the robot sends on rt/lowstate."""

    head: array[byte, 2] = octets(2)
    level_flag: byte = 0
    frame_reserve: byte = 0
    sn: array[uint32, 2] = zeros(2)
    version: array[uint32, 2] = zeros(2)
    bandwidth: uint16 = 0
    imu_state: IMUState_ = field(default_factory=IMUState_)
    motor_state: array[MotorState_, 20] = field(
        default_factory=lambda: [MotorState_() for _ in range(MOTORS)]
    )
    bms_state: BmsState_ = field(default_factory=BmsState_)
    foot_force: array[int16, 4] = zeros(4)
    foot_force_est: array[int16, 4] = zeros(4)
    tick: uint32 = 0
    wireless_remote: array[byte, 40] = octets(40)
    bit_flag: byte = 0
    adc_reel: float32 = 0.0
    temperature_ntc1: byte = 0
    temperature_ntc2: byte = 0
    power_v: float32 = 0.0
    power_a: float32 = 0.0
    fan_frequency: array[uint16, 4] = zeros(4)
    reserve: uint32 = 0
    crc: uint32 = 0


@message
class WirelessController_(IdlStruct, typename="unitree_go.msg.dds_.WirelessController_"):
    """What the robot sends on rt/wirelesscontroller: sticks in -1..1 and pressed buttons, a bit each."""

    lx: float32 = 0.0
    ly: float32 = 0.0
    rx: float32 = 0.0
    ry: float32 = 0.0
    keys: uint16 = 0


@message
class RequestIdentity_(IdlStruct, typename="unitree_api.msg.dds_.RequestIdentity_"):
    """Which request, of which function: an answer repeats both."""

    id: int64 = 0
    api_id: int64 = 0


@message
class RequestLease_(IdlStruct, typename="unitree_api.msg.dds_.RequestLease_"):
    """The lease a request is made under; 0 for none."""

    id: int64 = 0


@message
class RequestPolicy_(IdlStruct, typename="unitree_api.msg.dds_.RequestPolicy_"):
    """How the server is to treat a request."""

    priority: int32 = 0
    noreply: bool = False


@message
class RequestHeader_(IdlStruct, typename="unitree_api.msg.dds_.RequestHeader_"):
    """Header of a request."""

    identity: RequestIdentity_ = field(default_factory=RequestIdentity_)
    lease: RequestLease_ = field(default_factory=RequestLease_)
    policy: RequestPolicy_ = field(default_factory=RequestPolicy_)


@message
class Request_(IdlStruct, typename="unitree_api.msg.dds_.Request_"):
    """A remote procedure call: its parameter is JSON text."""

    header: RequestHeader_ = field(default_factory=RequestHeader_)
    parameter: str = ""
    binary: sequence[byte] = b""


@message
class ResponseStatus_(IdlStruct, typename="unitree_api.msg.dds_.ResponseStatus_"):
    """How a call went: 0 is well."""

    code: int32 = 0


@message
class ResponseHeader_(IdlStruct, typename="unitree_api.msg.dds_.ResponseHeader_"):
    """Header of an answer."""

    identity: RequestIdentity_ = field(default_factory=RequestIdentity_)
    status: ResponseStatus_ = field(default_factory=ResponseStatus_)


@message
class Response_(IdlStruct, typename="unitree_api.msg.dds_.Response_"):
    """The answer to a remote procedure call: its data is JSON text."""

    header: ResponseHeader_ = field(default_factory=ResponseHeader_)
    data: str = ""
    binary: sequence[byte] = b""
