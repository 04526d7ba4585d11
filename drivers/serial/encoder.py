"""From samples to frames: the device's side of the wire, for simulated drives and tests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriveInfo
from drivers.serial.frame import encode_frame
from drivers.serial.wire import (
    CHANNEL_OF,
    FORMATS,
    STATUS_MASK,
    Channel,
    Description,
    Quantity,
    encode_description,
    encode_samples,
)
from servo_daemon.samples import F64, I64, U8, Quality, SampleBlock

_INVALID = {
    "voltage_V": Quality.VOLTAGE_INVALID,
    "current_A": Quality.CURRENT_INVALID,
    "position_rad": Quality.POSITION_INVALID,
}

#: Steps of channels whose resolution the drive does not tell; fine against any real converter, and 32 bits wide.
_DEFAULT_LSB = {
    "voltage_V": 1e-3,
    "current_A": 1e-4,
    "velocity_rad_s": 1e-4,
    "temperature_C": 1e-2,
    "torque_Nm": 1e-6,
}
#: Where the source names no resolution of the angle: 16 bits a turn.
_DEFAULT_COUNTS_PER_REV = 65536.0


def describe(info: DriveInfo, *, drive_id: int = 1, session: int = 0, commands: bool = False) -> Description:
    """A description for a drive that is known by its `DriveInfo`: 32-bit channels and a status byte; `commands`: it
    takes commands.

    Raises:
        ValueError: the drive has no channel.
        WireError: it has none that the wire knows.
    """
    channels = []
    lsb = {"voltage_V": info.voltage_lsb_V, "current_A": info.current_lsb_A}
    for quantity, name in CHANNEL_OF.items():
        if name in info.channels:
            scale = lsb.get(name) or _DEFAULT_LSB.get(name) or info.counts_per_rev or _DEFAULT_COUNTS_PER_REV
            channels.append(Channel(quantity, 4, float(np.float32(scale))))
    channels.append(Channel(Quantity.STATUS, 1))
    if commands:
        channels.append(Channel(Quantity.COMMAND, 3))
    return Description(
        drive_id=drive_id,
        session=session,
        channels=tuple(channels),
        identity=info.identity.encode()[:16].decode(errors="ignore"),
        sample_period_ns=round((info.sample_period_s or 0.0) * 1e9),
    )


def quantise(channel: Channel, values: F64) -> tuple[I64, NDArray[np.bool_]]:
    """Integers of one channel, shape (n,), and which of them did not fit (they are at the limit of the format).

    Positions wrap instead: their encoder is a counter. What is not finite becomes 0.
    """
    finite = np.where(np.isfinite(values), values, 0.0)
    if channel.quantity == Quantity.POSITION:
        counts = np.rint((finite - channel.offset) * (channel.scale / (2.0 * math.pi)))
        return counts.astype(np.int64), np.zeros(values.shape, dtype=np.bool_)
    limits = np.iinfo(np.dtype(FORMATS[channel.format]))
    steps = np.rint((finite - channel.offset) / channel.scale)
    return np.clip(steps, limits.min, limits.max).astype(np.int64), (steps < limits.min) | (steps > limits.max)


def time_us(block: SampleBlock) -> I64:
    """Device time of each sample in whole microseconds, shape (n,), not yet wrapped."""
    return np.rint(block.time_s * 1e6).astype(np.int64)


class BinaryEncoder:
    """`SampleBlock`s to frames of one description.

    Args:
        description: layout and scales; all its known channels must be in the blocks.
    """

    def __init__(self, description: Description) -> None:
        self.description = description

    def describe(self) -> bytes:
        """The description frame as it goes over the wire; due once a second and before the first samples."""
        return encode_frame(encode_description(self.description))

    def encode(self, block: SampleBlock, commands: I64 | None = None) -> list[bytes]:
        """Frames as they go over the wire, as few as possible: a frame ends at its size limit, where a number is
        missing and where time steps by more than 65535 µs.

        Args:
            commands: numbers of the commands that act, shape (n,).

        Raises:
            ValueError: the block lacks a channel of the description.
        """
        columns = self._columns(block, commands)
        t_us = time_us(block)
        breaks = (np.diff(t_us) > 0xFFFF) | (np.diff(t_us) <= 0) | (np.diff(block.sequence) != 1)
        frames = []
        for start, stop in _cut(np.flatnonzero(breaks) + 1, len(block), self.description.max_samples):
            payload = encode_samples(
                self.description, int(block.sequence[start]), t_us[start:stop], [c[start:stop] for c in columns]
            )
            frames.append(encode_frame(payload))
        return frames

    def _columns(self, block: SampleBlock, commands: I64 | None) -> list[NDArray[Any]]:
        status: U8 = block.quality & np.uint8(STATUS_MASK)
        columns: dict[int, NDArray[Any]] = {}
        for channel in self.description.channels:
            name = CHANNEL_OF.get(channel.quantity)
            if name is None:
                continue
            values = getattr(block, name)
            if values is None:
                raise ValueError(f"the block has no {name}")
            columns[channel.quantity], clipped = quantise(channel, values)
            if channel.quantity == Quantity.POSITION and self.description.position_modulus:
                columns[channel.quantity] %= self.description.position_modulus
            bad = ~np.isfinite(values)
            status = status | np.where(clipped, np.uint8(Quality.SATURATED), np.uint8(0))
            status = status | np.where(bad, np.uint8(_INVALID.get(name, 0)), np.uint8(0))
        zeros = np.zeros(len(block), dtype=np.int64)
        columns[Quantity.STATUS] = status
        columns[Quantity.COMMAND] = zeros if commands is None else commands
        return [columns.get(c.quantity, zeros) for c in self.description.channels]


def _cut(breaks: I64, n: int, largest: int) -> Iterator[tuple[int, int]]:
    """Ranges of 0 .. n that end at every break and are no longer than `largest`."""
    edges = [0, *breaks.tolist(), n]
    for start, stop in pairwise(edges):
        for first in range(start, stop, largest):
            yield first, min(first + largest, stop)
