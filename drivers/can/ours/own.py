"""Our own CAN frames (`servo.dbc`, explained in docs/protocol-can.md) into samples, in blocks.

A Sample carries 16 bits of everything, so that one classic frame is one sample. A Sync, sent right before its Sample
at least every 50 ms, says what those 16 bits leave open: the whole device time, the upper half of the position and
the running number. `can_dating` puts the two together; here frames are sorted, held while nothing dates or scales
them (at the start, and after a silence in which a wrap of the 16-bit time may hide), and scaled. Where nothing of this
is to be done, as nearly always, `can_steady` does the work of both.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drivers.base import DriveInfo, DriverCounters
from drivers.can.decode import CLASSIC_BYTES, Bits, FrameBatch, frame_key
from drivers.can.ours.dating import U16, Anchor, Dated, Timeline, signed
from drivers.can.ours.description import Description
from drivers.can.ours.steady import Claim, Run, follow, sample_runs, words_of
from drivers.can.ours.wire import (
    AT_LIMIT,
    CURRENT,
    DESCRIPTION_ID,
    FIRST_DRIVE,
    NOT_MEASURED,
    POSITION,
    SAMPLE_ID,
    SYNC_ID,
    TIME,
    VOLTAGE,
)
from servo_daemon.samples import F64, I64, U8, Quality, SampleBlock

#: Samples held while nothing dates or scales them; beyond it the oldest are dropped and counted.
MAX_HELD = 16_384

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
        self._page = frame_key(DESCRIPTION_ID + shift, extended=False)
        self._description = Description(self._identity, counts_per_rev)
        self._origin = np.zeros((4, 1))
        self.reset()

    @property
    def keys(self) -> frozenset[int]:
        """The identifiers this decoder wants."""
        return frozenset({self._sync, self._sample, self._page})

    @property
    def info(self) -> DriveInfo:
        """What the drive has said of itself so far."""
        known = self._description.known
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
        self._description.reset()
        self._timeline = Timeline(self._counters)
        self._doubt = False
        self._rows = _NO_ROWS
        self._anchors: list[Anchor] = []
        self._open_sync: tuple[int, int, int] | None = None

    def feed(self, batch: FrameBatch) -> list[SampleBlock]:
        """Samples that these frames complete: one block, more where the device restarted, none while they wait.

        Frames with other identifiers are ignored; frames too short are counted in `framing_errors`.
        """
        steady = self._steady(batch)
        if steady is not None:
            return [steady]
        is_sample = batch.keys == self._sample
        whole = batch.lengths >= CLASSIC_BYTES
        mine = is_sample | (batch.keys == self._sync)
        described = np.flatnonzero(batch.keys == self._page)
        seen = int(np.count_nonzero(mine)) + len(described)
        mine &= whole
        good = int(np.count_nonzero(mine)) + int(np.count_nonzero(whole[described]))
        self._counters.frames += good
        self._counters.framing_errors += seen - good
        blocks: list[SampleBlock] = []
        done = 0
        for index in described[whole[described]].tolist():
            news = self._description.news(batch.data[index])
            if news:  # samples before it are scaled by what was known before it
                blocks += self._take_some(batch, is_sample, mine, done, index)
                self._description.learn(news)
                done = index
        return blocks + self._take_some(batch, is_sample, mine, done, len(batch))

    def _steady(self, batch: FrameBatch) -> SampleBlock | None:
        """The block these frames make if nothing is wrong, missing, new or held; None (and nothing done) otherwise."""
        last = self._timeline.last
        units = self._description.units
        if self._doubt or len(self._rows) or batch.shortest < CLASSIC_BYTES:
            return None
        if last is None or units is None or self._timeline.doubtful(batch.host_s):
            return None
        run = batch.shared("sample_runs", sample_runs).get(self._sample)
        claims = self._claims(batch, run) if run is not None else None
        if run is None or claims is None:
            return None
        n = run.stop - run.start
        now = [claim for claim in claims if claim.row < n] if claims else claims
        raw = follow(run, last, self._description.known["SamplePeriod"], now, self._origin)
        if raw is None:
            return None
        self._counters.frames += len(batch)
        self._open_sync = claims[-1][1:] if len(claims) > len(now) else None  # speaks of the next batch's first Sample
        position, time_us = raw[POSITION:, -1].tolist()
        self._timeline.advance(int(time_us), int(position), last.sequence + n, batch.host_s)
        sequence = np.arange(last.sequence + 1, last.sequence + 1 + n)
        quality = np.zeros(n, np.uint8)
        if run.at_limit:
            _judge(raw, quality)
        return _block(raw, units, sequence, quality, batch.host_s)

    def _claims(self, batch: FrameBatch, run: Run) -> list[Claim] | None:
        """What Syncs say of these Samples and the one after them; None where a frame needs a closer look."""
        claims = [Claim(0, *self._open_sync)] if self._open_sync is not None else []
        if len(batch) == run.stop - run.start:
            return claims
        for before, index in enumerate(np.flatnonzero(batch.keys != self._sample).tolist()):
            key = batch.keys[index]
            if key == self._sync:
                low, high, count, position_high = words_of(batch.data[index, :CLASSIC_BYTES]).tolist()
                claims.append(Claim(index - before, low | high << 16, count, position_high))
            elif key != self._page or not self._description.has_said(batch.data[index]):
                return None
        return claims

    def _take_some(self, batch: FrameBatch, is_sample: Bits, mine: Bits, start: int, stop: int) -> list[SampleBlock]:
        chosen = start + np.flatnonzero(mine[start:stop])
        return self._take(batch.data[chosen, :8], is_sample[chosen], batch.host_s)

    def _take(self, data: U8, is_sample: Bits, host_s: float) -> list[SampleBlock]:
        """Date and scale the samples among some Syncs and Samples, or hold them."""
        if not self._doubt and len(data):
            self._doubt = self._timeline.doubtful(host_s)
        self._collect(data, is_sample)
        if not len(self._rows):
            return []
        units = self._description.units
        if units is None or (self._doubt and not self._anchors):
            self._bound_held()
            return []
        rows, anchors, doubt = self._rows, self._anchors, self._doubt
        self._rows, self._anchors, self._doubt = _NO_ROWS, [], False
        period_s = self._description.known["SamplePeriod"]
        dated = self._timeline.date(rows[:, TIME], rows[:, POSITION], anchors, doubt, host_s, period_s)
        return _blocks(rows if len(rows) == len(dated.rows) else rows[dated.rows], dated, units, host_s)

    def _collect(self, data: U8, is_sample: Bits) -> None:
        """Append the Samples to those held and tie each Sync to the Sample it belongs to."""
        words = words_of(data)
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
        if int(self._rows[row, TIME]) == time_us & 0xFFFF:
            position = signed(position_high << 16 | int(self._rows[row, POSITION]), 32)
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


def _blocks(rows: U16, dated: Dated, units: F64, host_s: float) -> list[SampleBlock]:
    """Scaled samples, a new block from each restart on."""
    if not len(rows):
        return []
    raw = np.empty((4, len(rows)))
    raw[:POSITION] = rows[:, :POSITION].view(np.int16).T
    raw[POSITION], raw[TIME] = dated.position, dated.time_us
    _judge(raw, dated.quality)
    block = _block(raw, units, dated.sequence, dated.quality, host_s)
    restarts = np.flatnonzero(dated.quality & int(Quality.TIME_RESTART))
    edges = [0, *restarts.tolist(), len(rows)]
    return [block.slice(a, b) for a, b in pairwise(edges) if a < b]


def _judge(raw: F64, quality: U8) -> None:
    """Mark what is not measured or at its limit among raw values, shape (4, n), in place."""
    measured = raw[:POSITION]
    missing = measured == NOT_MEASURED
    quality[(np.abs(measured) == AT_LIMIT).any(axis=0)] |= int(Quality.SATURATED)
    quality[missing[VOLTAGE]] |= int(Quality.VOLTAGE_INVALID)
    quality[missing[CURRENT]] |= int(Quality.CURRENT_INVALID)
    measured[missing] = np.nan


def _block(raw: F64, units: F64, sequence: I64, quality: U8, host_s: float) -> SampleBlock:
    """Samples from raw values, shape (4, n), which are scaled in place."""
    voltage, current, position, time_s = np.multiply(raw, units, out=raw)
    return SampleBlock(time_s, sequence, quality, host_s, voltage, current, position)
