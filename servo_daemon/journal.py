"""systemd's journal by its native protocol: log lines with fields of their own, so that `journalctl SERVO_DRIVE=axis1`
finds what happened to a drive.

https://systemd.io/JOURNAL_NATIVE_PROTOCOL/
"""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Final

SOCKET: Final = Path("/run/systemd/journal/socket")
#: syslog(3)'s numbers of severities.
_PRIORITY: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
#: What is more is cut off (the protocol): 64 characters, no underscore in front.
_LONGEST_NAME: Final = 64


def priority(level: int) -> int:
    """The journal's priority of a level of logging."""
    return next((p for least, p in _PRIORITY if level >= least), 7)


def is_journal(stream: int, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether a file descriptor leads to the journal: JOURNAL_STREAM names its device and inode (systemd.exec(5))."""
    device, _, inode = environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        found = os.fstat(stream)
    except OSError:
        return False
    return (device, inode) == (str(found.st_dev), str(found.st_ino))


class JournalHandler(logging.Handler):
    """Sends each record as one datagram, with what its `fields` holds as SERVO_<NAME> beside the message.

    Args:
        fallback: takes what cannot be sent.
    """

    def __init__(self, fallback: logging.Handler, address: Path = SOCKET) -> None:
        super().__init__()
        self._fallback, self._address = fallback, str(address)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._socket.sendto(self._datagram(record), self._address)
        except OSError:  # no journal, a full one, a record too long for a datagram
            self._fallback.handle(record)

    def close(self) -> None:
        self._socket.close()
        super().close()

    def _datagram(self, record: logging.LogRecord) -> bytes:
        own: Mapping[str, object] = getattr(record, "fields", {})
        fields = {
            "MESSAGE": self.format(record),
            "PRIORITY": str(priority(record.levelno)),
            "SYSLOG_IDENTIFIER": "servo-daemon",
            "LOGGER": record.name,
            **{_name(key): str(value) for key, value in own.items() if value is not None},
        }
        return b"".join(_field(name, value.encode("utf-8", "replace")) for name, value in fields.items())


def _name(key: str) -> str:
    return ("SERVO_" + re.sub(r"[^A-Z0-9_]", "_", key.upper()))[:_LONGEST_NAME]


def _field(name: str, value: bytes) -> bytes:
    if b"\n" not in value:
        return name.encode() + b"=" + value + b"\n"
    return name.encode() + b"\n" + struct.pack("<Q", len(value)) + value + b"\n"
