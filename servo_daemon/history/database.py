"""Opening the database, and what is done with a file that is broken."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from servo_daemon.errors import ConfigError
from servo_daemon.history import tables
from servo_daemon.history.salvage import salvage

log = logging.getLogger(__name__)

#: Another process that holds the lock (a backup, a shell) is waited for so long before it is told, s.
BUSY_S: Final = 2.0
#: A server that does not answer is given up after this long, s.
_CONNECT_S: Final = 5
#: SQLite's own checkpoint, which a commit would wait for, comes only after so many pages of the log (64 MB): the writer
#: makes one each minute (`checkpoint`), and 32 drives write 10 MB of log in that.
_LOG_PAGES: Final = 16_384
_BROKEN: Final = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})


class BrokenError(Exception):
    """The file is damaged inside."""


def is_broken(error: BaseException) -> bool:
    """Whether an error of the database says that its file is damaged, not just out of reach."""
    if isinstance(error, BrokenError):
        return True
    cause = error.orig if isinstance(error, DBAPIError) else error
    code = getattr(cause, "sqlite_errorcode", None)
    return isinstance(cause, sqlite3.DatabaseError) and code is not None and code & 0xFF in _BROKEN


def describe(error: BaseException) -> str:
    """The error in one line, without SQL."""
    cause: BaseException = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    lines = str(getattr(cause, "strerror", None) or cause).strip().splitlines()
    return lines[0] if lines else type(cause).__name__


class Database:
    """One database: a SQLite file, or a server.

    Args:
        path: of the file; None where `url` is given.
        url: SQLAlchemy's, `postgresql://user@host/name`.

    Raises:
        ConfigError: the URL makes no sense, or its driver is not installed.
    """

    def __init__(self, path: Path | None, url: str | None = None) -> None:
        self.path = path
        self.where = str(path) if url is None else _without_password(url)
        self._engine = _file_engine(path) if path is not None else _server_engine(url or "")

    def open(self) -> sa.Engine:
        """The engine, its tables in place. A file that is no database is set aside, and what can be saved of it is.

        Raises:
            OSError, DBAPIError: it cannot be had now.
            NewerSchemaError: it is of a later version.
        """
        try:
            self._prepare()
        except DBAPIError as error:
            if self.path is None or not is_broken(error):
                raise
            self.replace(describe(error))
        return self._engine

    @property
    def vanished(self) -> bool:
        """The file is no longer where it was: open connections write to one that nobody will find again."""
        if self.path is None or self.path.exists():
            return False
        self.close()
        return True

    def _prepare(self) -> None:
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._engine.begin() as connection:
            tables.ensure_schema(connection)

    def damage(self) -> str | None:
        """What is damaged inside of the file; None: nothing, or it cannot be read now. Others may write meanwhile.

        Reads all of it: 0.7 ms of CPU a MB from memory, and as long as the disk takes (a card of 20 MB/s: 50 ms).
        """
        if self.path is None:
            return None
        try:
            with self._engine.connect() as connection:
                found = str(connection.exec_driver_sql("PRAGMA quick_check(1)").scalar())
        except DBAPIError as error:
            return describe(error) if is_broken(error) else None
        return None if found == "ok" else found.splitlines()[-1]

    def replace(self, why: str) -> None:
        """Set the file aside (as `*.bad`), begin a new one and take over what can be read of the old."""
        assert self.path is not None
        self.close()
        bad = self.path.with_name(self.path.name + ".bad")
        for ending in ("", "-wal", "-shm"):
            part = self.path.with_name(self.path.name + ending)
            with contextlib.suppress(FileNotFoundError):
                part.replace(bad.with_name(bad.name + ending))
        self._prepare()
        with self._engine.begin() as connection:
            saved = salvage(bad, connection)
        log.warning("history: %s is broken (%s): set aside as %s; saved of it: %s", self.path, why, bad.name, saved)

    def size_bytes(self, connection: sa.Connection) -> int:
        """What the history takes on the disk, without free pages that will be used again."""
        if self.path is None:
            names = ", ".join(f"'{t.name}'" for t in tables.METADATA.sorted_tables)
            text = f"SELECT sum(pg_total_relation_size(oid)) FROM pg_class WHERE relkind = 'r' AND relname IN ({names})"
            return int(connection.scalar(sa.text(text)) or 0)
        count, free, size = (
            int(connection.scalar(sa.text(f"PRAGMA {name}")) or 0)
            for name in ("page_count", "freelist_count", "page_size")
        )
        return (count - free) * size

    def checkpoint(self) -> None:
        """Bring what was committed from the log into the file and onto the disk. Waits for nobody, nor they for it."""
        if self.path is not None:
            with self._engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA wal_checkpoint(PASSIVE)")

    def close(self) -> None:
        """Give every connection back."""
        self._engine.dispose()


def _file_engine(path: Path) -> sa.Engine:
    url = sa.URL.create("sqlite", database=str(path))
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_S, "check_same_thread": False})

    @sa.event.listens_for(engine, "connect")
    def set_up(connection: Any, _record: Any) -> None:
        # WAL: readers and the writer do not wait for each other. NORMAL: after a power cut the file is whole and lacks
        # at most what was written since the last checkpoint; killing the process loses nothing that was committed.
        for pragma in (
            "journal_mode = WAL",
            "synchronous = NORMAL",
            "cache_size = -4000",
            f"wal_autocheckpoint = {_LOG_PAGES}",
        ):
            connection.execute(f"PRAGMA {pragma}")

    return engine


def _server_engine(text: str) -> sa.Engine:
    try:
        url = sa.make_url(text)
        if url.drivername in {"postgresql", "postgres"}:
            url = url.set(drivername="postgresql+psycopg")
        if url.get_backend_name() != "postgresql":
            raise ConfigError(f"history.url: {url.get_backend_name()} is not known here; use postgresql://… or `path`")
        return sa.create_engine(url, pool_pre_ping=True, connect_args={"connect_timeout": _CONNECT_S})
    except (ArgumentError, NoSuchModuleError) as error:
        raise ConfigError(f"history.url: {error}") from None
    except ModuleNotFoundError as error:
        raise ConfigError("history.url: PostgreSQL needs psycopg: pip install 'servo-daemon[postgresql]'") from error


def _without_password(url: str) -> str:
    try:
        return sa.make_url(url).render_as_string(hide_password=True)
    except ArgumentError:
        return "the database"
