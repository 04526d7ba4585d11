"""A history from one database into another: `python -m servo_daemon.history.move FROM TO`, each the path of a SQLite
file or a postgresql:// URL. For a daemon that is stopped; FROM stays as it is, TO must be empty.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from servo_daemon.errors import BadInputError, ServoDaemonError
from servo_daemon.history.database import Database, describe
from servo_daemon.history.tables import BLOCK, DOCUMENT, DRIVE, EVENT

#: Rows that are copied at once.
_BATCH: Final = 500


def move(source: Database, target: Database) -> dict[str, int]:
    """Copy every row, in one transaction; how many of each table.

    Raises:
        BadInputError: there is no history in `source`, or already one in `target`.
        ServoDaemonError: one of them cannot be had.
    """
    if source.path is not None and not source.path.is_file():
        raise BadInputError(f"{source.where}: there is no such file")
    try:
        with source.open().connect() as old, target.open().begin() as new:
            if new.scalar(sa.select(sa.func.count()).select_from(DRIVE)):
                raise BadInputError(f"{target.where} has a history already")
            return {table.name: _copy(old, new, table) for table in (DRIVE, EVENT, DOCUMENT, BLOCK)}
    except (SQLAlchemyError, OSError) as error:
        raise ServoDaemonError(f"the history cannot be moved: {describe(error)}") from error
    finally:
        source.close()
        target.close()


def _copy(old: sa.Connection, new: sa.Connection, table: sa.Table) -> int:
    rows, number = old.execute(sa.select(table).order_by(table.c.id)).mappings(), 0
    while batch := rows.fetchmany(_BATCH):
        new.execute(sa.insert(table), [dict(row) for row in batch])
        number += len(batch)
    if new.dialect.name == "postgresql" and number:  # rows that brought their numbers left the counter where it was
        last = sa.select(sa.func.max(table.c.id)).scalar_subquery()
        new.execute(sa.select(sa.func.setval(sa.func.pg_get_serial_sequence(table.name, "id"), last)))
    return number


def _database(text: str) -> Database:
    return Database(None, text) if "://" in text else Database(Path(text))


def main(words: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    if len(words) != 2:
        print("usage: python -m servo_daemon.history.move FROM TO", file=sys.stderr)
        return 2
    try:
        moved = move(_database(words[0]), _database(words[1]))
    except ServoDaemonError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(", ".join(f"{number} {name}s" for name, number in moved.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
