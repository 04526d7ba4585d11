"""The text wire: one line a sample, `t_us,mV,mA,counts` or what a header line names, for a sketch of ten lines
(`docs/protocol.md`).

There is no checksum and no sequence number: it is meant for USB links, which have checksums of their own. A line that
cannot be read is known to be a lost sample (where lines have no time, as far as it has columns of numbers), and with a
told sample period so is every hole in time.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriverCounters
from drivers.serial.counts import CountUnwrapper
from drivers.serial.text_format import DEFAULT, TextFormat, named_format, pair_format
from servo_daemon.samples import F64, I64, U8, Quality, SampleBlock

#: A longer run without a line end is garbage: ten named values have 200 bytes.
MAX_LINE = 256
#: So much of an unreadable line is kept, to be quoted.
_QUOTED = 60

#: Separators of the default format as commas.
_COMMAS = bytes.maketrans(b";\t", b",,")

#: Numbers of firmware that count in 32 bits wrap here.
_UINT32 = 1 << 32
_INT32 = 1 << 31
#: Time without a wrap of its own, µs: further than anything counts.
_NEVER = 1 << 62

Rows = NDArray[np.int64] | NDArray[np.float64]


class TextDecoder:
    """Lines to `SampleBlock`s: a pure object without I/O; any bytes may come in, nothing is raised.

    The format is the default until, before the first sample, a header line or a line of pairs says another.

    Args:
        counts_per_rev: encoder counts per revolution after quadrature; negative turns the direction round. None: lines
            with counts are not read.
        sample_period_s: the sketch's period, if it is regular; then holes in time count as lost samples, and lines need
            no time.
        counts_modulus: the counter wraps from this minus 1 to 0 (4096 for an absolute encoder of 12 bits); the default
            is a 32-bit counter.
        columns: the format, told; header lines say nothing then.
        counters: where to count; an own object without it.

    Attributes:
        format: of the lines.
        unread: the last line that could not be read and is no header; empty: none yet.
    """

    def __init__(
        self,
        counts_per_rev: float | None,
        *,
        sample_period_s: float | None = None,
        counts_modulus: int = _UINT32,
        columns: TextFormat | None = None,
        counters: DriverCounters | None = None,
    ) -> None:
        self.counters = DriverCounters() if counters is None else counters
        self.format = columns or DEFAULT
        self.unread = b""
        self._told = columns is not None
        self._counts_per_rev = counts_per_rev
        self._period_us = None if sample_period_s is None else sample_period_s * 1e6
        self._unwrapper = CountUnwrapper(counts_modulus)
        self._last_row: Rows | None = None
        self._last_us = 0
        self._us = 0
        self._step_us = 1000  # between the last two samples; the continuation after a restart
        self._next = 0
        self.reattach()

    @property
    def usable(self) -> bool:
        """Whether lines of this format can become samples: with a time or a period, and with a resolution of counts."""
        timed = self.format.time is not None or self._period_us is not None
        return timed and (self._counts_per_rev is not None or self.format.index("position_counts") is None)

    def reattach(self) -> None:
        """The line was opened anew: forget half a line, keep time, numbering and position."""
        self._carry = b""
        self._discarding = True  # up to the next line end: the first may be half a line that looks whole
        self._spoilt = 0.0  # how many samples the unreadable lines since the last good one were

    def hear(self, data: bytes) -> None:
        """What had arrived before the line was opened: its header holds, its samples are of another time."""
        for line in data.split(b"\n")[:-1]:
            if self._learn(line.strip(), begun=self._last_row is not None):
                return

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
            if self._period_us is None:  # half a header has lost its time, which comes first
                self._learn(lines[0].strip(), begun=self._last_row is not None)
            del lines[0]
        rows, lost = self._parse(lines)
        if len(self._carry) > MAX_LINE:
            if not self._discarding:
                self._spoil(self._carry)
            self._carry, self._discarding = b"", True
        return None if rows is None else self._block(rows, lost, host_time_s)

    def _spoil(self, line: bytes) -> None:
        self.counters.framing_errors += 1
        self._spoilt += self.format.samples_in(line)
        self.unread = line[:_QUOTED]

    def _learn(self, line: bytes, *, begun: bool) -> bool:
        """Whether a line is a header; before the first sample what it, or a line of pairs, says holds from now on."""
        found = named_format(line.decode("utf-8", "replace")) or pair_format(line)
        if found is None:
            return False
        if not begun and not self._told:
            self.format = found
        return not found.pairs

    def _parse(self, lines: list[bytes]) -> tuple[Rows | None, I64]:
        """Good lines as rows, shape (n, columns), and how many unreadable lines stood before each, shape (n,)."""
        good: list[bytes] = []
        lost: list[int] = []
        pattern, whole = self._pattern()
        for line in lines:
            text = line.rstrip(b"\r")
            match = pattern.fullmatch(text) if pattern is not None else None
            if match is None and text and not text[:1].isdigit():
                begun = self._last_row is not None or bool(good)
                if self._learn(text, begun=begun):
                    pattern, whole = self._pattern()
                    continue
                pattern, whole = self._pattern()  # pairs may just have said what they are
                match = pattern.fullmatch(text) if pattern is not None else None
            if match is not None:
                good.append(text if whole else b",".join(match.groups()))
                lost.append(int(self._spoilt + 0.5))
                self._spoilt = 0.0
            elif text and not text.startswith(b"#"):
                self._spoil(text)
        holes = np.array(lost, dtype=np.int64)
        if not good:
            return None, holes
        rows = self._numbers(good)
        fits = self._fits(rows)
        if fits.all():
            return rows, holes
        for k in np.flatnonzero(~fits).tolist():
            self._spoil(good[k])
            self._spoilt -= 1  # counted where it stood, below
            if k + 1 < len(good):
                holes[k + 1] += holes[k] + 1
            else:
                self._spoilt = int(holes[k]) + 1
        return (rows[fits] if fits.any() else None), holes[fits]

    def _pattern(self) -> tuple[re.Pattern[bytes] | None, bool]:
        """Of a line, None where none can become a sample; and whether it has whole numbers only."""
        return (self.format.line if self.usable else None), self.format.whole

    def _numbers(self, good: list[bytes]) -> Rows:
        values = b",".join(good).translate(_COMMAS).split(b",")
        if self.format.whole:
            return np.array(values, dtype=np.int64).reshape(-1, len(self.format.names))
        return np.array(values, dtype=np.bytes_).astype(np.float64).reshape(-1, len(self.format.names))

    def _fits(self, rows: Rows) -> NDArray[np.bool_]:
        """Which rows are within the counters' widths, shape (n,)."""
        fits: NDArray[np.bool_] = np.all(np.isfinite(rows), axis=1)
        time, counts = self.format.time, self.format.index("position_counts")
        if time is not None:
            fits &= (rows[:, time[0]] >= 0) & (rows[:, time[0]] * time[1] < (time[2] or _NEVER))
        signed = range(1, rows.shape[1]) if self.format.whole else [] if counts is None else [counts]
        for i in signed:
            fits &= (rows[:, i] >= -_INT32) & (rows[:, i] < _INT32)
        return fits

    def _block(self, rows: Rows, holes: I64, host_time_s: float) -> SampleBlock | None:
        self.counters.frames += rows.shape[0]
        time = self.format.time
        if time is not None:  # without one, equal lines are two samples
            before = rows[:1] if self._last_row is None else self._last_row[None, :]
            repeated = (rows == np.concatenate([before, rows[:-1]])).all(axis=1)
            repeated[0] &= self._last_row is not None
            if repeated.any():
                self.counters.samples_repeated += int(repeated.sum())
                rows, holes = rows[~repeated], holes[~repeated]
                if rows.shape[0] == 0:
                    return None
        raw_us, wrap_us = self._raw_us(rows, holes)
        time_us, lost, quality = self._place(raw_us, holes, wrap_us)
        restarts = np.flatnonzero(quality & Quality.TIME_RESTART)
        sequence = self._next + np.cumsum(1 + lost) - 1
        self._last_row, self._next = rows[-1], int(sequence[-1]) + 1
        self._last_us = int(raw_us[-1])
        self.counters.samples_lost += int(lost.sum())
        self.counters.device_restarts += restarts.shape[0]
        return SampleBlock(
            time_s=time_us / 1e6,
            sequence=sequence,
            quality=quality,
            host_time_s=host_time_s,
            **self._channels(rows, restarts),
        )

    def _raw_us(self, rows: Rows, holes: I64) -> tuple[I64, int]:
        """The device's time of each row, shape (n,), and where it wraps, µs."""
        time = self.format.time
        if time is None:
            assert self._period_us is not None
            number = self._next + np.cumsum(1 + holes) - 1
            return np.rint(number * self._period_us).astype(np.int64), _NEVER
        index, unit_us, wrap_us = time
        return np.rint(rows[:, index] * unit_us).astype(np.int64), wrap_us or _NEVER

    def _channels(self, rows: Rows, restarts: I64) -> dict[str, Any]:
        channels: dict[str, F64] = {}
        for name in self.format.channels:
            index = self.format.index(name)
            assert index is not None
            what = self.format.meanings[index]
            assert what is not None
            if name == "position_counts":
                assert self._counts_per_rev is not None
                counts = self._unwrapper.unwrap(np.rint(rows[:, index]).astype(np.int64), restarts)
                channels["position_rad"] = counts.astype(np.float64) * (2.0 * math.pi / self._counts_per_rev)
            elif name != "position_rad" or self.format.index("position_counts") is None:
                inverse = round(1.0 / what.scale) if what.scale < 1.0 else 0
                exact = inverse > 0 and what.scale == 1.0 / inverse  # 250 / 1000 is 0.25, 250 × 0.001 is not
                channels[name] = np.asarray(
                    rows[:, index] / inverse if exact else rows[:, index] * what.scale, np.float64
                )
        return channels

    def _place(self, raw_us: I64, holes: I64, wrap_us: int) -> tuple[I64, I64, U8]:
        """Unwrapped time, samples lost before and quality of each line, all of shape (n,)."""
        first = self._last_row is None
        last_us = int(raw_us[0]) if first else self._last_us
        step = np.diff(raw_us, prepend=last_us)
        step = (step + wrap_us // 2) % wrap_us - wrap_us // 2
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
