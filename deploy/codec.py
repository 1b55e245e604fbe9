"""LowCmd and LowState frames to arrays and back: fast enough for every tick of a real-time loop.

A frame is a message in CDR: 4 octets of encapsulation header, then the body, little-endian. The robot
counts its legs FR, FL, RR, RL and the model FL, FR, RL, RR; this module alone converts.

The first motor's mode octet follows the fields before it directly, and its numbers begin at the next word.
From there on every motor takes equally many words, its mode octet in front of its numbers. The checksum
covers the C struct instead, where the first motor begins at a word of its own: one word more, the same
words behind it.

Source: IDL and C structs of unitree_sdk2.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deploy.crc import crc32

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# The robot's index of each of the model's joints and feet. Each swaps left and right: its own inverse.
JOINT_ORDER = np.array([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])
FOOT_ORDER = np.array([1, 0, 3, 2])
JOINTS = len(JOINT_ORDER)

HEAD = b"\xfe\xef"
LOW_LEVEL = 0xFF  # level flag of a frame that commands motors
FOC, STOP = 1, 0  # motor modes: field-oriented control, off
# Set points that stand for none: the firmware leaves out the position or the speed term.
POSITION_STOP, VELOCITY_STOP = 2.146e9, 16000.0

COMMAND_SIZE, STATE_SIZE = 812, 1180  # octets
_COMMAND_MODE, _STATE_MODE = 26, 81  # octet of the first motor's mode


def _numbers(first: int, stride: int, columns: list[int]) -> Ints:
    """32-bit words of a frame that hold the motors' numbers, column by column, in the model's order."""
    return (first + np.array(columns)[:, None] + stride * JOINT_ORDER).ravel()


def _octets(first: int, stride: int, mode: int) -> Ints:
    """Octets of a frame that hold the motors' modes, in the model's order."""
    return np.where(JOINT_ORDER == 0, mode, first + stride * JOINT_ORDER)


# Words that hold numbers of a command or a state, in the order of their fields.
COMMAND_NUMBERS = _numbers(7, 9, [0, 1, 2, 3, 4])  # q, dq, tau, kp, kd
_COMMAND_OCTETS = _octets(24, 36, _COMMAND_MODE)
STATE_NUMBERS = np.concatenate([7 + np.arange(13), _numbers(21, 12, [0, 1, 3])])  # IMU; q, dq, tau
_STATE_OCTETS = np.concatenate([_octets(80, 48, _STATE_MODE), 112 + 48 * JOINT_ORDER])  # and temperatures

_ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little-endian
_HEADER = struct.Struct("<2sB")  # head, level flag
# From octet 1040: the battery's charge and current, the feet's forces, tick, remote, supply voltage.
_TAIL, _TAIL_AT = struct.Struct("<3xBi36x4h8xI40s12xf"), 1040


class FrameError(ValueError):
    """Octets that are not a frame of the message they are read as."""


class MotorCommand(NamedTuple):
    """Set points of the twelve motors, (12,) each, in the model's joint order.

    A motor's torque is tau + kp (q - its angle) + kd (dq - its speed).
    """

    q: Floats  # rad; POSITION_STOP for none
    dq: Floats  # rad/s; VELOCITY_STOP for none
    tau: Floats  # N m
    kp: Floats  # N m/rad
    kd: Floats  # N m s/rad
    mode: Ints  # FOC or STOP


class CommandFrame(NamedTuple):
    """A command as the robot received it, with what the robot judges it by."""

    motors: MotorCommand
    head: bytes
    level_flag: int
    crc_ok: bool


class RobotState(NamedTuple):
    """What the robot measured, joints and feet in the model's order."""

    tick: int  # ms since the robot started, modulo 2^32
    quat: Floats  # (4,) w x y z, body to world
    gyro: Floats  # (3,) rad/s, body frame
    acc: Floats  # (3,) m/s^2, body frame; specific force, so +g along what is up at rest
    rpy: Floats  # (3,) rad
    q: Floats  # (12,) rad
    dq: Floats  # (12,) rad/s
    tau: Floats  # (12,) N m, estimated from the currents
    mode: Ints  # (12,) FOC or STOP
    temperature: Ints  # (12,) deg C
    foot_force: Ints  # (4,) raw counts, uncalibrated
    remote: bytes  # (40) see `deploy.remote`
    charge: int  # % of the battery
    current: int  # mA, of the battery
    voltage: float  # V, of the supply
    crc_ok: bool = True


def encode_command(command: MotorCommand, level_flag: int = LOW_LEVEL) -> bytes:
    """The LowCmd frame of a command, (812); motors beyond the twelfth are off."""
    frame = _frame(COMMAND_SIZE, level_flag)
    np.frombuffer(frame, "<f4")[COMMAND_NUMBERS] = np.concatenate(command[:5])
    np.frombuffer(frame, np.uint8)[_COMMAND_OCTETS] = command.mode
    return seal(frame)


def decode_command(frame: bytes) -> CommandFrame:
    """The command in a LowCmd frame, which may be damaged: look at `crc_ok`.

    Raises:
        FrameError: not a LowCmd frame at all.
    """
    _check(frame, COMMAND_SIZE, "LowCmd")
    head, level_flag = _HEADER.unpack_from(frame, 4)
    q, dq, tau, kp, kd = _take(frame, COMMAND_NUMBERS).reshape(5, JOINTS)
    mode = np.frombuffer(frame, np.uint8).take(_COMMAND_OCTETS).astype(np.int64)
    motors = MotorCommand(q, dq, tau, kp, kd, mode)
    return CommandFrame(motors, head, level_flag, _intact(frame, _COMMAND_MODE))


def encode_state(state: RobotState) -> bytes:
    """The LowState frame of a state, (1180)."""
    frame = _frame(STATE_SIZE, LOW_LEVEL)
    np.frombuffer(frame, "<f4")[STATE_NUMBERS] = np.concatenate(state[1:8])
    np.frombuffer(frame, np.uint8)[_STATE_OCTETS] = np.concatenate([state.mode, state.temperature])
    force = state.foot_force.take(FOOT_ORDER).tolist()
    supply = (state.charge, state.current)
    _TAIL.pack_into(frame, _TAIL_AT, *supply, *force, state.tick, state.remote, state.voltage)
    return seal(frame)


def decode_state(frame: bytes) -> RobotState:
    """The state in a LowState frame, which may be damaged: look at `crc_ok`.

    Raises:
        FrameError: not a LowState frame at all.
    """
    _check(frame, STATE_SIZE, "LowState")
    numbers = _take(frame, STATE_NUMBERS)
    octets = np.frombuffer(frame, np.uint8).take(_STATE_OCTETS).astype(np.int64)
    charge, current, fr, fl, rr, rl, tick, remote, voltage = _TAIL.unpack_from(frame, _TAIL_AT)
    return RobotState(
        tick=tick,
        quat=numbers[:4],
        gyro=numbers[4:7],
        acc=numbers[7:10],
        rpy=numbers[10:13],
        q=numbers[13:25],
        dq=numbers[25:37],
        tau=numbers[37:],
        mode=octets[:JOINTS],
        temperature=octets[JOINTS:],
        foot_force=np.array([fr, fl, rr, rl]).take(FOOT_ORDER),
        remote=remote,
        charge=charge,
        current=current,
        voltage=voltage,
        crc_ok=_intact(frame, _STATE_MODE),
    )


def _frame(size: int, level_flag: int) -> bytearray:
    """A frame of zeros behind its headers."""
    frame = bytearray(size)
    frame[:4] = _ENCAPSULATION
    _HEADER.pack_into(frame, 4, HEAD, level_flag)
    return frame


def _check(frame: bytes, size: int, name: str) -> None:
    if len(frame) != size or frame[:2] != _ENCAPSULATION[:2]:
        raise FrameError(
            f"a {name} frame has {size} octets and begins with {_ENCAPSULATION[:2].hex(' ')} (plain "
            f"little-endian CDR); got {len(frame)} octets that begin with {frame[:2].hex(' ')!r}: "
            "is the topic published with another type or firmware?"
        )


def _take(frame: bytes, words: Ints) -> Floats:
    """Numbers of a frame."""
    # a damaged frame may hold signalling NaNs, which are the reader's business and no warning's
    with np.errstate(invalid="ignore"):
        return np.frombuffer(frame, "<f4").take(words).astype(np.float64)


def _words(frame: bytes | bytearray, mode: int) -> bytes:
    """The C struct of a message but for its checksum, from the frame and the first mode's place in it."""
    before = frame[4:mode]
    return b"".join(
        [before, bytes(-len(before) % 4), frame[mode : mode + 1], bytes(3), frame[mode // 4 * 4 + 4 : -4]]
    )


def seal(frame: bytearray) -> bytes:
    """A frame of either message with its checksum."""
    mode = _COMMAND_MODE if len(frame) == COMMAND_SIZE else _STATE_MODE
    frame[-4:] = crc32(_words(frame, mode)).to_bytes(4, "little")
    return bytes(frame)


def _intact(frame: bytes, mode: int) -> bool:
    return crc32(_words(frame, mode)) == int.from_bytes(frame[-4:], "little")
