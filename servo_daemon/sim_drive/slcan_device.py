"""A simulated USB-CAN adapter with a simulated drive behind it, on a pseudo-terminal.

python-can's slcan interface talks to it as to the real thing: nothing comes before the channel is opened (`O`), frames
come in real time, and what the host does not fetch is lost, as in the small memory of a real adapter.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from servo_daemon.errors import EndOfStreamError
from servo_daemon.sim_drive.can_frames import CanFrame, FrameEncoder
from servo_daemon.sim_drive.counters import DeviceCounters
from servo_daemon.sim_drive.pty_link import PtyLink
from servo_daemon.sim_drive.slcan_adapter import SlcanAdapter
from servo_daemon.sim_drive.source import MAX_BEHIND_S, SampleSource

log = logging.getLogger(__name__)

#: Frames leave in groups of so much device time, as a USB adapter sends them: a packet every few milliseconds.
GROUP_S = 0.004
#: How long the loop waits at most before it looks whether it shall stop.
SLICE_S = 0.05


@dataclass(frozen=True, slots=True)
class SlcanFaults:
    """What goes wrong, by index of the sample (from 0, in the order they are taken).

    Attributes:
        lose: the sample's frames are not sent.
        repeat: its frames are sent twice.
        cut: its frames' lines end in the middle, without their CR.
        garbage: bytes sent before its frames.
        silence: samples of which nothing is sent.
        restart: the device restarts before it.
    """

    lose: frozenset[int] = frozenset()
    repeat: frozenset[int] = frozenset()
    cut: frozenset[int] = frozenset()
    garbage: Mapping[int, bytes] = field(default_factory=dict)
    silence: range = range(0)
    restart: frozenset[int] = frozenset()


NO_FAULTS = SlcanFaults()


def run_slcan_device(
    link: Path,
    source: SampleSource,
    *,
    drive_id: int = 1,
    stop: threading.Event,
    realtime: bool = True,
    faults: SlcanFaults = NO_FAULTS,
    counters: DeviceCounters | None = None,
) -> int:
    """Serve a simulated drive until `stop` is set or the source ends.

    Args:
        link: symbolic link to the pseudo-terminal, made here (a stale one is replaced) and removed at the end.
        source: the drive's samples.
        drive_id: 1 .. 31.
        realtime: pace samples by the clock, whether or not the channel is open, and drop what does not fit into the
            pseudo-terminal; otherwise send as fast as the host fetches, lose nothing and start with its `O`.
        faults: injected into what is sent.
        counters: where to count, in real time: frames are groups of samples, `samples` those of an open channel.

    Returns:
        Frames dropped because the host did not fetch them.

    Raises:
        BadInputError: `link` cannot be made, or the drive does not fit the CAN frames.
    """
    encoder = FrameEncoder(source.info, drive_id)
    with PtyLink(link) as pty:
        device = _Device(pty.master, source, encoder, faults, counters or DeviceCounters())
        with contextlib.suppress(EndOfStreamError):
            if realtime:
                device.run_in_real_time(stop)
            else:
                device.run_as_fetched(stop)
        if dropped := device.counters.overruns:
            log.info("%s: %d frames were not fetched in time and dropped", link, dropped)
        return device.counters.overruns


class _Device:
    def __init__(
        self, master: int, source: SampleSource, encoder: FrameEncoder, faults: SlcanFaults, counters: DeviceCounters
    ) -> None:
        self.counters = counters
        self._master, self._source, self._encoder, self._faults = master, source, encoder, faults
        self._adapter = SlcanAdapter()
        self._pending = b""  # the rest of what the pseudo-terminal took only half
        self._taken = 0
        period_s = source.info.sample_period_s or GROUP_S
        self._group = max(1, round(GROUP_S / period_s))
        self._period_s = period_s

    def run_in_real_time(self, stop: threading.Event) -> None:
        """Groups of samples at absolute deadlines: a late one does not delay those after it."""
        start = time.monotonic()
        while not stop.is_set():
            lines = self._next_lines()
            deadline = start + self._taken * self._period_s
            while (wait := deadline - time.monotonic()) > 0 and not stop.is_set():
                self._serve(min(wait, SLICE_S))
            self._serve(0.0)
            if wait < -MAX_BEHIND_S:
                start -= wait
            self.counters.frames += 1
            if not self._adapter.channel_open:
                self.counters.unheard += 1
                continue
            self.counters.samples += self._group
            for line in lines:
                self.counters.overruns += not self._send(line)

    def run_as_fetched(self, stop: threading.Event) -> None:
        while not stop.is_set():
            self._serve(SLICE_S if not self._adapter.channel_open else 0.0)
            if not self._adapter.channel_open:
                continue
            for line in self._next_lines():
                while not self._send(line) and not stop.is_set():
                    self._serve(SLICE_S, for_room=True)

    def _next_lines(self) -> list[bytes]:
        """The next group of samples as slcan lines, with what goes wrong in them."""
        lines: list[bytes] = []
        upcoming = range(self._taken, self._taken + self._group)
        cuts = [k for k in upcoming if k in self._faults.restart]
        for first, end in zip([upcoming.start, *cuts], [*cuts, upcoming.stop], strict=True):
            if first in cuts:
                self._encoder.restart()
            if end > first:
                for frame in self._encoder.encode(self._source.next_block(end - first)):
                    lines += self._lines(frame)
        self._taken = upcoming.stop
        return lines

    def _lines(self, frame: CanFrame) -> list[bytes]:
        faults, k = self._faults, frame.sample
        if k in faults.lose or k in faults.silence:
            return []
        time_ms = round(k * self._period_s * 1e3)
        line = self._adapter.frame_line(frame.frame_id, frame.data, time_ms)
        if k in faults.cut:
            line = line[: len(line) // 2]
        lines = [line, line] if k in faults.repeat else [line]
        return [faults.garbage[k], *lines] if k in faults.garbage else lines

    def _send(self, line: bytes) -> bool:
        """Give a line to the pseudo-terminal: all of it now or its rest next time; False if there is no room."""
        if self._pending and not self._write(b""):
            return False
        return self._write(line)

    def _write(self, line: bytes) -> bool:
        waiting = self._pending + line
        try:
            written = os.write(self._master, waiting)
        except BlockingIOError:
            return False
        self._pending = waiting[written:]
        return not self._pending or bool(line)

    def _serve(self, wait_s: float, for_room: bool = False) -> None:
        """Answer the host's commands, waiting up to `wait_s` for one (or for room to write)."""
        readable, _, _ = select.select([self._master], [self._master] if for_room else [], [], wait_s)
        if not readable:
            return
        with contextlib.suppress(BlockingIOError):
            answers = self._adapter.feed(os.read(self._master, 4096))
            self._adapter.on_bus.clear()  # nobody on this bus listens
            self._pending += answers
            self._write(b"")
