"""The device's side of the serial wire on a pseudo-terminal: real frames, in real time, for the real pyserial code.

Behaves as a UART does: nobody needs to listen, and what a slow reader leaves no room for is lost.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.serial.encoder import BinaryEncoder, describe
from drivers.serial.text import encode_lines
from servo_daemon.errors import EndOfStreamError
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.counters import DeviceCounters
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from servo_daemon.sim_drive.pty_link import PtyLink
from servo_daemon.sim_drive.source import SampleSource

Wire = Literal["binary", "text"]

#: How often the description goes out, in device time.
_DESCRIPTION_PERIOD_S = 1.0

#: A host that stood still longer than this (suspended, stopped) continues from now instead of catching up.
_MAX_BEHIND_S = 1.0

#: Longest wait before looking at `stop` again.
_POLL_S = 0.05

#: A reader throws away what has arrived when it has opened the port (pyserial does), so where nothing may be lost it
#: is given so long to get there.
_SETTLE_S = 0.05

_DEFAULT_COUNTS_PER_REV = 4096.0


class _Transmitter:
    """The master side of a pseudo-terminal, used like a UART's transmitter."""

    def __init__(self, master: int) -> None:
        self._master = master
        self._poll = select.poll()
        self._poll.register(master, select.POLLIN | select.POLLHUP)
        self._poll_write = select.poll()
        self._poll_write.register(master, select.POLLOUT)

    def has_reader(self) -> bool:
        """Whether somebody has the port open. What they send is read and thrown away."""
        events = dict(self._poll.poll(0)).get(self._master, 0)
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                os.read(self._master, 65536)
        return not events & select.POLLHUP

    def write(self, data: bytes) -> int:
        """Send what there is room for; how many bytes that was."""
        try:
            return os.write(self._master, data)
        except OSError:  # EAGAIN: no room; EIO: the reader left just now
            return 0

    def wait_for_room(self, timeout_s: float) -> None:
        """Wait until there is room, or the reader left, or the timeout."""
        self._poll_write.poll(timeout_s * 1e3)


class _Firmware:
    """What runs on the device: blocks of samples to bytes, with faults and restarts.

    Args:
        counters: where to count.
    """

    def __init__(
        self, source: SampleSource, wire: Wire, drive_id: int, faults: LineFaults, counters: DeviceCounters
    ) -> None:
        session = secrets.randbelow(256)  # another after every start, as docs/protocol.md asks of a device
        self._binary = (
            BinaryEncoder(describe(source.info, drive_id=drive_id, session=session)) if wire == "binary" else None
        )
        self._counts_per_rev = source.info.counts_per_rev or _DEFAULT_COUNTS_PER_REV
        self._faults, self._counters = faults, counters
        self._frame = 0
        self._description_due_s = -np.inf
        self._origin: SampleBlock | None = None  # its first sample is where the restarted device counts from

    def bytes_of(self, block: SampleBlock) -> list[bytes]:
        """What goes out for these samples, one entry a frame (binary) or for all of them (text)."""
        fault = self._faults.next_fault(self._frame)
        self._frame += 1
        self._counters.frames += 1
        self._counters.samples += len(block)
        if fault is Fault.RESTART:
            self._restart(block)
        out = self._description(float(block.time_s[0]))
        block = self._as_counted(block)
        frames = [encode_lines(block, self._counts_per_rev)] if self._binary is None else self._binary.encode(block)
        return out + [self._faults.spoil(fault, wire) for wire in frames]

    def _restart(self, block: SampleBlock) -> None:
        self._counters.restarts += 1
        self._origin = block.slice(0, 1)
        self._description_due_s = -np.inf
        if self._binary is not None:
            old = self._binary.description
            self._binary = BinaryEncoder(replace(old, session=(old.session + 1) % 256))

    def _as_counted(self, block: SampleBlock) -> SampleBlock:
        """The samples as the device itself numbers and dates them since its start."""
        origin = self._origin
        if origin is None:
            return block
        position = block.position_rad
        if position is not None and origin.position_rad is not None:
            position = position - origin.position_rad[0]
        return replace(
            block,
            time_s=block.time_s - origin.time_s[0],
            sequence=block.sequence - origin.sequence[0],
            position_rad=position,
        )

    def _description(self, now_s: float) -> list[bytes]:
        if self._binary is None or now_s < self._description_due_s:
            return []
        self._description_due_s = now_s + _DESCRIPTION_PERIOD_S
        self._counters.descriptions += 1
        return [self._binary.describe()]


def run_serial_device(
    link: Path,
    source: SampleSource,
    *,
    wire: Wire = "binary",
    drive_id: int = 1,
    samples_per_frame: int = 10,
    stop: threading.Event,
    realtime: bool = True,
    faults: LineFaults | None = None,
    counters: DeviceCounters | None = None,
) -> None:
    """Serve a simulated drive at `link` until `stop` is set; returns within about 50 ms of that.

    Args:
        link: becomes a symbolic link to the terminal; an old symbolic link is replaced, anything else is not. It is
            gone when this returns.
        source: the drive. When it has no more samples the device stays silent until `stop`.
        samples_per_frame: samples in a frame (binary), lines written at once (text).
        realtime: pace by the samples' own time, and lose what nobody listens to or has no room; otherwise as fast as
            the reader takes it, nothing lost, waiting for a reader.
        faults: what to do wrong.
        counters: where to count.

    Raises:
        BadInputError: the link cannot be made.
        WireError, ValueError: the source has nothing that this wire can carry.
    """
    counters = DeviceCounters() if counters is None else counters
    firmware = _Firmware(source, wire, drive_id, faults or LineFaults(), counters)
    with PtyLink(link, hold_open=False) as pty:
        device = _Device(_Transmitter(pty.master), stop, realtime, counters)
        while not stop.is_set():
            try:
                block = source.next_block(samples_per_frame)
            except EndOfStreamError:
                stop.wait()
                break
            device.wait_for(float(block.time_s[-1]))
            device.send(firmware.bytes_of(block))


class _Device:
    """Sends at the right time, and never waits for ever."""

    def __init__(self, line: _Transmitter, stop: threading.Event, realtime: bool, counters: DeviceCounters) -> None:
        self._line, self._stop, self._realtime, self._counters = line, stop, realtime, counters
        self._start_s: float | None = None  # host time at device time 0
        self._settled = False

    def wait_for(self, time_s: float) -> None:
        """Wait until the sample of this device time has been taken: by absolute deadlines, so that delays of the
        host do not add up. Without real time: until somebody listens."""
        if not self._realtime:
            self._wait_for_reader()
            return
        now = time.monotonic()
        if self._start_s is None or now - (self._start_s + time_s) > _MAX_BEHIND_S:
            self._start_s = now - time_s
        self._stop.wait(max(0.0, self._start_s + time_s - now))

    def _wait_for_reader(self) -> None:
        while not self._stop.is_set():
            if not self._line.has_reader():
                self._settled = False
                self._stop.wait(_POLL_S)
            elif self._settled:
                return
            else:
                self._settled = True
                self._stop.wait(_SETTLE_S)

    def send(self, frames: list[bytes]) -> None:
        """Put frames on the line."""
        if not self._realtime:
            self._send_all(b"".join(frames))
        elif not self._line.has_reader():
            self._counters.unheard += len(frames)
        else:
            for frame in frames:
                self._counters.overruns += self._line.write(frame) < len(frame)

    def _send_all(self, data: bytes) -> None:
        while data and not self._stop.is_set() and self._line.has_reader():
            data = data[self._line.write(data) :]
            if data:
                self._line.wait_for_room(_POLL_S)
