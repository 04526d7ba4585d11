"""Our own CAN frames (`servo.dbc`, explained in docs/protocol-can.md) into samples, in blocks.

A Sample carries 16 bits of everything, so that one classic frame is one sample. A Sync, sent right before its Sample
at least every 50 ms, says what those 16 bits leave open: the whole device time, the upper half of the position and
the running number. `can_dating` puts the two together; here frames are sorted, held while nothing dates or scales
them (at the start, and after a silence in which a wrap of the 16-bit time may hide), and scaled.
"""

from __future__ import annotations

import logging
import math
from importlib.resources import as_file, files
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriveInfo, DriverCounters
from drivers.can_dating import U16, Anchor, Dated, Timeline, signed
from drivers.can_decode import Bits, Field, FrameBatch, find_field, frame_key, load_dbc
from servo_daemon.samples import F64, I64, U8, Quality, SampleBlock

log = logging.getLogger(__name__)

#: Drive ids on one bus. `servo.dbc` is written for drive 1; drive n adds n - 1 to every identifier. Chosen to stay
#: clear of CANopen's predefined connection set (CiA 301), so that both can share a bus.
FIRST_DRIVE, LAST_DRIVE = 1, 31
SYNC_ID, SAMPLE_ID, DESCRIPTION_ID = 0x101, 0x121, 0x681
WIRE_VERSION = 1
#: A Sync must come at least this often; the drive side sends it more often where its period asks for it.
SYNC_PERIOD_S = 0.05

#: Raw voltage and current that are no number: nothing was measured, and at (or beyond) the end of the range.
NOT_MEASURED, AT_LIMIT = -32_768, 32_767

#: Samples held while nothing dates or scales them; beyond it the oldest are dropped and counted.
MAX_HELD = 16_384

DESCRIBED = ("SamplePeriod", "VoltageLsb", "CurrentLsb", "CountsPerRev")
_VOLTAGE, _CURRENT, _POSITION, _TIME = range(4)
I16 = NDArray[np.int16]
_NO_ROWS: U16 = np.empty((0, 4), np.uint16)


class OwnDecoder:
    """The frames of one drive.

    Args:
        drive_id: 1 .. 31.
        counters: counted up here.
        counts_per_rev: overrides what the drive says of itself; negative turns the direction round.
    """

    def __init__(self, drive_id: int, counters: DriverCounters, counts_per_rev: float | None = None) -> None:
        self._counters = counters
        self._counts_per_rev = counts_per_rev
        self._identity = f"servo-can:{drive_id}"
        shift = drive_id - FIRST_DRIVE
        self._sync = frame_key(SYNC_ID + shift, extended=False)
        self._sample = frame_key(SAMPLE_ID + shift, extended=False)
        self._description = frame_key(DESCRIPTION_ID + shift, extended=False)
        self._fields = _description_fields()
        self._told_version = False
        self.reset()

    @property
    def keys(self) -> frozenset[int]:
        """The identifiers this decoder wants."""
        return frozenset({self._sync, self._sample, self._description})

    @property
    def info(self) -> DriveInfo:
        """What the drive has said of itself so far."""
        known = self._known
        return DriveInfo(
            identity=self._identity,
            sample_period_s=known.get("SamplePeriod"),
            counts_per_rev=abs(self._counts_per_rev or 0.0) or known.get("CountsPerRev"),
            current_lsb_A=known.get("CurrentLsb"),
            voltage_lsb_V=known.get("VoltageLsb"),
            channels=("voltage_V", "current_A", "position_rad"),
        )

    def reset(self) -> None:
        """Forget everything: the next frames may be another device's."""
        self._known: dict[str, float] = {}
        self._timeline = Timeline(self._counters)
        self._doubt = False
        self._rows = _NO_ROWS
        self._anchors: list[Anchor] = []
        self._open_sync: tuple[int, int, int] | None = None

    def feed(self, batch: FrameBatch) -> list[SampleBlock]:
        """Samples that these frames complete: one block, more where the device restarted, none while they wait.

        Frames with other identifiers are ignored; frames too short are counted in `framing_errors`.
        """
        is_sample = batch.keys == self._sample
        if is_sample.all() and batch.lengths.min() >= 8:  # nothing else in it, as in most batches
            self._counters.frames += len(batch)
            return self._take(batch.data[:, :8], is_sample, batch.host_s)
        whole = batch.lengths >= 8
        mine = is_sample | (batch.keys == self._sync)
        described = np.flatnonzero(batch.keys == self._description)
        seen = int(np.count_nonzero(mine)) + len(described)
        mine &= whole
        good = int(np.count_nonzero(mine)) + int(np.count_nonzero(whole[described]))
        self._counters.frames += good
        self._counters.framing_errors += seen - good
        blocks: list[SampleBlock] = []
        done = 0
        for index in described[whole[described]].tolist():
            page = self._page(batch.data[index : index + 1])
            if page.items() - self._known.items():  # samples before it are scaled by what was known before it
                blocks += self._take_some(batch, is_sample, mine, done, index)
                self._known |= page
                done = index
        return blocks + self._take_some(batch, is_sample, mine, done, len(batch))

    def _take_some(self, batch: FrameBatch, is_sample: Bits, mine: Bits, start: int, stop: int) -> list[SampleBlock]:
        chosen = start + np.flatnonzero(mine[start:stop])
        return self._take(batch.data[chosen, :8], is_sample[chosen], batch.host_s)

    def _page(self, data: U8) -> dict[str, float]:
        """What one Description frame says; a zero scale says nothing, nor does a version we do not know."""
        page = {f.name.partition(".")[2]: float(f.physical(data)[0]) for f in self._fields if f.present(data)[0]}
        version = page.pop("WireVersion", WIRE_VERSION)
        if version != WIRE_VERSION:
            if not self._told_version:
                log.warning("%s: version %g of the CAN frames, not %d: ignored", self._identity, version, WIRE_VERSION)
            self._told_version = True
            return {}
        return {name: value for name, value in page.items() if value > 0}

    def _take(self, data: U8, is_sample: Bits, host_s: float) -> list[SampleBlock]:
        """Date and scale the samples among some Syncs and Samples, or hold them."""
        if not self._doubt and len(data):
            self._doubt = self._timeline.doubtful(host_s)
        self._collect(data, is_sample)
        if not len(self._rows):
            return []
        if len(self._known) < len(DESCRIBED) or (self._doubt and not self._anchors):
            self._bound_held()
            return []
        rows, anchors, doubt = self._rows, self._anchors, self._doubt
        self._rows, self._anchors, self._doubt = _NO_ROWS, [], False
        dated = self._timeline.date(
            rows[:, _TIME], rows[:, _POSITION], anchors, doubt, host_s, self._known["SamplePeriod"]
        )
        return self._blocks(rows if len(rows) == len(dated.rows) else rows[dated.rows], dated, host_s)

    def _collect(self, data: U8, is_sample: Bits) -> None:
        """Append the Samples to those held and tie each Sync to the Sample it belongs to."""
        words = data.view("<u2").astype(np.uint16, copy=False)
        sync_at = np.flatnonzero(~is_sample)
        before = len(self._rows)
        samples = words if not len(sync_at) else words[is_sample]
        self._rows = np.concatenate([self._rows, samples]) if before else samples
        if self._open_sync is not None and len(samples):
            self._tie(before, *self._open_sync)
        if not len(sync_at):
            return
        row_after = before + np.cumsum(is_sample)[sync_at]
        for row, sync in zip(row_after.tolist(), words[sync_at].tolist(), strict=True):
            self._open_sync = (sync[0] | sync[1] << 16, sync[2], sync[3])
            if row < len(self._rows):
                self._tie(row, *self._open_sync)

    def _tie(self, row: int, time_us: int, count: int, position_high: int) -> None:
        """A Sync speaks of the very next Sample; if that one was lost, nobody may use the Sync."""
        self._open_sync = None
        if int(self._rows[row, _TIME]) == time_us & 0xFFFF:
            position = signed(position_high << 16 | int(self._rows[row, _POSITION]), 32)
            self._anchors.append(Anchor(row, time_us, count, position))

    def _bound_held(self) -> None:
        excess = len(self._rows) - MAX_HELD
        if excess > 0:
            extra = self._counters.extra
            extra["samples_undated"] = extra.get("samples_undated", 0) + excess
            self._rows = self._rows[excess:]
            self._anchors = [
                Anchor(a.row - excess, a.time_us, a.count, a.position) for a in self._anchors if a.row >= excess
            ]

    def _blocks(self, rows: U16, dated: Dated, host_s: float) -> list[SampleBlock]:
        """Scaled samples, a new block from each restart on."""
        if not len(rows):
            return []
        quality = dated.quality
        counts_per_rev = self._counts_per_rev or self._known["CountsPerRev"]
        measured = rows.view(np.int16)
        voltage = _scale(measured[:, _VOLTAGE], self._known["VoltageLsb"])
        current = _scale(measured[:, _CURRENT], self._known["CurrentLsb"])
        if measured[:, :_POSITION].max() >= AT_LIMIT or measured[:, :_POSITION].min() <= -AT_LIMIT:
            _judge(measured[:, _VOLTAGE], voltage, Quality.VOLTAGE_INVALID, quality)
            _judge(measured[:, _CURRENT], current, Quality.CURRENT_INVALID, quality)
        block = SampleBlock(
            time_s=_scale(dated.time_us, 1e-6),
            sequence=dated.sequence,
            quality=quality,
            host_time_s=host_s,
            voltage_V=voltage,
            current_A=current,
            position_rad=_scale(dated.position, 2 * math.pi / counts_per_rev),
        )
        if not (quality & int(Quality.TIME_RESTART)).any():
            return [block]
        edges = [0, *np.flatnonzero(quality & int(Quality.TIME_RESTART)).tolist(), len(rows)]
        return [block.slice(a, b) for a, b in pairwise(edges) if a < b]


def _judge(raw: I16, value: F64, invalid: Quality, quality: U8) -> None:
    """Mark what is not measured or at its limit, in place."""
    missing = raw == NOT_MEASURED
    value[missing] = np.nan
    quality[missing] |= int(invalid)
    quality[(raw == AT_LIMIT) | (raw == -AT_LIMIT)] |= int(Quality.SATURATED)


def _scale(raw: I16 | I64, factor: float) -> F64:
    return np.multiply(raw, factor, dtype=np.float64)


def _description_fields() -> tuple[Field, ...]:
    """The signals of the Description frame, from the DBC that is packaged with the drivers."""
    with as_file(files("drivers") / "servo.dbc") as path:
        database = load_dbc(path)
    return tuple(find_field(database, f"Description.{name}", "servo.dbc") for name in ("WireVersion", *DESCRIBED))
