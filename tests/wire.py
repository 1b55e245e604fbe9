"""The Go2's frames, made without the codec: C structs, a bitwise checksum, samples with distinct values."""

from __future__ import annotations

import ctypes as ct
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from deploy.codec import MotorCommand, RobotState


def struct(name: str, layout: str) -> type[ct.Structure]:
    """A C struct from "type name count" lines; the compiler's padding, as on the robot."""
    members = [line.split() for line in layout.strip().splitlines()]
    pairs = [(key, TYPES[kind] * int(count) if count != "1" else TYPES[kind]) for kind, key, count in members]
    TYPES[name] = type(name, (ct.LittleEndianStructure,), {"_fields_": pairs})
    return TYPES[name]


TYPES: dict[str, Any] = {"u8": ct.c_uint8, "u16": ct.c_uint16, "i16": ct.c_int16, "u32": ct.c_uint32}
TYPES |= {"i32": ct.c_int32, "f32": ct.c_float}
HEADER = "u8 head 2\nu8 level_flag 1\nu8 frame_reserve 1\nu32 sn 2\nu32 version 2\nu16 bandwidth 1\n"

struct("MotorCmd", "u8 mode 1\nf32 q 1\nf32 dq 1\nf32 tau 1\nf32 kp 1\nf32 kd 1\nu32 reserve 3")
struct("BmsCmd", "u8 off 1\nu8 reserve 3")
LowCmd = struct(
    "LowCmd",
    HEADER
    + "MotorCmd motor_cmd 20\nBmsCmd bms_cmd 1\nu8 wireless_remote 40\nu8 led 12\nu8 fan 2\nu8 gpio 1\n"
    + "u32 reserve 1\nu32 crc 1",
)
struct("Imu", "f32 quaternion 4\nf32 gyroscope 3\nf32 accelerometer 3\nf32 rpy 3\nu8 temperature 1")
struct(
    "MotorState",
    "u8 mode 1\nf32 q 1\nf32 dq 1\nf32 ddq 1\nf32 tau_est 1\nf32 q_raw 1\nf32 dq_raw 1\nf32 ddq_raw 1\n"
    "u8 temperature 1\nu32 lost 1\nu32 reserve 2",
)
struct(
    "Bms",
    "u8 version_high 1\nu8 version_low 1\nu8 status 1\nu8 soc 1\ni32 current 1\nu16 cycle 1\nu8 bq_ntc 2\n"
    "u8 mcu_ntc 2\nu16 cell_vol 15",
)
LowState = struct(
    "LowState",
    HEADER
    + "Imu imu_state 1\nMotorState motor_state 20\nBms bms_state 1\ni16 foot_force 4\ni16 foot_force_est 4\n"
    + "u32 tick 1\nu8 wireless_remote 40\nu8 bit_flag 1\nf32 adc_reel 1\nu8 temperature_ntc1 1\n"
    + "u8 temperature_ntc2 1\nf32 power_v 1\nf32 power_a 1\nu16 fan_frequency 4\nu32 reserve 1\nu32 crc 1",
)


def to_struct(message: Any, into: Any) -> Any:
    """The C struct that holds what an IDL object does."""
    for field in fields(message):
        value = getattr(message, field.name)
        if is_dataclass(value):
            to_struct(value, getattr(into, field.name))
        elif isinstance(value, (list, bytes)):
            target = getattr(into, field.name)
            for i, item in enumerate(value):
                if is_dataclass(item):
                    to_struct(item, target[i])
                else:
                    target[i] = item
        else:
            setattr(into, field.name, value)
    return into


def checksum(octets: bytes) -> int:
    """CRC-32 bit by bit: words little-endian, most significant bit first, 0x04C11DB7, no inversion."""
    crc = 0xFFFFFFFF
    for at in range(0, len(octets), 4):
        word = int.from_bytes(octets[at : at + 4], "little")
        for bit in range(31, -1, -1):
            crc = (crc << 1 ^ (0x04C11DB7 if (crc >> 31 ^ word >> bit) & 1 else 0)) & 0xFFFFFFFF
    return crc


def command(seed: int = 0) -> MotorCommand:
    """Distinct set points that float32 holds exactly."""
    rng = np.random.default_rng(seed)
    q, dq, tau, kp, kd = rng.normal(size=(5, 12)).astype(np.float32).astype(np.float64)
    return MotorCommand(q, dq, tau, kp, kd, rng.permutation(12))


def state(seed: int = 0) -> RobotState:
    """A state of distinct values that float32 holds exactly."""
    rng = np.random.default_rng(seed)

    def floats(count: int) -> np.ndarray:
        return rng.normal(size=count).astype(np.float32).astype(np.float64)

    return RobotState(
        tick=int(rng.integers(2**32)),
        quat=floats(4),
        gyro=floats(3),
        acc=floats(3),
        rpy=floats(3),
        q=floats(12),
        dq=floats(12),
        tau=floats(12),
        mode=rng.permutation(12),
        temperature=30 + rng.permutation(12),
        foot_force=rng.integers(-(2**15), 2**15, 4),
        remote=rng.bytes(40),
        charge=int(rng.integers(101)),
        current=int(rng.integers(-(2**31), 2**31)),
        voltage=float(floats(1)[0]),
    )
