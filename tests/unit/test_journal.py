"""Log lines to systemd's journal, read from a socket as journald does."""

from __future__ import annotations

import logging
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from servo_daemon.journal import JournalHandler, is_journal
from servo_daemon.pipeline.event_log import EventLog


class Fallback(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@pytest.fixture
def journald(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(tmp_path / "socket"))
        line.settimeout(5.0)
        yield line


@pytest.fixture
def fallback(tmp_path: Path) -> Iterator[Fallback]:
    """What the handler of the whole program gives it; the handler is at work meanwhile."""
    fallback = Fallback()
    handler, root = JournalHandler(fallback, tmp_path / "socket"), logging.getLogger("servo_daemon")
    handler.setFormatter(logging.Formatter("%(message)s"))
    before, root.level = root.level, logging.DEBUG
    root.addHandler(handler)
    yield fallback
    root.removeHandler(handler)
    root.setLevel(before)
    handler.close()


def fields(datagram: bytes) -> dict[str, str]:
    """By the rules of the native protocol."""
    found, rest = {}, datagram
    while rest:
        line, _, rest = rest.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            (size,) = struct.unpack_from("<Q", rest)
            value, rest = rest[8 : 8 + size], rest[8 + size + 1 :]
        found[name.decode()] = value.decode()
    return found


def test_an_event_has_its_drive_kind_and_data_as_fields(journald: socket.socket, fallback: Fallback) -> None:
    EventLog("axis1").add("alarm", "R = 0.71 Ω\nis high", {"parameter": "R", "value": 0.71, "std": None, "nA-x": 1})
    told = fields(journald.recv(65536))
    assert told == {
        "MESSAGE": "drive axis1: R = 0.71 Ω\nis high", "PRIORITY": "4", "SYSLOG_IDENTIFIER": "servo-daemon",
        "LOGGER": "servo_daemon.pipeline.event_log", "SERVO_DRIVE": "axis1", "SERVO_EVENT": "alarm",
        "SERVO_PARAMETER": "R", "SERVO_VALUE": "0.71", "SERVO_NA_X": "1",
    }  # fmt: skip
    assert fallback.lines == []


def test_other_lines_go_there_too_with_their_traceback(journald: socket.socket, fallback: Fallback) -> None:
    try:
        raise ValueError("reason")
    except ValueError:
        logging.getLogger("servo_daemon.x").exception("failed")
    told = fields(journald.recv(65536))
    assert told["MESSAGE"].startswith("failed\nTraceback") and told["MESSAGE"].endswith("ValueError: reason")
    assert (told["PRIORITY"], told["LOGGER"]) == ("3", "servo_daemon.x")


def test_what_the_journal_does_not_take_goes_to_stderr(journald: socket.socket, fallback: Fallback) -> None:
    log = logging.getLogger("servo_daemon.x")
    log.info("%s", "too long for a datagram" * 100_000)
    journald.close()
    log.info("nobody reads")
    assert [line[:12] for line in fallback.lines] == ["too long for", "nobody reads"]


def test_stderr_is_the_journal_only_if_it_is_that_very_stream(tmp_path: Path) -> None:
    with (tmp_path / "stream").open("wb") as stream:
        found = os.fstat(stream.fileno())
        assert is_journal(stream.fileno(), {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"})
        assert not is_journal(stream.fileno(), {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino + 1}"})
        assert not is_journal(stream.fileno(), {})
        assert not is_journal(12345, {"JOURNAL_STREAM": "1:2"})
