"""The device's side of the serial wire on a pseudo-terminal: real frames, in real time, for the real pyserial code.

Behaves as a UART does: nobody needs to listen, and what a slow reader leaves no room for is lost.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.serial.encoder import BinaryEncoder, describe
from drivers.serial.text import encode_lines
from drivers.serial.wire import Description
from servo_daemon.errors import EndOfStreamError, WireError
from servo_daemon.samples import I64, SampleBlock
from servo_daemon.sim_drive.can_frames import DEFAULT_COUNTS_PER_REV
from servo_daemon.sim_drive.commanded import CommandedOutput
from servo_daemon.sim_drive.counters import DeviceCounters
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from servo_daemon.sim_drive.pty_link import POLL_S, PtyLink
from servo_daemon.sim_drive.source import MAX_BEHIND_S, CommandedSource, SampleSource
from servo_daemon.sim_drive.transmitter import Transmitter

Wire = Literal["binary", "text"]

#: How often the description goes out, in device time.
_DESCRIPTION_PERIOD_S = 1.0


#: A reader throws away what has arrived when it has opened the port (pyserial does), so where nothing may be lost it
#: is given so long to get there.
_SETTLE_S = 0.05


#: While it is commanded, samples go out at once: this much in a frame, s.
_COMMANDED_FRAME_S = 0.002
#: Then a drive that the host kept waiting longer than this, s, has stood still: its clock, by which a command runs out,
#: must not run ahead of the commands that lie in the line.
_MAX_BEHIND_COMMANDED_S = 0.02
#: Without real time a commanded drive goes on when it has been told to, or after this time, s.
_PATIENCE_S = 0.2


class _Firmware:
    """What runs on the device: blocks of samples to bytes, with faults and restarts.

    Args:
        counters: where to count.
    """

    def __init__(
        self, source: SampleSource, wire: Wire, drive_id: int, faults: LineFaults, counters: DeviceCounters,
        commands: bool,
    ) -> None:  # fmt: skip
        session = secrets.randbelow(256)  # another after every start, as docs/protocol.md asks of a device
        self._binary = (
            BinaryEncoder(describe(source.info, drive_id=drive_id, session=session, commands=commands))
            if wire == "binary"
            else None
        )
        self._counts_per_rev = source.info.counts_per_rev or DEFAULT_COUNTS_PER_REV
        self._faults, self._counters = faults, counters
        self._frame = 0
        self._description_due_s = -np.inf
        self._origin: SampleBlock | None = None  # its first sample is where the restarted device counts from

    @property
    def description(self) -> Description | None:
        """Of the binary wire, as it is now."""
        return None if self._binary is None else self._binary.description

    def bytes_of(self, block: SampleBlock, commands: I64 | None = None) -> list[bytes]:
        """What goes out for these samples, one entry a frame (binary) or for all of them (text); `commands`: numbers of
        those that act."""
        fault = self._faults.next_fault(self._frame)
        self._frame += 1
        self._counters.frames += 1
        self._counters.samples += len(block)
        if fault is Fault.RESTART:
            self._restart(block)
        out = self._description(float(block.time_s[0]))
        block = self._as_counted(block)
        if self._binary is None:
            frames = [encode_lines(block, self._counts_per_rev)]
        else:
            frames = self._binary.encode(block, commands)
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
    commanded: CommandedSource | None = None,
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
        commanded: the same drive where it takes commands: it stands still at 0 V until one comes.
        faults: what to do wrong.
        counters: where to count.

    Raises:
        BadInputError: the link cannot be made.
        WireError, ValueError: the source has nothing that this wire can carry.
    """
    counters = DeviceCounters() if counters is None else counters
    firmware = _Firmware(source, wire, drive_id, faults or LineFaults(), counters, commanded is not None)
    with PtyLink(link, hold_open=False) as pty:
        line = Transmitter(pty.master)
        device = _Device(line, stop, realtime, counters, MAX_BEHIND_S if commanded is None else _MAX_BEHIND_COMMANDED_S)
        if commanded is not None:
            _serve_commanded(commanded, firmware, line, device, stop)
        while not stop.is_set():
            try:
                block = source.next_block(samples_per_frame)
            except EndOfStreamError:
                stop.wait()
                break
            device.wait_for(float(block.time_s[-1]))
            device.send(firmware.bytes_of(block))


def _serve_commanded(
    source: CommandedSource, firmware: _Firmware, line: Transmitter, device: _Device, stop: threading.Event
) -> None:
    told, period_s = firmware.description, source.info.sample_period_s
    if told is None or period_s is None:
        raise WireError("only the binary wire, with regular samples, takes commands")
    output = CommandedOutput(told, 1.0 / period_s, source.most_V)
    n = max(1, round(_COMMANDED_FRAME_S / period_s))
    while not stop.is_set():
        voltage, numbers = output.next(n)
        block = source.commanded_block(voltage)
        device.wait_for(float(block.time_s[-1]))
        device.send(firmware.bytes_of(block, numbers))
        output.description = firmware.description or told
        device.wait_for_command(lambda: output.hear(line.take_heard()))


class _Device:
    """Sends at the right time, and never waits for ever."""

    def __init__(
        self, line: Transmitter, stop: threading.Event, realtime: bool, counters: DeviceCounters, behind_s: float
    ) -> None:
        self._line, self._stop, self._realtime, self._counters = line, stop, realtime, counters
        self._behind_s = behind_s
        self._start_s: float | None = None  # host time at device time 0
        self._settled = False

    def wait_for(self, time_s: float) -> None:
        """Wait until the sample of this device time has been taken: by absolute deadlines, so that delays of the
        host do not add up. Without real time: until somebody listens."""
        if not self._realtime:
            self._wait_for_reader()
            return
        now = time.monotonic()
        if self._start_s is None or now - (self._start_s + time_s) > self._behind_s:
            self._start_s = now - time_s
        self._stop.wait(max(0.0, self._start_s + time_s - now))

    def _wait_for_reader(self) -> None:
        while not self._stop.is_set():
            if not self._line.has_reader():
                self._settled = False
                self._stop.wait(POLL_S)
            elif self._settled:
                return
            else:
                self._settled = True
                self._stop.wait(_SETTLE_S)

    def wait_for_command(self, hear: Callable[[], int]) -> None:
        """Follow what has come; without real time until something has."""
        until = time.monotonic() + _PATIENCE_S
        while not hear() and not self._realtime and not self._stop.is_set() and time.monotonic() < until:
            self._line.wait_for_bytes(POLL_S)
            if not self._line.has_reader():
                return

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
                self._line.wait_for_room(POLL_S)
