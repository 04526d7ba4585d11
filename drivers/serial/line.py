"""A drive on a serial port: pyserial for the port, `wire_decoder` or `wire_text` for the bytes.

Every wakeup takes all bytes the system has in one read, and wakeups are kept `_MIN_READ_SPACING_S` apart, so the cost
is that of some wakeups a second, whatever the baud rate and however thinly the bytes trickle in.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from typing import Any, Literal

import serial
from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.base import DriveInfo, Driver, disconnected
from drivers.options import checked
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.port import open_port
from drivers.serial.text import TextDecoder
from drivers.serial.text_format import TextFormat, named_format
from drivers.serial.wire import Description, Quantity
from servo_daemon.errors import DriverDisconnectedError
from servo_daemon.samples import SampleBlock

#: The system's buffer of a tty holds 4 kB, with what is still in flight behind it 64 kB: one read takes it all.
_READ_SIZE = 65536

#: A wakeup costs the same for one frame as for ten, and a UART without buffer would wake for every few bytes. 40 ms
#: keep a drive at 1 kHz at 25 wakeups a second and leave a third of the 60 ms from sample to API.
_MIN_READ_SPACING_S = 0.04

#: Channels that the wire has as something else.
_COUNTED = {"position_counts": "position_rad"}

_TEXT_ONLY = ("columns", "counts_per_rev", "counts_modulus", "sample_period_s", "voltage_lsb_V", "current_lsb_A")


class SerialOptions(BaseModel):
    """`[drive.options]` of `driver = "serial"`.

    The text wire tells little of the drive, so its options do: `columns` where lines are not `t_us,mV,mA,counts` and no
    header line says so, `counts_per_rev` (needed where counts are sent), `counts_modulus` if the counter is not one of
    32 bits, `sample_period_s` if sampling is regular, and the resolutions of the converters.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    port: str = Field(min_length=1)
    baudrate: int = Field(921600, gt=0)
    wire: Literal["binary", "text"] = "binary"
    drive_id: int | None = Field(None, ge=0, le=255)
    columns: str | None = None
    counts_per_rev: float | None = None
    counts_modulus: int | None = Field(None, ge=2, le=1 << 32)
    sample_period_s: float | None = Field(None, gt=0)
    voltage_lsb_V: float | None = Field(None, gt=0)
    current_lsb_A: float | None = Field(None, gt=0)

    @model_validator(mode="after")
    def _options_suit_the_wire(self) -> SerialOptions:
        if self.wire == "text":
            told = self.format
            if self.columns is not None and told is None:
                raise ValueError(f"'columns': {self.columns!r} names no sample, as \"t_us,mV,mA,counts\" does")
            counted = told is None or told.index("position_counts") is not None
            if self.counts_per_rev == 0.0 or (counted and self.counts_per_rev is None):
                raise ValueError("'counts_per_rev' is needed with wire = \"text\" and is not 0")
            if told is not None and told.time is None and self.sample_period_s is None:
                raise ValueError("'columns' names no time: 'sample_period_s' is needed")
            if self.drive_id is not None:
                raise ValueError("'drive_id' is of no use with wire = \"text\": its lines carry none")
        for key in _TEXT_ONLY:
            if self.wire == "binary" and getattr(self, key) is not None:
                raise ValueError(f"'{key}' is for wire = \"text\" only: on the binary wire the device tells it")
        return self

    @property
    def format(self) -> TextFormat | None:
        """The lines' columns, where they are told."""
        return None if self.columns is None else named_format(self.columns)


class SerialDriver(Driver):
    """A drive on a serial port. Options: see `SerialOptions`.

    Over `close` and `open` the time goes on if the same device still answers; otherwise the first sample is flagged
    `Quality.TIME_RESTART`.
    """

    kind = "serial"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._settings = checked(SerialOptions, name, options)
        self._decoder = self._make_decoder()
        self._port: serial.Serial | None = None
        self._wake_r, self._wake_w = -1, -1
        self._io = threading.Lock()  # held by whoever uses the port: `close` waits for `read` to leave it
        self._last_read_s = 0.0

    def _make_decoder(self) -> BinaryDecoder | TextDecoder:
        settings = self._settings
        if settings.wire == "binary":
            return BinaryDecoder(settings.drive_id, self.counters)
        return TextDecoder(
            settings.counts_per_rev,
            sample_period_s=settings.sample_period_s,
            counts_modulus=settings.counts_modulus or 1 << 32,
            columns=settings.format,
            counters=self.counters,
        )

    @property
    def info(self) -> DriveInfo:
        """On the binary wire known once the first description has come; until then the identity is empty."""
        settings = self._settings
        if isinstance(self._decoder, BinaryDecoder):
            described = self._decoder.description
            return DriveInfo(identity="") if described is None else info_of(described, settings.port)
        counted = "position_counts" in self._decoder.format.channels
        return DriveInfo(
            identity=f"serial:{settings.port}",
            sample_period_s=settings.sample_period_s,
            counts_per_rev=abs(settings.counts_per_rev or 0.0) or None if counted else None,
            current_lsb_A=settings.current_lsb_A or 1e-3,
            voltage_lsb_V=settings.voltage_lsb_V or 1e-3,
            channels=tuple(dict.fromkeys(_COUNTED.get(c, c) for c in self._decoder.format.channels)),
        )

    @property
    def remark(self) -> str | None:
        decoder = self._decoder
        if isinstance(decoder, BinaryDecoder):
            return None
        if not decoder.unread:
            return None
        names, line = ",".join(decoder.format.names), decoder.unread.decode("utf-8", "replace")
        if not decoder.usable:
            lacks = "counts_per_rev" if decoder.format.time is not None else "a time (t_us), or sample_period_s"
            return f"its lines hold {names}, which needs {lacks}: {line!r}"
        return f"a line that is not {names}: {line!r}; a header line or the option columns says what it is"

    def _open(self) -> None:
        settings = self._settings
        self._port = open_port(self.name, settings.port, settings.baudrate, keep=settings.wire == "text")
        self._wake_r, self._wake_w = os.pipe()
        self._decoder.reattach()
        if isinstance(self._decoder, TextDecoder):
            with contextlib.suppress(OSError):  # gone already: `read` will say so
                self._decoder.hear(bytes(self._port.read(_READ_SIZE)))

    def _read(self, timeout_s: float) -> SampleBlock | None:
        if self._decoder.has_ready:
            return self._decoder.feed(b"", time.monotonic())
        deadline = time.monotonic() + max(timeout_s, 0.0)
        while self.is_open:
            with self._io:
                data = self._wait_and_read(deadline)
            if data is None:
                return None
            block = self._decoder.feed(data, self._last_read_s)
            if block is not None:
                return block
        return None

    def _wait_and_read(self, deadline: float) -> bytes | None:
        """Everything that has arrived, as soon as there is something; None at the deadline or on `close`."""
        port = self._port
        if port is None or not self._is_open:
            return None
        try:
            pause = min(self._last_read_s + _MIN_READ_SPACING_S, deadline) - time.monotonic()
            if pause > 0 and select.select([self._wake_r], [], [], pause)[0]:
                return None
            wait = max(deadline - time.monotonic(), 0.0)
            ready = select.select([port.fileno(), self._wake_r], [], [], wait)[0]
            if not ready or self._wake_r in ready:
                return None
            data = bytes(port.read(_READ_SIZE))  # timeout 0: one read of the system, no waiting
        except OSError as error:  # SerialException is one: hang-up, EIO, a read of nothing
            raise self._gone(error) from error
        self._last_read_s = time.monotonic()
        return data

    def _gone(self, error: OSError) -> DriverDisconnectedError:
        return disconnected(self.name, f"{self._settings.port}: {error}")

    def _close(self) -> None:
        wake_w, self._wake_w = self._wake_w, -1
        if wake_w < 0:
            return
        os.write(wake_w, b"x")  # frees a reader from its wait
        with self._io:
            port, self._port = self._port, None
            if port is not None:
                with contextlib.suppress(OSError):  # the device may be gone: then there is nothing left to release
                    port.close()
            os.close(wake_w)
            os.close(self._wake_r)
            self._wake_r = -1


def info_of(description: Description, port: str) -> DriveInfo:
    """What a description tells. The identity is serial number and drive id, or the port where there is no number."""

    def lsb(quantity: Quantity) -> float | None:
        channel = description.channel(quantity)
        return None if channel is None else abs(channel.scale)

    return DriveInfo(
        identity=f"{description.identity or f'serial:{port}'}#{description.drive_id}",
        sample_period_s=description.sample_period_ns / 1e9 or None,
        counts_per_rev=lsb(Quantity.POSITION),
        current_lsb_A=lsb(Quantity.CURRENT),
        voltage_lsb_V=lsb(Quantity.VOLTAGE),
        channels=description.channel_names,
    )
