"""Opening a serial port, and the words for why it cannot be opened."""

from __future__ import annotations

import errno
import termios
from pathlib import Path

import serial
from serial.tools import list_ports

from servo_daemon.errors import DriverConfigError, DriverUnavailableError

#: The system's buffer of a tty holds 4 kB, with what is still in flight behind it 64 kB: one read takes it all.
READ_SIZE = 65536


class KeepingPort(serial.Serial):  # type: ignore[misc]  # pyserial has no types
    """A port whose opening keeps what has arrived before: a sketch's header line may be in it."""

    def _reset_input_buffer(self) -> None:
        """Called by `open` of pyserial."""


def open_port(name: str, port: str, baudrate: int, *, keep: bool = False) -> serial.Serial:
    """A serial port, opened for nobody else, whose reads and writes never wait.

    Args:
        name: the drive's, for messages.
        keep: what has arrived before is kept.

    Raises:
        DriverConfigError: it can never be opened with these settings.
        DriverUnavailableError: it cannot be opened now.
    """
    try:
        return (KeepingPort if keep else serial.Serial)(port, baudrate, timeout=0, exclusive=True)
    except (ValueError, OverflowError) as error:
        raise DriverConfigError(f"drive {name}: {port}: {error}") from error
    except (OSError, termios.error) as error:
        raise DriverUnavailableError(f"drive {name}: serial port {port} {_why_not(error)}") from error


def _why_not(error: Exception) -> str:
    code = error.errno if isinstance(error, OSError) else None
    if code == errno.ENOENT:
        return f"does not exist; {existing_ports()}"
    if code in (errno.EACCES, errno.EPERM):
        return "may not be opened by this user (is it in the group that owns the port, often 'dialout'?)"
    if code in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY):
        return "is in use by another program"
    return f"cannot be opened: {error}"


def port_names() -> list[str]:
    """The serial ports of this machine, by their stable names where udev gives some."""
    by_id = Path("/dev/serial/by-id")
    names = sorted(str(p) for p in by_id.iterdir()) if by_id.is_dir() else []
    return names or sorted(p.device for p in list_ports.comports())


def existing_ports() -> str:
    """In words, which serial ports this machine has."""
    names = port_names()
    return f"ports here: {', '.join(names)}" if names else "there are no serial ports here"
