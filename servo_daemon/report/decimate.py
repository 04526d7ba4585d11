"""Fewer points that look the same: what a figure keeps of a long recording.

A line keeps, of every stretch of time, its smallest and its largest sample, so that no spike is lost whatever the
zoom; all lines of a figure keep the same rows, so that a reader compares samples of the same moment. No sample is
averaged or moved.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

Rows = NDArray[np.intp]


def _extreme_rows(columns: Sequence[F64], buckets: int) -> Rows:
    """Of each of so many stretches: the rows of the smallest and the largest value of each column."""
    n = columns[0].shape[0]
    edges = np.linspace(0, n, buckets + 1).astype(np.intp)
    width = int(np.max(np.diff(edges)))
    rows = edges[:-1, None] + np.arange(width)
    outside = rows >= edges[1:, None]
    rows = np.minimum(rows, n - 1)
    start = edges[:-1]
    kept = [np.array([0, n - 1], dtype=np.intp)]
    for column in columns:
        values = column[rows]
        void = outside | np.isnan(values)
        kept.append(start + np.argmin(np.where(void, np.inf, values), axis=1))
        kept.append(start + np.argmax(np.where(void, -np.inf, values), axis=1))
    return np.unique(np.concatenate(kept))


def _gap_rows(columns: Sequence[F64], limit: int) -> Rows:
    """The rows on both sides of each end of a gap; thinned evenly where there are very many."""
    changes = [np.flatnonzero(np.diff(np.isnan(column).astype(np.int8))) for column in columns]
    ends = np.unique(np.concatenate(changes))
    if ends.size * 2 > limit:
        ends = ends[np.linspace(0, ends.size - 1, limit // 2).astype(np.intp)]
    return np.union1d(ends, ends + 1)


def keep_rows(columns: Sequence[F64], limit: int, gapped: Sequence[F64]) -> Rows:
    """Rows to keep, increasing, at most `limit`: all of them if they are no more than that.

    Args:
        columns: each of shape (n,), may hold NaN; their extremes are kept.
        limit: >= 8 and >= 4 times the number of columns.
        gapped: those of `columns` whose NaN are gaps that must stay visible.
    """
    n = columns[0].shape[0]
    if n <= limit:
        return np.arange(n, dtype=np.intp)
    gaps = _gap_rows(gapped, limit // 4) if gapped else np.empty(0, dtype=np.intp)
    room = limit - gaps.size
    buckets = (room - 2) // (2 * len(columns))
    best = _extreme_rows(columns, buckets)
    for _ in range(3):  # lines that move together share their extremes: there is room for finer stretches
        finer = min(n, int(buckets * 0.95 * room / best.size))
        if finer <= buckets:
            break
        rows = _extreme_rows(columns, finer)
        if rows.size > room:
            break
        buckets, best = finer, rows
    return np.union1d(best, gaps)


def keep_points(x: F64, y: F64, limit: int) -> Rows:
    """Of a cloud, in the order of x: the extremes of y along x and of x along y, and an even part of the rest.

    Points with a coordinate that is not finite are left out.

    Args:
        x, y: shape (n,).
        limit: how many are kept at most, >= 64.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if rows.size > limit:
        by_x = rows[np.argsort(x[rows], kind="stable")]
        by_y = rows[np.argsort(y[rows], kind="stable")]
        edge = np.union1d(
            by_x[_extreme_rows([y[by_x]], limit // 8)],
            by_y[_extreme_rows([x[by_y]], limit // 8)],
        )
        rest = np.setdiff1d(rows, edge, assume_unique=True)
        count = min(rest.size, limit - edge.size)
        rows = np.union1d(edge, rest[np.linspace(0, rest.size - 1, count).astype(np.intp)])
    return rows[np.argsort(x[rows], kind="stable")]
