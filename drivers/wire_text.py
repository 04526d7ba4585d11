"""The text wire: one line a sample, `t_us,mV,mA,counts`, for a sketch of ten lines (`docs/protocol.md`).

There is no checksum and no sequence number: it is meant for USB links, which have checksums of their own. A line that
cannot be read is known to be a lost sample, and with a told sample period so is every hole in time.
"""

from __future__ import annotations

import math
import re

import numpy as np

from drivers.base import DriverCounters
from drivers.wire_counts import CountUnwrapper
from servo_daemon.samples import F64, I64, U8, Quality, SampleBlock

_LINE = re.compile(rb"[0-9]{1,10},-?[0-9]{1,10},-?[0-9]{1,10},-?[0-9]{1,10}")
_COLUMNS = 4

#: A longer run without a line end is garbage: the longest line has 44 bytes.
MAX_LINE = 64

_UINT32 = 1 << 32
_INT32 = 1 << 31


class TextDecoder:
    """Lines to `SampleBlock`s: a pure object without I/O; any bytes may come in, nothing is raised.

    Args:
        counts_per_rev: encoder counts per revolution after quadrature; negative turns the direction round.
        sample_period_s: the sketch's period, if it is regular; then holes in time count as lost samples.
        counts_modulus: the counter wraps from this minus 1 to 0 (4096 for an absolute encoder of 12 bits); the default
            is a 32-bit counter.
        counters: where to count; an own object without it.
    """

    def __init__(
        self,
        counts_per_rev: float,
        *,
        sample_period_s: float | None = None,
        counts_modulus: int = _UINT32,
        counters: DriverCounters | None = None,
    ) -> None:
        self.counters = DriverCounters() if counters is None else counters
        self._rad_per_count = 2.0 * math.pi / counts_per_rev
        self._period_us = None if sample_period_s is None else sample_period_s * 1e6
        self._unwrapper = CountUnwrapper(counts_modulus)
        self._last_row: I64 | None = None
        self._us = 0
        self._step_us = 1000  # between the last two samples; the continuation after a restart
        self._next = 0
        self.reattach()

    def reattach(self) -> None:
        """The line was opened anew: forget half a line, keep time, numbering and position."""
        self._carry = b""
        self._discarding = True  # up to the next line end: the first may be half a line that looks whole
        self._spoilt = 0  # unreadable lines since the last good one

    @property
    def has_ready(self) -> bool:
        """Never: a block is always complete (see `BinaryDecoder.has_ready`)."""
        return False

    def feed(self, data: bytes, host_time_s: float = 0.0) -> SampleBlock | None:
        """Take bytes as they arrived; all samples they complete, or None.

        Time and sequence increase strictly over all blocks of one decoder.
        """
        *lines, self._carry = (self._carry + data).split(b"\n")
        if lines and self._discarding:
            self._discarding = False
            del lines[0]
        rows, lost = self._parse(lines)
        if len(self._carry) > MAX_LINE:
            if not self._discarding:
                self.counters.framing_errors += 1
                self._spoilt += 1
            self._carry, self._discarding = b"", True
        return None if rows is None else self._block(rows, lost, host_time_s)

    def _parse(self, lines: list[bytes]) -> tuple[I64 | None, I64]:
        """Good lines as rows, shape (n, 4), and how many unreadable lines stood before each, shape (n,)."""
        good: list[bytes] = []
        lost: list[int] = []
        for line in lines:
            text = line.rstrip(b"\r")
            if _LINE.fullmatch(text):
                good.append(text)
                lost.append(self._spoilt)
                self._spoilt = 0
            elif text and not text.startswith(b"#"):
                self.counters.framing_errors += 1
                self._spoilt += 1
        holes = np.array(lost, dtype=np.int64)
        if not good:
            return None, holes
        rows = np.array(b",".join(good).split(b","), dtype=np.int64).reshape(-1, _COLUMNS)
        fits = (rows[:, 0] < _UINT32) & (rows[:, 1:] >= -_INT32).all(axis=1) & (rows[:, 1:] < _INT32).all(axis=1)
        if fits.all():
            return rows, holes
        for k in np.flatnonzero(~fits).tolist():
            self.counters.framing_errors += 1
            if k + 1 < len(good):
                holes[k + 1] += holes[k] + 1
            else:
                self._spoilt = int(holes[k]) + 1
        return (rows[fits] if fits.any() else None), holes[fits]

    def _block(self, rows: I64, holes: I64, host_time_s: float) -> SampleBlock | None:
        self.counters.frames += rows.shape[0]
        before = rows[:1] if self._last_row is None else self._last_row[None, :]
        repeated = (rows == np.concatenate([before, rows[:-1]])).all(axis=1)
        repeated[0] &= self._last_row is not None
        if repeated.any():
            self.counters.samples_repeated += int(repeated.sum())
            rows, holes = rows[~repeated], holes[~repeated]
            if rows.shape[0] == 0:
                return None
        time_us, lost, quality = self._place(rows[:, 0], holes)
        restarts = np.flatnonzero(quality & Quality.TIME_RESTART)
        counts = self._unwrapper.unwrap(rows[:, 3].copy(), restarts)
        sequence = self._next + np.cumsum(1 + lost) - 1
        self._last_row, self._next = rows[-1], int(sequence[-1]) + 1
        self.counters.samples_lost += int(lost.sum())
        self.counters.device_restarts += restarts.shape[0]
        return SampleBlock(
            time_s=time_us / 1e6,
            sequence=sequence,
            quality=quality,
            host_time_s=host_time_s,
            voltage_V=rows[:, 1] / 1e3,
            current_A=rows[:, 2] / 1e3,
            position_rad=counts.astype(np.float64) * self._rad_per_count,
        )

    def _place(self, raw_us: I64, holes: I64) -> tuple[I64, I64, U8]:
        """Unwrapped time, samples lost before and quality of each line, all of shape (n,)."""
        first = self._last_row is None
        last_us = int(raw_us[0]) if self._last_row is None else int(self._last_row[0])
        step = np.diff(raw_us, prepend=last_us)
        step = (step + _INT32) % _UINT32 - _INT32
        back = step <= 0
        back[0] &= not first
        if self._period_us is not None:
            holes = np.maximum(holes, np.rint(step / self._period_us).astype(np.int64) - 1)
        holes = np.where(back, 0, holes)
        if first:
            holes[0] = 0
        quality = np.where(holes > 0, np.uint8(Quality.GAP_BEFORE), np.uint8(0))
        quality[back] = Quality.TIME_RESTART
        for k in np.flatnonzero(back).tolist():  # goes on as if one more period had passed
            step[k] = step[k - 1] if k > 0 and step[k - 1] > 0 else self._step_us
        if first:
            self._us = last_us
        time_us = self._us + np.cumsum(step)
        self._us = int(time_us[-1])
        if step[-1] > 0:
            self._step_us = int(step[-1])
        return time_us, holes, quality


def encode_lines(block: SampleBlock, counts_per_rev: float) -> bytes:
    """The lines a sketch would print for these samples; missing channels read 0.

    Args:
        counts_per_rev: encoder counts per revolution.
    """
    zeros = np.zeros(len(block))
    columns = (
        np.rint(block.time_s * 1e6).astype(np.int64) % _UINT32,
        np.rint(1e3 * (zeros if block.voltage_V is None else np.nan_to_num(block.voltage_V))),
        np.rint(1e3 * (zeros if block.current_A is None else np.nan_to_num(block.current_A))),
        _wrap32(np.rint((zeros if block.position_rad is None else block.position_rad) * counts_per_rev / math.tau)),
    )
    table = np.stack([c.astype(np.int64) for c in columns], axis=1)
    return (b"%d,%d,%d,%d\n" * len(block)) % tuple(table.ravel().tolist())


def _wrap32(counts: F64) -> I64:
    return (counts.astype(np.int64) + _INT32) % _UINT32 - _INT32
