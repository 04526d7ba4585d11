"""Opening, draining and closing one python-can bus, whatever the interface behind it does wrong."""

from __future__ import annotations

import contextlib
import logging
import selectors
import time
from collections.abc import Mapping
from typing import Any

import can
from can.interfaces.slcan import slcanBus

from drivers.can.slcan import ReadAhead, is_taken
from servo_daemon.errors import DriverConfigError, DriverUnavailableError

log = logging.getLogger(__name__)

#: Frames are gathered this long after the first: from eight drives at 1 kHz two hundred frames for one wake-up of each
#: reader, which share the cost of one block. 25 ms leave most of the 60 ms from a sample to the API, and are half of
#: the silence after which samples wait for a Sync (`DOUBT_S`).
GATHER_S = 0.025
#: Meanwhile the system's queue is emptied so often: the smallest in the path (a SocketCAN socket: some 270 frames)
#: then holds two and a half times as much of a full bus.
FETCH_S = GATHER_S / 2
#: Frames drained in one go at most, so that a bus that never falls silent is still handed on.
MAX_FRAMES = 8_192
#: A message the adapter's library stumbles over is one thing, so many in a row another.
MAX_BAD_IN_A_ROW = 20


class Receiver:
    """Waits for a bus and drains it."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._ahead = getattr(bus, "serialPortOrig", None)
        self._selector: selectors.BaseSelector | None = None
        self.bad_lines = 0
        self._bad_in_a_row = 0
        self._failure: Exception | None = None
        selector = selectors.DefaultSelector()
        try:
            selector.register(bus.fileno(), selectors.EVENT_READ)
            self._selector = selector
        except Exception:  # NotImplementedError by contract, but not every interface keeps it: `recv` waits then
            selector.close()

    def take_bad_lines(self) -> int:
        bad, self.bad_lines = self.bad_lines, 0
        return bad

    def receive(self, timeout_s: float, *, prompt: bool = False) -> list[can.Message]:
        """Everything that has arrived `GATHER_S` after the first frame, or `prompt` with it; nothing after `timeout_s`
        of silence.

        Raises:
            can.CanError, OSError: the adapter is gone.
        """
        if self._failure is not None:
            raise self._failure
        messages: list[can.Message] = []
        if self._selector is None:
            first = self._next(timeout_s)
            if first is None:
                return messages
            messages.append(first)
        elif not self._read_ahead() and not self._selector.select(timeout_s):
            return messages
        try:
            for _ in range(1 if prompt else round(GATHER_S / FETCH_S)):
                time.sleep(0.0 if prompt else FETCH_S)
                self._drain(messages)
        except Exception as error:
            if not messages:
                raise
            self._failure = error  # what came before it is good, and is delivered first
        return messages

    def _drain(self, messages: list[can.Message]) -> None:
        while len(messages) < MAX_FRAMES:
            message = self._next(0.0)
            if message is not None:
                messages.append(message)
            elif not self._read_ahead():
                return

    def _read_ahead(self) -> bool:
        """Whether bytes are already in memory, of which no select will tell."""
        return isinstance(self._ahead, ReadAhead) and self._ahead.buffered

    def _next(self, timeout_s: float) -> can.Message | None:
        """One frame, or None; a message the adapter's library cannot read is counted.

        slcan lets ValueError and IndexError out for a line it cannot parse. An error of the operating system is
        final, and so is one with an error code; what else a library raises may just be about one message
        (python-can's own examples for CanOperationError say so), unless it goes on.
        """
        try:
            message = self._bus.recv(timeout_s)
        except (ValueError, IndexError):
            self.bad_lines += 1
            return None
        except can.CanOperationError as error:
            self.bad_lines += 1
            self._bad_in_a_row += 1
            if isinstance(error.__cause__, OSError) or error.error_code is not None:
                raise
            if self._bad_in_a_row > MAX_BAD_IN_A_ROW:
                raise
            return None
        if message is not None:
            self._bad_in_a_row = 0
            if len(message.data) != message.dlc and not message.is_remote_frame and not message.is_error_frame:
                self.bad_lines += 1  # an slcan line that ended early
                return None
        return message

    def close(self) -> None:
        if self._selector is not None:
            self._selector.close()


def open_bus(settings: Mapping[str, Any]) -> can.BusABC:
    """A python-can bus.

    Raises:
        DriverUnavailableError: it cannot be opened now (adapter missing, busy, no permission).
        DriverConfigError: no such interface, its library is not installed, or it refuses the arguments.
    """
    what = f"{settings['interface']} {settings.get('channel', '')}".strip()
    port = str(settings.get("channel", "")).partition("@")[0]
    if settings["interface"] == "slcan" and is_taken(port):
        raise DriverUnavailableError(f"CAN interface {what} is in use by another program")
    try:
        bus = can.Bus(ignore_config=True, **settings)
    except (NotImplementedError, ImportError) as error:  # CanInterfaceNotImplementedError is one
        raise DriverConfigError(f"CAN interface {what}: {error}") from error
    except Exception as error:  # every vendor's library has errors of its own
        if isinstance(error, TypeError | ValueError) or isinstance(error.__cause__, TypeError | ValueError):
            raise DriverConfigError(f"CAN interface {what} refuses its settings: {error}") from error
        raise DriverUnavailableError(f"CAN interface {what} cannot be opened: {error}") from error
    if isinstance(bus, slcanBus) and bus.serialPortOrig.timeout == 0:
        bus.serialPortOrig.exclusive = True  # python-can leaves it to every other program, too
        bus.serialPortOrig = ReadAhead(bus.serialPortOrig)
    return bus


def close_bus(bus: can.BusABC) -> None:
    """Shut a bus down, also one whose adapter is gone. Never raises."""
    try:
        bus.shutdown()
    except Exception as error:  # the adapter's library may fail in any way when the adapter is gone
        log.debug("closing %s: %s", bus.channel_info, error)
    serial_port = getattr(bus, "serialPortOrig", None)
    if serial_port is not None:  # slcan leaves the port open when its closing command cannot be written
        with contextlib.suppress(Exception):
            serial_port.close()
