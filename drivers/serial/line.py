"""A drive on a serial port: pyserial for the port, `wire_decoder` or `wire_text` for the bytes.

Every wakeup takes all bytes the system has in one read, and wakeups are kept `_MIN_READ_SPACING_S` apart, so the cost
is that of some wakeups a second, whatever the baud rate and however thinly the bytes trickle in.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import termios
import threading
import time
from pathlib import Path
from typing import Any, Literal

import serial
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from serial.tools import list_ports

from drivers.base import DriveInfo, Driver, disconnected
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.text import TextDecoder
from drivers.serial.text_format import TextFormat, named_format
from drivers.serial.wire import Description, Quantity
from servo_daemon.errors import DriverConfigError, DriverDisconnectedError, DriverUnavailableError
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


def parse_options(name: str, options: dict[str, Any]) -> SerialOptions:
    """Checked options.

    Raises:
        DriverConfigError: one line that names the drive and the option.
    """
    try:
        return SerialOptions.model_validate(options)
    except ValidationError as error:
        complaints = error.errors()  # a misspelt option before the one it leaves missing
        first = next((e for e in complaints if e["type"] == "extra_forbidden"), complaints[0])
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = ", ".join(SerialOptions.model_fields)
            raise DriverConfigError(f"drive {name}: unknown option '{key}': known are {known}") from error
        message = first["msg"].removeprefix("Value error, ")
        where = f"option '{key}': " if key else ""
        raise DriverConfigError(f"drive {name}: {where}{message}") from error


class _KeepingPort(serial.Serial):  # type: ignore[misc]  # pyserial has no types
    """A port whose opening keeps what has arrived before: the sketch's header line may be in it."""

    def _reset_input_buffer(self) -> None:
        """Called by `open` of pyserial."""


class SerialDriver(Driver):
    """A drive on a serial port. Options: see `SerialOptions`.

    Over `close` and `open` the time goes on if the same device still answers; otherwise the first sample is flagged
    `Quality.TIME_RESTART`.
    """

    kind = "serial"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._settings = parse_options(name, options)
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
        try:
            make = _KeepingPort if settings.wire == "text" else serial.Serial
            self._port = make(settings.port, settings.baudrate, timeout=0, exclusive=True)
        except (ValueError, OverflowError) as error:
            raise DriverConfigError(f"drive {self.name}: {settings.port}: {error}") from error
        except (OSError, termios.error) as error:
            raise self._unavailable(error) from error
        self._wake_r, self._wake_w = os.pipe()
        self._decoder.reattach()
        if isinstance(self._decoder, TextDecoder):
            with contextlib.suppress(OSError):  # gone already: `read` will say so
                self._decoder.hear(bytes(self._port.read(_READ_SIZE)))

    def _unavailable(self, error: Exception) -> DriverUnavailableError:
        port = self._settings.port
        code = error.errno if isinstance(error, OSError) else None
        if code == errno.ENOENT:
            why = f"does not exist; {existing_ports()}"
        elif code in (errno.EACCES, errno.EPERM):
            why = "may not be opened by this user (is it in the group that owns the port, often 'dialout'?)"
        elif code in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY):
            why = "is in use by another program"
        else:
            why = f"cannot be opened: {error}"
        return DriverUnavailableError(f"drive {self.name}: serial port {port} {why}")

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


def existing_ports() -> str:
    """In words, which serial ports this machine has, by their stable names where udev gives some."""
    by_id = Path("/dev/serial/by-id")
    names = sorted(str(p) for p in by_id.iterdir()) if by_id.is_dir() else []
    names = names or sorted(p.device for p in list_ports.comports())
    return f"ports here: {', '.join(names)}" if names else "there are no serial ports here"
