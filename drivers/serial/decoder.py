"""From a stream of bytes to samples: the binary wire's decoder, a pure object without I/O, clock or log.

Any bytes may come in; nothing is raised, everything is counted. Frames of equal layout are decoded together as one
NumPy array, so the cost per sample is that of arithmetic on arrays (see `benchmarks/wire_serial.py`).
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriverCounters, OnboardEstimates
from drivers.serial.counts import CountUnwrapper
from drivers.serial.frame import CRC_SIZE, FrameReader
from drivers.serial.onboard import decode_onboard
from drivers.serial.timeline import Placement, Timeline
from drivers.serial.wire import (
    CHANNEL_OF,
    SAMPLES_HEADER,
    STATUS_MASK,
    Description,
    FrameType,
    Quantity,
    decode_description,
    frame_dtype,
)
from servo_daemon.errors import WireError
from servo_daemon.samples import I64, Quality, SampleBlock, concatenate

#: Bytes of sample frames kept until a description explains them: 2.8 s of a full line at 921600 baud.
_MAX_WAITING = 256 * 1024

#: How many frames back a repeated frame is recognised; a driver that sends a buffer twice does so at once.
_RECENT_FRAMES = 32

#: Blocks whose commands' numbers are kept.
_KEPT_NUMBERS = 256

_HEAD = 4  # bytes that are equal in frames of the same kind, drive, session and size


class BinaryDecoder:
    """Bytes to `SampleBlock`s.

    Args:
        drive_id: the drive to listen to; None: the first that describes itself.
        counters: where to count; an own object without it.

    Attributes:
        description: the last description of this drive, None until one has come.
        onboard: the last estimates that the drive has made itself.
        numbers: of the last blocks, sequence and number of the command that acts, each of shape (n,).
        counters: what happened; `extra` holds `descriptions_refused` (well-formed, but not understood) and
            `frames_undescribed` (sample frames given up because no description came for them).
    """

    def __init__(self, drive_id: int | None = None, counters: DriverCounters | None = None) -> None:
        self.counters = DriverCounters() if counters is None else counters
        self.counters.extra.setdefault("descriptions_refused", 0)
        self.counters.extra.setdefault("frames_undescribed", 0)
        self.description: Description | None = None
        self._wanted_id = drive_id
        self._timeline = Timeline()
        self._unwrapper: CountUnwrapper | None = None
        self._last_description: Description | None = None
        self._recent: deque[bytes] = deque(maxlen=_RECENT_FRAMES)
        self.numbers: deque[tuple[I64, I64]] = deque(maxlen=_KEPT_NUMBERS)
        self._ready: list[SampleBlock] = []
        self._host_time_s = 0.0
        self._forget_line()

    def _forget_line(self) -> None:
        self._frames = FrameReader(self.counters)
        self.onboard: OnboardEstimates | None = None
        self.description = None
        self._description_payload = b""
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._run: list[bytes] = []
        self._end_run_kind()

    def _end_run_kind(self) -> None:
        """The next sample frame is looked at closely; those that look like it are not."""
        self._run_head, self._run_size = b"", 0

    def reattach(self) -> None:
        """The line was opened anew: forget bytes and description, keep time, numbering and position.

        The same device then continues (what it sent meanwhile is lost, and counted); any other begins with a sample
        flagged `Quality.TIME_RESTART`.
        """
        self._forget_line()
        self._ready.clear()

    @property
    def has_ready(self) -> bool:
        """Whether a block waits that had other channels than the last one; `feed(b"")` returns it."""
        return bool(self._ready)

    def feed(self, data: bytes, host_time_s: float = 0.0) -> SampleBlock | None:
        """Take bytes as they arrived; all samples they complete, or None.

        Time and sequence increase strictly over all blocks of one decoder. When the device changes its channels, the
        samples with the new ones are kept for the next call, since a block has one set of channels.
        """
        self._host_time_s = host_time_s
        for payload in self._frames.feed(data):
            self._take(payload)
        self._finish_run()
        return self._next_block()

    def _take(self, payload: bytes) -> None:
        """A good frame: most continue the run of frames like the one before."""
        kind = payload[0]
        if payload[:_HEAD] == self._run_head and len(payload) == self._run_size:
            self._run.append(payload)
        elif kind == FrameType.DESCRIPTION:
            self._describe(payload)
        elif kind == FrameType.ESTIMATES and self.description is not None and payload[1] == self._drive_id:
            self._take_estimates(payload)
        elif kind != FrameType.SAMPLES or (self._drive_id not in (None, payload[1])):
            self.counters.unknown_frames += 1
        elif len(payload) <= SAMPLES_HEADER.size + CRC_SIZE:
            self.counters.framing_errors += 1
        elif self.description is None or payload[2] != self.description.session:
            self._wait_for_description(payload)
        else:
            self._begin_run(payload, self.description)

    def _take_estimates(self, payload: bytes) -> None:
        try:
            self.onboard = decode_onboard(payload[:-CRC_SIZE], self._host_time_s)
        except WireError:
            self.counters.framing_errors += 1

    def _begin_run(self, payload: bytes, description: Description) -> None:
        """A described sample frame of another size than the one before."""
        dtype = frame_dtype(description.record, payload[3])
        if len(payload) != dtype.itemsize:
            self.counters.framing_errors += 1
            return
        self._finish_run(last=True)
        self._run, self._run_head, self._run_size = [payload], payload[:_HEAD], len(payload)
        self._run_dtype, self._run_numbers = dtype, np.arange(payload[3])

    @property
    def _drive_id(self) -> int | None:
        """The drive listened to, None while it may still be any."""
        return self._wanted_id if self.description is None else self.description.drive_id

    def _wait_for_description(self, payload: bytes) -> None:
        self._waiting.append(payload)
        self._waiting_bytes += len(payload)
        while self._waiting_bytes > _MAX_WAITING:
            self._waiting_bytes -= len(self._waiting.popleft())
            self.counters.extra["frames_undescribed"] += 1

    def _describe(self, payload: bytes) -> None:
        if payload == self._description_payload:
            return
        if self._drive_id not in (None, payload[1]):
            self.counters.unknown_frames += 1
            return
        try:
            description = decode_description(payload[:-CRC_SIZE])
        except WireError:
            self.counters.extra["descriptions_refused"] += 1
            return
        self._finish_run(last=True)
        self._end_run_kind()
        self._adopt(description, payload)
        waiting, self._waiting, self._waiting_bytes = self._waiting, deque(), 0
        for frame in waiting:
            if frame[1] == description.drive_id and frame[2] != description.session:
                self.counters.extra["frames_undescribed"] += 1
            else:
                self._take(frame)

    def _adopt(self, description: Description, payload: bytes) -> None:
        last = self._last_description
        if last is not None and (last.drive_id, last.session, last.identity) != (
            description.drive_id,
            description.session,
            description.identity,
        ):
            self._timeline.new_session()
        self._timeline.set_period(description.sample_period_ns / 1e3 or None)
        if self._unwrapper is None or self._unwrapper.modulus != description.modulus:
            self._unwrapper = CountUnwrapper(description.modulus) if description.modulus else None
        self.description = self._last_description = description
        self._description_payload = payload

    def _finish_run(self, last: bool = False) -> None:
        """Decode the frames collected so far into a block; `last`: no more of this kind follow."""
        if not self._run or self.description is None:
            return
        payloads, self._run = self._run, []
        block = self._decode(payloads, self.description, last)
        if block is not None:
            self._ready.append(block)
        done = payloads[: len(payloads) - len(self._run)]
        self._recent.extend(done[-_RECENT_FRAMES:])

    def _decode(self, payloads: list[bytes], description: Description, last: bool) -> SampleBlock | None:
        frames = np.frombuffer(b"".join(payloads), dtype=self._run_dtype)
        steps = frames["samples"]["dt_us"]
        if (
            np.count_nonzero(steps[:, 1:]) < steps.size - steps.shape[0]
        ):  # time stands still: not a frame of this protocol
            good = np.all(steps[:, 1:] > 0, axis=1)
            self.counters.framing_errors += int((~good).sum())
            payloads = [payloads[k] for k in np.flatnonzero(good)]
            frames, steps = frames[good], steps[good]
            if not payloads:
                return None

        def is_repeat(k: int) -> bool:
            return payloads[k] in payloads[max(0, k - _RECENT_FRAMES) : k] or payloads[k] in self._recent

        offsets = steps.cumsum(axis=1, dtype=np.int64)
        timeline, counters = self._timeline, self.counters
        n = offsets.shape[1]
        placed = timeline.place(frames["sequence"], frames["t_us"], offsets[:, -1], n, is_repeat, last=last)
        if placed.undecided:
            self._run = payloads[-placed.undecided :]
            frames, offsets = frames[: -placed.undecided], offsets[: -placed.undecided]
        counters.samples_lost = timeline.lost
        counters.samples_repeated = timeline.repeated
        counters.device_restarts = timeline.restarts
        if placed.kept is not None:
            frames, offsets = frames[placed.kept], offsets[placed.kept]
        if frames.shape[0] == 0:
            return None
        return self._block(frames["samples"], description, offsets, placed)

    def _block(self, records: NDArray[Any], description: Description, offsets: I64, placed: Placement) -> SampleBlock:
        """Samples of placed frames, values in their units."""
        quality = np.zeros(offsets.shape, dtype=np.uint8)
        restarts = None
        if placed.flags is not None:
            quality[:, 0] = placed.flags
            restarts = np.flatnonzero(placed.flags & Quality.TIME_RESTART) * offsets.shape[1]
        values: dict[str, Any] = {}
        sequence = (placed.sequence[:, None] + self._run_numbers).reshape(-1)
        for field, channel in zip(description.fields, description.channels, strict=True):
            raw = records[field]
            if channel.quantity == Quantity.STATUS:
                quality |= raw.astype(np.uint8) & np.uint8(STATUS_MASK)
            elif channel.quantity == Quantity.COMMAND:
                self.numbers.append((sequence, raw.astype(np.int64).reshape(-1)))
            elif channel.quantity in CHANNEL_OF:
                if channel.quantity == Quantity.POSITION and self._unwrapper is not None:
                    raw = self._unwrapper.unwrap(raw.astype(np.int64).reshape(-1), restarts)
                value = np.multiply(raw, channel.unit_per_lsb, dtype=np.float64).reshape(-1)
                if channel.offset:
                    value += channel.offset
                values[CHANNEL_OF[channel.quantity]] = value
        return SampleBlock(
            time_s=(placed.time_us[:, None] + offsets).reshape(-1) / 1e6,
            sequence=sequence,
            quality=quality.reshape(-1),
            host_time_s=self._host_time_s,
            **values,
        )

    def _next_block(self) -> SampleBlock | None:
        """The longest start of what is ready that has one set of channels."""
        ready = self._ready
        if len(ready) < 2:
            return ready.pop() if ready else None
        count = next((k for k, b in enumerate(ready) if b.channels != ready[0].channels), len(ready))
        block = concatenate(ready[:count])
        del ready[:count]
        return block
