"""A drive on a CAN bus that is listened to: python-can for the bus, a decoder for the frames."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

from drivers.base import DriveInfo, Driver, disconnected
from drivers.can.decode import FrameBatch
from drivers.can.port import CanPort, Inbox
from servo_daemon.errors import DriverConfigError, DriverError
from servo_daemon.samples import SampleBlock

#: Options of every drive on a bus.
BUS_OPTIONS = ("interface", "channel", "bitrate", "bus")

#: python-can waits 2 s after opening an slcan adapter, for boards that start anew when their port is opened. USB-CAN
#: adapters do not; `bus = {sleep_after_open = 2.0}` brings it back.
SLCAN_SETTLE_S = 0.1


def needed_text(options: Mapping[str, Any], key: str, where: str) -> str:
    """An option that has to be there.

    Raises:
        DriverConfigError: it is not, or is no text.
    """
    value = options.get(key)
    if not isinstance(value, str) or not value:
        raise DriverConfigError(f"{where}: option '{key}' is needed, as a text")
    return value


def bus_settings(options: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Keyword arguments for `can.Bus` by `BUS_OPTIONS`; others are passed over.

    Raises:
        DriverConfigError: one is missing or wrong.
    """
    extra = options.get("bus", {})
    if not isinstance(extra, dict):
        raise DriverConfigError(f"{where}: 'bus' must be a table of python-can arguments")
    for key in BUS_OPTIONS:
        if key in extra:
            raise DriverConfigError(f"{where}: '{key}' belongs beside the table 'bus', not in it")
    interface = needed_text(options, "interface", where)
    settings: dict[str, Any] = {"interface": interface}
    if interface == "slcan":
        settings["sleep_after_open"] = SLCAN_SETTLE_S
        if os.name == "posix":  # elsewhere a serial port cannot be waited for with select
            settings["timeout"] = 0
    channel = options.get("channel")
    if channel is not None:
        if isinstance(channel, bool) or not isinstance(channel, str | int):
            raise DriverConfigError(f"{where}: channel must be a text or a number, not {channel!r}")
        settings["channel"] = channel
    bitrate = options.get("bitrate")
    if bitrate is not None:
        if isinstance(bitrate, bool) or not isinstance(bitrate, int) or bitrate <= 0:
            raise DriverConfigError(f"{where}: bitrate must be a whole number of bit/s, not {bitrate!r}")
        settings["bitrate"] = bitrate
    return settings | extra


class FrameDecoder(Protocol):
    """What turns one drive's frames into samples."""

    @property
    def keys(self) -> frozenset[int]: ...

    @property
    def info(self) -> DriveInfo: ...

    def reset(self) -> None: ...

    def feed(self, batch: FrameBatch) -> list[SampleBlock]: ...


class BusListener(Driver):
    """A driver of one drive on a CAN bus.

    Args:
        known: options that it has beside `BUS_OPTIONS`.

    Raises:
        DriverConfigError: unknown or wrong options.
    """

    def __init__(self, name: str, options: dict[str, Any], known: tuple[str, ...]) -> None:
        super().__init__(name, options)
        self._where = f"drive {name}"
        for key in options:
            if key not in (*BUS_OPTIONS, *known):
                listed = ", ".join((*BUS_OPTIONS, *known))
                raise DriverConfigError(f"{self._where}: unknown option '{key}': known are {listed}")
        self._settings = bus_settings(options, self._where)
        self._blocks: deque[SampleBlock] = deque()
        self._port: CanPort | None = None
        self._inbox: Inbox | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments for `can.Bus`."""
        return dict(self._settings)

    @property
    def _frames(self) -> FrameDecoder:
        """What turns this drive's frames into samples."""
        raise NotImplementedError

    @property
    def info(self) -> DriveInfo:
        return self._frames.info

    def _open(self) -> None:
        self._frames.reset()
        self._blocks.clear()
        self._inbox = Inbox(self._frames.keys, self.counters)
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
                self._blocks.extend(self._frames.feed(batch))
            elif time.monotonic() >= deadline or not self._is_open:
                return None
        return self._blocks.popleft()

    def _close(self) -> None:
        port, self._port = self._port, None
        inbox, self._inbox = self._inbox, None
        if port is not None and inbox is not None:
            port.detach(inbox)

    def _positive(self, key: str) -> float | None:
        value = self.options.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise DriverConfigError(f"{self._where}: {key} must be a positive number, not {value!r}")
        return float(value)
