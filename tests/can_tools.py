"""What the tests of the CAN driver share: a drive with known samples, its frames, and ways to feed them."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np

from drivers.base import DriveInfo, Driver, DriverCounters
from drivers.can.decode import EXTENDED, FrameBatch, batch_of
from drivers.can.ours.own import OwnDecoder
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.can_frames import CanFrame, FrameEncoder
from servo_daemon.sim_drive.slcan_device import NO_FAULTS, SlcanFaults, run_slcan_device
from servo_daemon.sim_drive.source import SampleSource

COUNTS_PER_REV = 4096.0
LSB = 1e-3
RAD_PER_COUNT = 2 * np.pi / COUNTS_PER_REV

_channels = itertools.count()


class RampSource:
    """A drive whose every value follows from the sample's index, on the grid of its converters.

    Args:
        period_s: a whole number of microseconds.
        counts_per_sample: speed; the position starts at `start_counts`.
        start_us: device time of the first sample.
    """

    def __init__(
        self, period_s: float = 1e-3, counts_per_sample: int = 7, start_us: int = 0, start_counts: int = 0
    ) -> None:
        self.info = DriveInfo("ramp", period_s, COUNTS_PER_REV, LSB, LSB, ("voltage_V", "current_A", "position_rad"))
        self._period_us = round(period_s * 1e6)
        self._speed, self._start_us, self._start_counts = counts_per_sample, start_us, start_counts
        self.index = 0

    def next_block(self, n: int) -> SampleBlock:
        k = self.index + np.arange(n)
        self.index += n
        return make_block(
            (self._start_us + k * self._period_us) * 1e-6,
            sequence=k,
            voltage_V=((k * 37) % 20_001 - 10_000) * LSB,
            current_A=((k * 11) % 4_001 - 2_000) * LSB,
            position_rad=(self._start_counts + k * self._speed) * RAD_PER_COUNT,
        )


def frames_of(source: SampleSource, n: int, drive_id: int = 1) -> list[CanFrame]:
    """The first n samples of a source as a drive sends them."""
    return FrameEncoder(source.info, drive_id).encode(source.next_block(n))


def message_of(frame_id: int, data: bytes, stamp_s: float = 0.0, extended: bool = False) -> can.Message:
    return can.Message(timestamp=stamp_s, arbitration_id=frame_id, is_extended_id=extended, data=data, check=True)


def batch(
    frames: Sequence[tuple[int, bytes]], host_s: float, stamps_s: Sequence[float] | None = None, wall_s: float = 0.0
) -> FrameBatch:
    """Frames (identifier or key, data) as they arrive at `host_s`."""
    stamps = [host_s] * len(frames) if stamps_s is None else stamps_s
    messages = [
        message_of(k & ~EXTENDED, data, stamp, bool(k & EXTENDED))
        for (k, data), stamp in zip(frames, stamps, strict=True)
    ]
    return batch_of(messages, host_s, wall_s or host_s)


class Line:
    """A decoder of our own frames and the host's clock, which only moves when told."""

    def __init__(self, drive_id: int = 1) -> None:
        self.counters = DriverCounters()
        self.decoder = OwnDecoder(drive_id, self.counters)
        self.host_s = 100.0
        self.blocks: list[SampleBlock] = []

    def hear(self, frames: Sequence[CanFrame], after_s: float = 0.01) -> list[SampleBlock]:
        """Frames that arrive together, so much later than those before."""
        self.host_s += after_s
        if not frames:
            return []
        new = self.decoder.feed(batch([(f.frame_id, f.data) for f in frames], self.host_s))
        self.blocks += new
        return new

    def hear_in_time(self, frames: Sequence[CanFrame], period_s: float, together: int = 10) -> None:
        """Frames that arrive as their samples are taken, `together` samples at a time."""
        groups = itertools.groupby(frames, key=lambda f: f.sample // together)
        last = None
        for group, members in groups:
            passed = 1 if last is None else group - last
            self.hear(list(members), passed * together * period_s)
            last = group

    def joined(self, name: str) -> np.ndarray:
        return np.concatenate([getattr(b, name) for b in self.blocks])


def read_until(driver: Driver, done: Callable[[list[SampleBlock]], bool], limit_s: float = 20.0) -> list[SampleBlock]:
    """Blocks from an open driver until `done`; fails after `limit_s`."""
    blocks: list[SampleBlock] = []
    deadline = time.monotonic() + limit_s
    while not done(blocks):
        assert time.monotonic() < deadline, f"not done after {limit_s} s: {driver.counters}"
        block = driver.read(0.1)
        if block is not None:
            blocks.append(block)
    return blocks


def wait_for(condition: Callable[[], bool], what: str, limit_s: float = 10.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {limit_s} s"
        time.sleep(0.005)


def samples_in(blocks: Sequence[SampleBlock]) -> int:
    return sum(len(b) for b in blocks)


def new_channel() -> str:
    """A virtual bus nobody else uses."""
    return f"test-{next(_channels)}"


@contextmanager
def virtual_sender(channel: str) -> Iterator[Callable[[Sequence[CanFrame]], None]]:
    """The far end of a virtual bus: a function that sends frames."""
    bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
    try:
        yield lambda frames: [bus.send(message_of(f.frame_id, f.data)) for f in frames] and None
    finally:
        bus.shutdown()


@contextmanager
def slcan_drive(
    link: Path,
    source: SampleSource | None = None,
    *,
    drive_id: int = 1,
    realtime: bool = False,
    faults: SlcanFaults = NO_FAULTS,
) -> Iterator[threading.Event]:
    """A simulated adapter with a drive, in a thread; yields the event that takes it away."""
    stop = threading.Event()
    thread = threading.Thread(
        target=run_slcan_device,
        args=(link, source or RampSource()),
        kwargs={"drive_id": drive_id, "stop": stop, "realtime": realtime, "faults": faults},
        daemon=True,
    )
    thread.start()
    try:
        wait_for(link.exists, f"{link} appears")
        yield stop
    finally:
        stop.set()
        thread.join(10)
        assert not thread.is_alive(), "the simulated adapter did not stop"
