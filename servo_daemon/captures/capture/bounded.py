"""Bounded input: how much a file may become in memory before it is refused in words, whatever its size on disk."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

from servo_daemon.captures.capture.model import capture_error

#: Bytes of text, unpacked: an hour at 5 kHz with five columns of 10 digits.
MAX_BYTES = 1 << 30
#: Bytes of a line: a header of 1,000 long names has a third of it.
MAX_LINE = 65536
#: Numbers read of one file, rows × columns: an hour at 1 kHz with nine columns, a quarter of a gigabyte.
MAX_CELLS = 1 << 25
#: The same where each is a Python object (a sheet's cells, a JSON document's, a CAN log's frames): about a gigabyte.
MAX_OBJECTS = 10_000_000


def check_cells(path: Path, rows: int, columns: int, most: int = MAX_CELLS) -> None:
    """Refuse a table that is too large to be taken into memory.

    Raises:
        CaptureError: it is.
    """
    if rows * columns > most:
        raise capture_error(path, f"{rows:,} rows of {columns} columns: at most {most:,} numbers are read; cut it up")


class BoundedBytes(io.BufferedIOBase):
    """A stream that refuses to yield more than `MAX_BYTES`, or a line longer than `MAX_LINE`.

    Args:
        path: for messages.
        inner: seekable; what it yields is counted from its beginning.
    """

    def __init__(self, path: Path, inner: BinaryIO) -> None:
        self._path, self._inner = path, inner
        self._taken = self._run = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._run = 0
        self._taken = self._inner.seek(offset, whence)
        return self._taken

    def tell(self) -> int:
        return self._taken

    def read(self, size: int | None = -1) -> bytes:
        """All that is left, in pieces, so that the bound holds; or `size` bytes."""
        if size is not None and size >= 0:
            return self.read1(size)
        pieces = []
        while piece := self.read1(MAX_LINE):
            pieces.append(piece)
        return b"".join(pieces)

    def read1(self, size: int = -1) -> bytes:
        data = self._inner.read(size if size >= 0 else MAX_LINE)
        self._taken += len(data)
        if self._taken > MAX_BYTES:
            raise capture_error(self._path, f"more than {MAX_BYTES >> 20} MB of text, unpacked: cut the capture up")
        end = max(data.rfind(b"\n"), data.rfind(b"\r"))
        self._run = self._run + len(data) if end < 0 else len(data) - end - 1
        if self._run > MAX_LINE:
            raise capture_error(self._path, f"not a text file: a line of more than {MAX_LINE} bytes")
        return data
