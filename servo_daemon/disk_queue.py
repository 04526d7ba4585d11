"""A queue on disk with a bound: what waits for a receiver that is away, over a restart."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

_TABLE: Final = (
    "CREATE TABLE IF NOT EXISTS items (number INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT, drive TEXT, body BLOB)"
)
#: What a row takes beside its body: SQLite's header, number, two short names.
_ROW_BYTES: Final = 64
#: A full queue makes room in steps of so many rows.
_ROOM: Final = 64


@dataclass(frozen=True, slots=True)
class Item:
    """Something that waits. `number` rises; `kind`, `drive` and `body` are as they were put."""

    number: int
    kind: str
    drive: str
    body: bytes


class DiskQueue:
    """First in, first out; when full, the oldest go. Any thread. No method raises: an unreadable file is set aside as
    `NAME.bad`, what cannot be written counts as dropped, and `problem` says why.

    Args:
        path: of the file; None: in memory.
        limit_bytes: of what waits. (The file keeps its size when it has been emptied.)
    """

    def __init__(self, path: Path | None, limit_bytes: float) -> None:
        self._path, self._limit = path, limit_bytes
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        self._bytes = self._count = 0
        self.dropped = 0
        self.problem: str | None = None
        with self._lock, contextlib.suppress(sqlite3.Error, OSError):
            self._opened()

    def __len__(self) -> int:
        return self._count

    def put(self, entries: Sequence[tuple[str, str, bytes]]) -> None:
        """Append (kind, drive, body) each, durably but for a power cut."""
        if not entries:
            return
        with self._lock:
            try:
                connection = self._opened()
                with connection:
                    connection.executemany("INSERT INTO items (kind, drive, body) VALUES (?, ?, ?)", entries)
                self._count += len(entries)
                self._bytes += sum(len(body) + _ROW_BYTES for _, _, body in entries)
                self._make_room(connection)
                self.problem = None
            except (sqlite3.Error, OSError) as error:
                self.dropped += len(entries)
                self._fail(error)

    def head(self, most: int) -> list[Item]:
        """The oldest, at most so many; they stay until `remove`."""
        with self._lock:
            if not self._count:
                return []
            try:
                rows = self._opened().execute("SELECT * FROM items ORDER BY number LIMIT ?", (most,)).fetchall()
                return [Item(*row) for row in rows]
            except (sqlite3.Error, OSError) as error:
                self._fail(error)
                return []

    def remove(self, last: int) -> None:
        """All up to this number have arrived."""
        with self._lock:
            try:
                self._delete(self._opened(), last)
            except (sqlite3.Error, OSError) as error:
                self._fail(error)

    def close(self) -> None:
        with self._lock:
            self._close()

    def _opened(self) -> sqlite3.Connection:
        if self._connection is None:
            try:
                self._connection = self._open()
            except sqlite3.DatabaseError as error:
                if self._path is None or not _is_broken(error):
                    raise
                bad = self._path.with_name(self._path.name + ".bad")
                self._path.replace(bad)
                for suffix in ("-wal", "-shm"):  # of the old file: a new one must not take them up
                    self._path.with_name(self._path.name + suffix).unlink(missing_ok=True)
                log.warning("%s cannot be read (%s): set aside as %s", self._path, error, bad.name)
                self._connection = self._open()
        return self._connection

    def _open(self) -> sqlite3.Connection:
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(self._path or ":memory:", check_same_thread=False)
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("PRAGMA synchronous=NORMAL")
            connection.execute(_TABLE)
            total = f"SELECT count(*), coalesce(sum(length(body) + {_ROW_BYTES}), 0) FROM items"
            self._count, self._bytes = connection.execute(total).fetchone()
        except sqlite3.Error:
            connection.close()
            raise
        return connection

    def _make_room(self, connection: sqlite3.Connection) -> None:
        while self._bytes > self._limit and self._count > 1:
            sizes = f"SELECT number, length(body) + {_ROW_BYTES} FROM items ORDER BY number LIMIT {_ROOM}"
            excess, last = self._bytes - self._limit, 0
            for number, size in connection.execute(sizes).fetchall():
                last, excess = number, excess - size
                if excess <= 0:
                    break
            self.dropped += self._delete(connection, last)

    def _delete(self, connection: sqlite3.Connection, last: int) -> int:
        total = f"SELECT count(*), coalesce(sum(length(body) + {_ROW_BYTES}), 0) FROM items WHERE number <= ?"
        count, size = connection.execute(total, (last,)).fetchone()
        with connection:
            connection.execute("DELETE FROM items WHERE number <= ?", (last,))
        self._count -= count
        self._bytes -= size
        return int(count)

    def _fail(self, error: Exception) -> None:
        text = f"{self._path or 'the queue'}: {error}"
        if self.problem is None:
            log.warning("what waits to be sent cannot be kept: %s", text)
        self.problem = text
        if self._path is not None:
            self._close()

    def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def _is_broken(error: sqlite3.DatabaseError) -> bool:
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
