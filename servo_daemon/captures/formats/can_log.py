"""CAN logs in the files of Vector's tools, BLF and ASC, read by python-can into arrays of frames."""

from __future__ import annotations

import io
import logging
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TextIO

import numpy as np

from drivers.can.decode import FrameBatch, batch_of, key_text
from servo_daemon.captures.capture.bounded import MAX_OBJECTS, check_cells
from servo_daemon.captures.capture.model import capture_error
from servo_daemon.captures.columns.recording import parser_failed
from servo_daemon.errors import CaptureError
from servo_daemon.samples import I64

if TYPE_CHECKING:
    import can
    from can.io.blf import BLFReader

#: A BLF object up to its size, and the least it can have: its header, base and version 1 (can/io/blf.py).
_OBJECT, _OBJECT_LEAST = struct.Struct("<8xI"), 32


@dataclass(frozen=True, slots=True)
class CanLog:
    """The data frames of a log, in order of time; channels count from 1, 0: the log does not tell."""

    path: Path
    frames: FrameBatch
    channels: I64

    def heard(self) -> str:
        """What is on the bus, in words."""
        counts = Counter(self.frames.keys.tolist())
        shown = ", ".join(f"{key_text(key)} ({n})" for key, n in sorted(counts.items())[:16])
        return f"{shown} and {len(counts) - 16} more" if len(counts) > 16 else shown


def read_blf(path: Path, raw: BinaryIO) -> CanLog:
    """The frames of an open BLF log.

    Raises:
        CaptureError: damaged, cut off, or without a data frame.
    """
    from can.io.blf import BLFReader

    data = raw.read()
    try:
        with _quiet(), io.BytesIO(data) as copy:  # python-can closes the file when it is through
            reader = _checking(BLFReader)(copy)
            if reader.file_size > len(data):
                raise capture_error(path, f"the BLF log is cut off: {len(data)} of {reader.file_size} bytes are there")
            return _collect(path, reader, "BLF log")
    except CaptureError:
        raise
    except Exception as error:  # the parser raises whatever the bytes make it stumble over
        raise parser_failed(path, "BLF log", error) from error


def _checking(reader: type[BLFReader]) -> type[BLFReader]:
    """python-can's reader, which goes round for ever where an object says it has no length, with a look at that."""

    class CheckingReader(reader):  # type: ignore[misc, valid-type]  # a base that is imported late
        def _parse_data(self, data: bytes) -> Iterator[can.Message]:
            at = 0
            while (at := data.find(b"LOBJ", at, at + 8)) >= 0 and at + _OBJECT.size <= len(data):
                size = _OBJECT.unpack_from(data, at)[0]
                if size < _OBJECT_LEAST:
                    raise ValueError(f"an object of {size} bytes")
                at += size
            yield from super()._parse_data(data)

    return CheckingReader


@contextmanager
def _quiet() -> Iterator[None]:
    """Without python-can's own log lines about what it passes over."""
    log = logging.getLogger("can.io")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)


def read_asc(path: Path, text: TextIO) -> CanLog:
    """The frames of an open ASC log; raises as `read_blf`."""
    from can.io.asc import ASCReader

    try:
        content = text.read()
        if not content.endswith("\n"):
            raise capture_error(path, "the ASC log is cut off: its last line has no end")
        with _quiet(), io.StringIO(content) as copy:
            reader = ASCReader(copy)
            log = _collect(path, reader, "ASC log")
            if reader.timestamps_format == "relative":
                raise capture_error(path, "its time stamps are relative to the line before: save it with absolute ones")
            return log
    except CaptureError:
        raise
    except Exception as error:  # as above
        raise parser_failed(path, "ASC log", error) from error


def _collect(path: Path, messages: Iterable[can.Message], what: str) -> CanLog:
    data = (m for m in messages if not (m.is_error_frame or m.is_remote_frame))
    kept = list(islice(data, MAX_OBJECTS + 1))
    check_cells(path, len(kept), 1, MAX_OBJECTS)
    if not kept:
        raise capture_error(path, f"the {what} holds no data frame, or is cut off before the first")
    kept.sort(key=lambda m: m.timestamp)  # stable: channels may have been written one after the other
    last_s = kept[-1].timestamp
    channels = np.array([m.channel + 1 if isinstance(m.channel, int) else 0 for m in kept], np.int64)
    return CanLog(path, batch_of(kept, last_s, last_s), channels)
