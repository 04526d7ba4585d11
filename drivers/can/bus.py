"""Driver "can": a drive on a CAN bus, through python-can with any of its interfaces.

Two kinds of drive. Without `dbc`, one that sends our own frames (`servo.dbc`, docs/protocol-can.md). With `dbc` and
`signals`, another maker's, its signals mapped to channels. Several drives may share a bus; it is opened once.

    [drive.options]
    interface = "socketcan"      # or slcan, gs_usb, pcan, virtual, …
    channel = "can0"
    bitrate = 1_000_000          # where the interface sets it (socketcan: `ip link` does)
    drive_id = 1
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from pathlib import Path
from typing import Any, ClassVar, Protocol

from drivers.base import DriveInfo, Driver, disconnected
from drivers.can.decode import FrameBatch, load_dbc
from drivers.can.map import COUNTS, parse_signal_map
from drivers.can.own import OwnDecoder
from drivers.can.port import CanPort, Inbox
from drivers.can.vendor import STALE_S, VendorDecoder
from drivers.can.wire import FIRST_DRIVE, LAST_DRIVE
from servo_daemon.errors import DriverConfigError, DriverError
from servo_daemon.samples import SampleBlock

_BUS_OPTIONS = ("interface", "channel", "bitrate", "bus")
_OWN_OPTIONS = ("drive_id", "counts_per_rev")
_VENDOR_OPTIONS = ("dbc", "signals", "trigger", "counts_per_rev", "period_s", "stale_s")

#: python-can waits 2 s after opening an slcan adapter, for boards that start anew when their port is opened. USB-CAN
#: adapters do not; `bus = {sleep_after_open = 2.0}` brings it back.
SLCAN_SETTLE_S = 0.1


class FrameDecoder(Protocol):
    """What turns one drive's frames into samples."""

    @property
    def keys(self) -> frozenset[int]: ...

    @property
    def info(self) -> DriveInfo: ...

    def reset(self) -> None: ...

    def feed(self, batch: FrameBatch) -> list[SampleBlock]: ...


class CanDriver(Driver):
    """One drive on a CAN bus. Options: see docs/protocol-can.md.

    Raises:
        DriverConfigError: unknown or wrong options, a DBC that is missing, unreadable or without a mapped signal.
    """

    kind: ClassVar[str] = "can"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._where = f"drive {name}"
        own = "dbc" not in options and "signals" not in options
        known = (*_BUS_OPTIONS, *(_OWN_OPTIONS if own else _VENDOR_OPTIONS))
        for key in options:
            if key not in known:
                raise DriverConfigError(f"{self._where}: unknown option '{key}': known are {', '.join(known)}")
        self._settings = self._bus_settings()
        self._decoder: FrameDecoder = self._own_decoder() if own else self._vendor_decoder()
        self._blocks: deque[SampleBlock] = deque()
        self._port: CanPort | None = None
        self._inbox: Inbox | None = None

    @property
    def info(self) -> DriveInfo:
        return self._decoder.info

    def _open(self) -> None:
        self._decoder.reset()
        self._blocks.clear()
        self._inbox = Inbox(self._decoder.keys, self.counters)
        try:
            self._port = CanPort.attach(self._settings, self._inbox)
        except DriverError as error:
            raise type(error)(f"{self._where}: {error}") from error

    def _read(self, timeout_s: float) -> SampleBlock | None:
        deadline = time.monotonic() + timeout_s
        while not self._blocks:
            port, inbox = self._port, self._inbox
            if port is None or inbox is None:  # closed by another thread
                return None
            try:
                batch = port.take(inbox, max(0.0, deadline - time.monotonic()), lambda: not self._is_open)
            except ConnectionError as error:
                raise disconnected(self.name, error) from error
            if batch is not None:
                self._blocks.extend(self._decoder.feed(batch))
            elif time.monotonic() >= deadline or not self._is_open:
                return None
        return self._blocks.popleft()

    def _close(self) -> None:
        port, self._port = self._port, None
        inbox, self._inbox = self._inbox, None
        if port is not None and inbox is not None:
            port.detach(inbox)

    # ---- options

    def _bus_settings(self) -> dict[str, Any]:
        """Keyword arguments for `can.Bus`."""
        extra = self.options.get("bus", {})
        if not isinstance(extra, dict):
            raise DriverConfigError(f"{self._where}: 'bus' must be a table of python-can arguments")
        for key in _BUS_OPTIONS:
            if key in extra:
                raise DriverConfigError(f"{self._where}: '{key}' belongs beside the table 'bus', not in it")
        settings: dict[str, Any] = {"interface": self._text("interface")}
        if settings["interface"] == "slcan":
            settings["sleep_after_open"] = SLCAN_SETTLE_S
            if os.name == "posix":  # elsewhere a serial port cannot be waited for with select
                settings["timeout"] = 0
        channel = self.options.get("channel")
        if channel is not None:
            if isinstance(channel, bool) or not isinstance(channel, str | int):
                raise DriverConfigError(f"{self._where}: channel must be a text or a number, not {channel!r}")
            settings["channel"] = channel
        bitrate = self.options.get("bitrate")
        if bitrate is not None:
            if isinstance(bitrate, bool) or not isinstance(bitrate, int) or bitrate <= 0:
                raise DriverConfigError(f"{self._where}: bitrate must be a whole number of bit/s, not {bitrate!r}")
            settings["bitrate"] = bitrate
        return settings | extra

    def _own_decoder(self) -> OwnDecoder:
        drive_id = self.options.get("drive_id", FIRST_DRIVE)
        if isinstance(drive_id, bool) or not isinstance(drive_id, int) or not FIRST_DRIVE <= drive_id <= LAST_DRIVE:
            raise DriverConfigError(
                f"{self._where}: drive_id must be a whole number {FIRST_DRIVE} .. {LAST_DRIVE}, not {drive_id!r}"
            )
        return OwnDecoder(drive_id, self.counters, self._counts_per_rev())

    def _vendor_decoder(self) -> VendorDecoder:
        for first, second in (("dbc", "signals"), ("signals", "dbc")):
            if first in self.options and second not in self.options:
                raise DriverConfigError(f"{self._where}: '{first}' needs '{second}' as well")
        path = Path(self._text("dbc")).expanduser()
        where = f"{self._where}: {path}"
        signals = parse_signal_map(self.options["signals"], load_dbc(path), where, self.options.get("trigger"))
        counts_per_rev = self._counts_per_rev()
        if signals.get(COUNTS) is not None and counts_per_rev is None:
            raise DriverConfigError(f"{self._where}: position_counts needs counts_per_rev")
        return VendorDecoder(
            signals,
            self.counters,
            counts_per_rev=counts_per_rev,
            period_s=self._positive("period_s"),
            stale_s=self._positive("stale_s") or STALE_S,
        )

    def _text(self, key: str) -> str:
        value = self.options.get(key)
        if not isinstance(value, str) or not value:
            raise DriverConfigError(f"{self._where}: option '{key}' is needed, as a text")
        return value

    def _counts_per_rev(self) -> float | None:
        """Negative turns the direction round."""
        value = self.options.get("counts_per_rev")
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or not value:
            raise DriverConfigError(f"{self._where}: counts_per_rev must be a number other than 0, not {value!r}")
        return float(value)

    def _positive(self, key: str) -> float | None:
        value = self.options.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise DriverConfigError(f"{self._where}: {key} must be a positive number, not {value!r}")
        return float(value)
