"""What the two makes of servos have in their registers, and how it becomes channels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.servo_bus import protocol1, protocol2
from drivers.servo_bus.protocol2 import Status
from servo_daemon.samples import F64, I64

#: Encoder counts of a turn of the output shaft, of both makes.
COUNTS_PER_REV = 4096


@dataclass(frozen=True, slots=True)
class Model:
    """A model of servo.

    Attributes:
        name: of the model.
        current_A: one step of Present Current; None: it has no sensor of a current.
        supply_side: the current is measured where the servo is supplied, not in the motor.
    """

    name: str
    current_A: float | None = None
    supply_side: bool = False


#: Dynamixel X by model number: steps of Present Current from the e-manual's control tables. Those of the small ones
#: (XL330, XC330) measure the current on the side of the supply (Rhoban's BAM, `dynamixel/actuator.py`).
DYNAMIXEL: Mapping[int, Model] = {
    1190: Model("XL330-M077", 1e-3, True), 1200: Model("XL330-M288", 1e-3, True),
    1210: Model("XC330-T181", 1e-3, True), 1220: Model("XC330-T288", 1e-3, True),
    1230: Model("XC330-M181", 1e-3, True), 1240: Model("XC330-M288", 1e-3, True),
    1060: Model("XL430-W250"), 1070: Model("XC430-W150"), 1080: Model("XC430-W240"),
    1020: Model("XM430-W350", 2.69e-3), 1030: Model("XM430-W210", 2.69e-3),
    1120: Model("XM540-W270", 2.69e-3), 1130: Model("XM540-W150", 2.69e-3),
    1000: Model("XH430-W350", 2.69e-3), 1010: Model("XH430-W210", 2.69e-3),
    1040: Model("XH430-V350", 1.34e-3), 1050: Model("XH430-V210", 1.34e-3),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Readings:
    """Registers of n answers: share of the supply voltage −1 … 1, V, steps of current, counts, rad/s, °C; (n,) each."""

    duty: F64
    supply_V: F64
    current_steps: F64
    counts: I64
    velocity_rad_s: F64
    temperature_C: F64


class Decoder(Protocol):
    """Bytes of the line to answers."""

    crc_errors: int
    framing_errors: int

    def feed(self, data: bytes) -> list[Status]: ...


class Family(Protocol):
    """A make of servos.

    Attributes:
        address, length: the registers that are read.
        identity: address and length of the registers that begin with the model's number (two bytes).
        search: requests that every servo of the line answers with its model's number; sent by `scan`, nothing else.
    """

    address: int
    length: int
    identity: tuple[int, int]
    search: tuple[bytes, ...]

    def decoder(self) -> Decoder: ...

    def read(self, servo: int, address: int, length: int) -> bytes: ...

    def sync_read(self, servos: Sequence[int]) -> bytes: ...

    def model(self, number: int) -> Model | None: ...

    def readings(self, data: Sequence[bytes]) -> Readings: ...


_X_REGISTERS = np.dtype(
    [
        ("pwm", "<i2"), ("current", "<i2"), ("velocity", "<i4"), ("position", "<i4"),
        ("trajectories", "V8"), ("supply", "<u2"), ("temperature", "u1"),
    ]
)  # fmt: skip
#: Of Present PWM at 100 %, and of a step of velocity, turns a minute (e-manual, X series).
FULL_PWM = 885.0
_RPM_STEP = 0.229


class DynamixelX:
    """X series, registers 124 … 146: PWM, current, velocity, position, two trajectories, supply, temperature."""

    address, length = 124, _X_REGISTERS.itemsize
    identity = (0, 2)
    search: tuple[bytes, ...] = (protocol2.ping(),)

    def __init__(self, *, fast: bool) -> None:
        self._sync_read = protocol2.fast_sync_read if fast else protocol2.sync_read

    def decoder(self) -> protocol2.Decoder:
        return protocol2.Decoder(self.length)

    def read(self, servo: int, address: int, length: int) -> bytes:
        return protocol2.read(servo, address, length)

    def sync_read(self, servos: Sequence[int]) -> bytes:
        return self._sync_read(servos, self.address, self.length)

    def model(self, number: int) -> Model | None:
        return DYNAMIXEL.get(number)

    def readings(self, data: Sequence[bytes]) -> Readings:
        raw = np.frombuffer(b"".join(data), _X_REGISTERS)
        return Readings(
            duty=raw["pwm"] / FULL_PWM,
            supply_V=raw["supply"] / 10.0,
            current_steps=raw["current"].astype(np.float64),
            counts=raw["position"].astype(np.int64),
            velocity_rad_s=raw["velocity"].astype(np.float64) * (_RPM_STEP * 2.0 * math.pi / 60.0),
            temperature_C=raw["temperature"].astype(np.float64),
        )


_STS_REGISTERS = np.dtype(
    [
        ("position", "<u2"), ("speed", "<u2"), ("load", "<u2"), ("supply", "u1"), ("temperature", "u1"),
        ("between", "V5"), ("current", "<u2"),
    ]
)  # fmt: skip
#: The load register is the share of the supply in 0.1 %, its sign in bit 10; the others have theirs in bit 15.
_LOAD_SIGN, _SIGN = 10, 15
_CURRENT_STEP_A = 6.5e-3


class FeetechSts:
    """STS series, registers 56 … 70: position, speed, load, supply, temperature, …, current."""

    address, length = 56, _STS_REGISTERS.itemsize
    identity = (3, 3)  # with the servo's id behind it: an answer is then longer than the echo of its request
    search: tuple[bytes, ...] = tuple(protocol1.read(servo, 3, 3) for servo in range(protocol2.MOST_ID + 1))

    def decoder(self) -> protocol1.Decoder:
        return protocol1.Decoder((self.length, self.identity[1]))

    def read(self, servo: int, address: int, length: int) -> bytes:
        return protocol1.read(servo, address, length)

    def sync_read(self, servos: Sequence[int]) -> bytes:
        return protocol1.sync_read(servos, self.address, self.length)

    def model(self, number: int) -> Model | None:
        return Model(f"STS, model {number}", _CURRENT_STEP_A)

    def readings(self, data: Sequence[bytes]) -> Readings:
        raw = np.frombuffer(b"".join(data), _STS_REGISTERS)
        return Readings(
            duty=_signed(raw["load"], _LOAD_SIGN) / 1000.0,
            supply_V=raw["supply"] / 10.0,
            current_steps=_signed(raw["current"], _SIGN).astype(np.float64),
            counts=_signed(raw["position"], _SIGN),
            velocity_rad_s=_signed(raw["speed"], _SIGN).astype(np.float64) * (2.0 * math.pi / COUNTS_PER_REV),
            temperature_C=raw["temperature"].astype(np.float64),
        )


def _signed(raw: NDArray[np.uint16], bit: int) -> I64:
    """Size and sign in one word: the sign's bit, and the size below it."""
    value: I64 = raw.astype(np.int64)
    size: I64 = value & ((1 << bit) - 1)
    negative: I64 = value >> bit & 1
    return size * (1 - 2 * negative)
