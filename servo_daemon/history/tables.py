"""The tables, in SQLAlchemy Core: the same in SQLite (STRICT) and PostgreSQL; and what leads here from older ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import sqlalchemy as sa

from servo_daemon.errors import ServoDaemonError

#: Strict tables of SQLite know no other names of types.
_Real: Final[sa.Double[float]] = sa.Double().with_variant(sa.REAL(), "sqlite")
_Big = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

METADATA: Final = sa.MetaData()


def _table(name: str, *parts: sa.Column[object] | sa.Index) -> sa.Table:
    return sa.Table(name, METADATA, *parts, sqlite_strict=True)


META: Final = _table("meta", sa.Column("key", sa.Text, primary_key=True), sa.Column("value", sa.Text, nullable=False))

DRIVE: Final = _table(
    "drive", sa.Column("id", sa.Integer, primary_key=True), sa.Column("name", sa.Text, nullable=False, unique=True)
)

#: Rows of one drive and level in one span of time (`codec.py`). `open`: not yet rolled up into the next level.
BLOCK: Final = _table(
    "block",
    sa.Column("id", _Big, primary_key=True),
    sa.Column("drive", sa.Integer, nullable=False),
    sa.Column("level", sa.Integer, nullable=False),
    sa.Column("slot", _Big, nullable=False),  # begin of the span in lengths of the level's block
    sa.Column("start", _Real, nullable=False),  # UTC seconds of the first and the last row
    sa.Column("stop", _Real, nullable=False),
    sa.Column("open", sa.Integer, nullable=False),
    sa.Column("rows", sa.Integer, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
    sa.Index("block_time", "drive", "level", "start"),
    sa.Index("block_open", "open", "drive", "level", "slot"),
    sa.Index("block_age", "level", "stop"),
)

EVENT: Final = _table(
    "event",
    sa.Column("id", _Big, primary_key=True),
    sa.Column("drive", sa.Integer, nullable=False),
    sa.Column("time", _Real, nullable=False),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("message", sa.Text, nullable=False),
    sa.Column("data", sa.Text, nullable=False),  # JSON
    sa.Index("event_time", "drive", "time"),
)

#: What is kept for good as a document: results of diagnoses, models that a drive was given.
DOCUMENT: Final = _table(
    "document",
    sa.Column("id", _Big, primary_key=True),
    sa.Column("drive", sa.Integer, nullable=False),
    sa.Column("time", _Real, nullable=False),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("body", sa.Text, nullable=False),  # JSON
    sa.Index("document_time", "drive", "kind", "time"),
)

Migration = Callable[[sa.Connection], None]
#: Migration k leads from schema k + 1 to k + 2. There has been one schema so far.
MIGRATIONS: Final[tuple[Migration, ...]] = ()


class NewerSchemaError(ServoDaemonError):
    """The database was written by a newer version of this program; it is left alone."""


def ensure_schema(connection: sa.Connection, migrations: Sequence[Migration] = MIGRATIONS) -> None:
    """Make the tables where there are none, or bring older ones up to date, inside the caller's transaction.

    Raises:
        NewerSchemaError: they are of a later version.
    """
    newest = len(migrations) + 1
    if not sa.inspect(connection).has_table(META.name):
        METADATA.create_all(connection)
        connection.execute(sa.insert(META).values(key="schema", value=str(newest)))
        return
    version = int(connection.scalar(sa.select(META.c.value).where(META.c.key == "schema")) or newest)
    if version > newest:
        raise NewerSchemaError(f"its schema is {version}, this version of the program knows {newest}: use a newer one")
    for step in migrations[version - 1 :]:
        step(connection)
    if version < newest:
        connection.execute(sa.update(META).where(META.c.key == "schema").values(value=str(newest)))
