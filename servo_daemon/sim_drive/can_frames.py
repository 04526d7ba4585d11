"""The firmware side of our own CAN frames (docs/protocol-can.md): samples in, frames out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivers.base import DriveInfo
from drivers.can.ours.wire import (
    AT_LIMIT,
    DESCRIPTION_ID,
    FIRST_DRIVE,
    LAST_DRIVE,
    NOT_MEASURED,
    SAMPLE_ID,
    SYNC_ID,
    SYNC_PERIOD_S,
    WIRE_VERSION,
)
from servo_daemon.errors import BadInputError
from servo_daemon.samples import F64, I64, SampleBlock

#: So often a drive describes itself (docs/protocol-can.md).
DESCRIPTION_PERIOD_US = 1_000_000

#: Where the source names no resolution: 2 mV and 2 mA reach to 65 V and 65 A in 16 bits.
DEFAULT_LSB = 2e-3
DEFAULT_COUNTS_PER_REV = 4096.0


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One frame; `sample` is the index (from 0, never reset) of the sample it is or precedes."""

    frame_id: int
    data: bytes
    sample: int


class FrameEncoder:
    """Frames of one drive.

    Args:
        info: scales of the drive; what is None gets a default. A sample period is needed.
        drive_id: 1 .. 31.

    Raises:
        BadInputError: drive id or sample period are impossible.
    """

    def __init__(self, info: DriveInfo, drive_id: int) -> None:
        if not FIRST_DRIVE <= drive_id <= LAST_DRIVE:
            raise BadInputError(f"drive id {drive_id} is outside {FIRST_DRIVE} .. {LAST_DRIVE}")
        if info.sample_period_s is None or not 1e-6 <= info.sample_period_s <= SYNC_PERIOD_S:
            raise BadInputError(
                f"a sample period of {info.sample_period_s} s does not fit the CAN frames (1 µs .. {SYNC_PERIOD_S} s)"
            )
        self._shift = drive_id - FIRST_DRIVE
        self._period_s = info.sample_period_s
        self._voltage_lsb = info.voltage_lsb_V or DEFAULT_LSB
        self._current_lsb = info.current_lsb_A or DEFAULT_LSB
        self._counts_per_rev = info.counts_per_rev or DEFAULT_COUNTS_PER_REV
        self._sync_every = max(1, math.floor(0.9 * SYNC_PERIOD_S / self._period_s))
        self._sample = 0
        self._restart_next = True
        self._time_origin_us = self._count_origin = self._position_origin = 0
        self._next_description_us = 0

    def restart(self) -> None:
        """The device starts anew before its next sample: time, count and position from 0, scales said again."""
        self._restart_next = True

    def encode(self, block: SampleBlock) -> list[CanFrame]:
        """The frames of a block, in the order in which a drive sends them."""
        time_us = np.rint(block.time_s * 1e6).astype(np.int64)
        position = np.zeros(len(block), np.int64)
        if block.position_rad is not None:
            position = np.rint(block.position_rad * (self._counts_per_rev / (2 * math.pi))).astype(np.int64)
        voltage = _sixteen_bits(block.voltage_V, self._voltage_lsb, len(block))
        current = _sixteen_bits(block.current_A, self._current_lsb, len(block))
        frames: list[CanFrame] = []
        for k in range(len(block)):
            self._restart_if_asked(int(time_us[k]), int(position[k]))
            now_us, at = int(time_us[k]) - self._time_origin_us, int(position[k]) - self._position_origin
            if now_us >= self._next_description_us:
                self._next_description_us = now_us + DESCRIPTION_PERIOD_US
                frames += self._description()
            if (self._sample - self._count_origin) % self._sync_every == 0:
                frames.append(self._sync(now_us, at))
            words = [int(voltage[k]) & 0xFFFF, int(current[k]) & 0xFFFF, at & 0xFFFF, now_us & 0xFFFF]
            frames.append(self._frame(SAMPLE_ID, b"".join(w.to_bytes(2, "little") for w in words)))
            self._sample += 1
        return frames

    def _restart_if_asked(self, time_us: int, position: int) -> None:
        if self._restart_next:
            first = self._sample == 0
            self._time_origin_us = 0 if first else time_us
            self._position_origin = 0 if first else position
            self._count_origin = self._sample
            self._next_description_us = -(2**63)
            self._restart_next = False

    def _frame(self, base: int, data: bytes) -> CanFrame:
        return CanFrame(base + self._shift, data, self._sample)

    def _sync(self, time_us: int, position: int) -> CanFrame:
        count = (self._sample - self._count_origin) & 0xFFFF
        high = (position >> 16) & 0xFFFF
        return self._frame(
            SYNC_ID,
            (time_us & 0xFFFF_FFFF).to_bytes(4, "little") + count.to_bytes(2, "little") + high.to_bytes(2, "little"),
        )

    def _description(self) -> list[CanFrame]:
        values = (
            round(self._period_s * 1e9),
            round(self._voltage_lsb * 1e9),
            round(self._current_lsb * 1e9),
            round(self._counts_per_rev),
        )
        return [
            self._frame(
                DESCRIPTION_ID,
                bytes([page, WIRE_VERSION if page == 0 else 0, 0, 0]) + value.to_bytes(4, "little"),
            )
            for page, value in enumerate(values)
        ]


def _sixteen_bits(value: F64 | None, lsb: float, n: int) -> I64:
    """Raw values; out of range is the limit, not a number (or no channel) is 'not measured'."""
    if value is None:
        return np.full(n, NOT_MEASURED, np.int64)
    known = np.isfinite(value)
    raw = np.clip(np.rint(np.where(known, value, 0.0) / lsb), -AT_LIMIT, AT_LIMIT).astype(np.int64)
    return np.where(known, raw, NOT_MEASURED)
