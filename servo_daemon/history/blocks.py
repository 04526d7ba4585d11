"""Rows into blocks, blocks into the next level, and out of them again: all SQL of the measured past.

A block is open while its span of time still grows: each turn of the writer adds its rows as a small one. When a drive
goes on to the next span, the small ones become one packed block, and their rows go on, rolled up, to the next level as
an open block of that. Both in one transaction: at any moment each row counts once, in a packed block of its level and
in one block of every coarser level, or as an open block that readers roll up themselves.

Nothing here asks what time it is: a clock that is set back gives a span a second packed block, which readers join.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import sqlalchemy as sa

from servo_daemon.history.codec import BlockError, dump, pack, unpack
from servo_daemon.history.levels import Level
from servo_daemon.history.tables import BLOCK, DRIVE
from servo_daemon.published.buckets import Buckets
from servo_daemon.published.rollup import join, roll_up

log = logging.getLogger(__name__)

_B: Final = BLOCK.c


def drive_id(connection: sa.Connection, name: str, *, make: bool = False) -> int | None:
    """The number of a drive; None where it has never been written (and is not to be made)."""
    found = connection.scalar(sa.select(DRIVE.c.id).where(DRIVE.c.name == name))
    if found is None and make:
        found = connection.execute(sa.insert(DRIVE).values(name=name).returning(DRIVE.c.id)).scalar_one()
    return None if found is None else int(found)


class BlockWriter:
    """Belongs to the writer's thread.

    Args:
        levels: finest first.
    """

    def __init__(self, levels: Sequence[Level]) -> None:
        self._levels = tuple(levels)
        self._open: dict[tuple[int, int], set[int]] = {}

    def resume(self, connection: sa.Connection) -> None:
        """Learn which blocks an earlier run, or a turn that failed, left open."""
        self._open.clear()
        for drive, level, slot in connection.execute(sa.select(_B.drive, _B.level, _B.slot).where(_B.open == 1)):
            self._open.setdefault((drive, level), set()).add(slot)

    def add(self, connection: sa.Connection, drive: int, rows: Buckets) -> None:
        """Single rows, as they were appended (their time may step back)."""
        self._insert_open(connection, drive, self._levels[0], rows)

    def _insert_open(self, connection: sa.Connection, drive: int, level: Level, rows: Buckets) -> None:
        slot = None
        for slot, new in _by_slot(rows, level.block_s):
            known = self._open.setdefault((drive, level.number), set())
            old = [self._taken_out(connection, drive, level, slot)] if level.whole and slot in known else []
            self._insert(connection, drive, level, slot, join([*old, new]), is_open=True)
            known.add(slot)
        for gone in sorted(self._open.get((drive, level.number), set()) - {slot}):
            self._close(connection, drive, level, gone)

    def _close(self, connection: sa.Connection, drive: int, level: Level, slot: int) -> None:
        """Pack an open span and hand it on to the next level."""
        self._open[drive, level.number].discard(slot)
        rows = self._taken_out(connection, drive, level, slot)
        if level.period_s:
            rows = roll_up(rows, level.period_s)
        if not len(rows):
            return
        self._insert(connection, drive, level, slot, rows, is_open=False)
        if level.number + 1 < len(self._levels):
            upper = self._levels[level.number + 1]
            self._insert_open(connection, drive, upper, roll_up(rows, upper.period_s))

    @staticmethod
    def _taken_out(connection: sa.Connection, drive: int, level: Level, slot: int) -> Buckets:
        """The rows of an open span, which are no longer in the table."""
        here = sa.and_(_B.open == 1, _B.drive == drive, _B.level == level.number, _B.slot == slot)
        data = connection.scalars(sa.select(_B.data).where(here).order_by(_B.id)).all()
        connection.execute(sa.delete(BLOCK).where(here))
        return join([rows for d in data if (rows := _read(d)) is not None])

    def _insert(
        self, connection: sa.Connection, drive: int, level: Level, slot: int, rows: Buckets, *, is_open: bool
    ) -> None:
        values = {
            "drive": drive, "level": level.number, "slot": slot, "start": float(rows.time_s.min()),
            "stop": float(rows.time_s.max()), "open": int(is_open), "rows": len(rows),
            "data": dump(rows) if is_open else pack(rows),
        }  # fmt: skip
        connection.execute(sa.insert(BLOCK), values)

    def prune(self, connection: sa.Connection, now_s: float) -> int:
        """Delete packed blocks older than their level keeps them; how many rows of the table that were."""
        gone = 0
        for level in self._levels:
            old = sa.and_(_B.level == level.number, _B.stop < now_s - level.keep_s, _B.open == 0)
            gone += connection.execute(sa.delete(BLOCK).where(old)).rowcount
        return gone

    def shorten(self, connection: sa.Connection, share: float) -> int:
        """Delete the oldest packed blocks of the level (below the coarsest) that takes most; how many that were.

        Args:
            share: of that level's blocks.
        """
        taken = sa.func.sum(sa.func.length(_B.data))
        below = sa.and_(_B.open == 0, _B.level < len(self._levels) - 1)
        largest = connection.execute(
            sa.select(_B.level, sa.func.count()).where(below).group_by(_B.level).order_by(taken.desc()).limit(1)
        ).first()
        if largest is None:
            return 0
        level, count = largest
        number = max(1, int(share * count))
        oldest = sa.select(_B.id).where(_B.open == 0, _B.level == level).order_by(_B.stop).limit(number)
        return int(connection.execute(sa.delete(BLOCK).where(_B.id.in_(oldest))).rowcount)


def read_blocks(
    connection: sa.Connection, drive: int, levels: Sequence[Level], number: int, start_s: float, end_s: float,
    names: Sequence[str] | None, fresh: Buckets | None = None,
) -> Buckets:  # fmt: skip
    """The buckets of one level from `start_s` to `end_s` (begin of the bucket, both inclusive), sorted.

    Args:
        number: of the level.
        names: series that are wanted; None: all.
        fresh: rows that are not in the database yet.
    """
    level = levels[number]
    begin, finer = start_s - max(level.period_s, 1.0), levels[max(0, number - 1)]
    wanted = sa.or_(
        sa.and_(_B.level == number, _B.start.between(begin - level.block_s, end_s)),
        # The last bucket is whole: finer rows of it may begin after the end.
        sa.and_(_B.open == 1, _B.level < number, _B.start.between(begin - finer.block_s, end_s + level.period_s)),
    )
    # One statement: what moves from one level to the next meanwhile is seen in exactly one of them.
    found = connection.execute(sa.select(_B.data).where(_B.drive == drive, wanted)).scalars()
    parts = [rows for data in found if (rows := _read(data, names)) is not None]
    if fresh is not None and len(fresh):
        parts.append(fresh if names is None else fresh.select(names))
    rows = join(parts) if not level.period_s else roll_up(join(list(_rolled(parts, level.period_s))), level.period_s)
    return rows.take((rows.time_s > start_s - max(level.period_s, 1e-3)) & (rows.time_s <= end_s))


def _read(data: bytes, names: Sequence[str] | None = None) -> Buckets | None:
    try:
        return unpack(bytes(data), names)
    except BlockError as error:
        log.warning("history: a block is unreadable and left out: %s", error)
        return None


def _rolled(parts: Sequence[Buckets], period_s: float) -> Iterator[Buckets]:
    """All parts in buckets of `period_s`, those of one level together."""
    for level_s in sorted({p.period_s for p in parts}):
        yield roll_up(join([p for p in parts if p.period_s == level_s]), period_s)


def _by_slot(rows: Buckets, block_s: float) -> Iterator[tuple[int, Buckets]]:
    """Runs of rows of one span each, in their order."""
    slots = np.floor(rows.time_s / block_s).astype(np.int64)
    edges = [0, *(np.flatnonzero(np.diff(slots)) + 1).tolist(), len(rows)]
    for a, b in pairwise(edges):
        if b > a:
            yield int(slots[a]), rows.take(slice(a, b))
