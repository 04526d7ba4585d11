"""Spans of time and pages of events as JSON documents; `schemas/past.py` describes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from servo_daemon.api.documents import Document, encode, event_document
from servo_daemon.api.times import iso_utc_list
from servo_daemon.published.archive import EventPage, Span
from servo_daemon.published.buckets import STATUSES, TRUTH, Buckets
from servo_daemon.published.history import STATUS_BY_CODE, HistorySeries, thin
from servo_daemon.published.view import DriveView
from servo_daemon.samples import F64


def column(array: F64) -> list[float | None]:
    """Numbers as JSON can hold them."""
    return [value if known else None for value, known in zip(array.tolist(), np.isfinite(array), strict=True)]


def dominant(buckets: Buckets, k: int) -> list[str | None]:
    """The status that most rows of each bucket had; None where the parameter did not exist."""
    status = buckets.status[:, k]
    most, some = status.argmax(axis=1), status.sum(axis=1)
    return [STATUSES[m] if n else None for m, n in zip(most.tolist(), some.tolist(), strict=True)]


def shares(buckets: Buckets, k: int) -> dict[str, list[float | None]]:
    """Of the statuses that occur: which share of each bucket's rows had it."""
    status = buckets.status[:, k].astype(float)
    total = status.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return {
            name: column(np.round(status[:, s] / total, 4)) for s, name in enumerate(STATUSES) if status[:, s].any()
        }


def series_of(span: Span, name: str, empty: HistorySeries, points: int) -> HistorySeries | Buckets:
    """One series: single rows as the ring gives them, thinned, or buckets; `empty` where there is nothing."""
    buckets = span.buckets
    if name not in buckets.names:
        return empty
    k = buckets.names.index(name)
    if buckets.is_parameter[k]:  # where it was in the model
        buckets = buckets.take(buckets.status[:, k].sum(axis=1) > 0)
    if buckets.period_s:
        return buckets.select([name, f"{name}{TRUTH}"])
    truth = buckets.select([f"{name}{TRUTH}"]).mean
    code = (buckets.status[:, k] * np.arange(1, len(STATUS_BY_CODE))).sum(axis=1).astype(np.int8)
    rows = HistorySeries(
        name, buckets.units[k], buckets.time_s, buckets.mean[:, k], buckets.std[:, k],
        code if buckets.is_parameter[k] else None, truth[:, 0] if truth.shape[1] else None,
    )  # fmt: skip
    return thin(rows, points)


def encode_series(
    view: DriveView, series: HistorySeries | Buckets, span: Span | None = None, note: str | None = None
) -> bytes:
    """`GET /drives/{d}/history` of one series: columns of equal length, oldest first."""
    level = "rows" if span is None else span.level
    if isinstance(series, Buckets):
        name, unit, n = series.names[0], series.units[0], len(series)
        body = {"time": iso_utc_list(series.time_s), **_columns(series, 0)}
        body["truth"] = column(series.mean[:, 1]) if len(series.names) > 1 else None
        period_s = series.period_s
    else:
        name, unit, n, period_s = series.name, series.unit, len(series), 0.0
        status = None if series.status is None else [STATUS_BY_CODE[code] for code in series.status.tolist()]
        body = {
            "time": iso_utc_list(series.time_s),
            "value": column(series.value),
            "std": column(series.std),
            "status": status,
            "truth": None if series.truth is None else column(series.truth),
            **dict.fromkeys(("min", "max", "spread", "count", "share")),
        }
    head = {"drive": view.name, "parameter": name, "unit": unit, "points": n, "level": level, "period_s": period_s}
    return encode({**head, **body, "note": note})


def encode_span(view: DriveView, names: Sequence[str], span: Span, note: str | None) -> bytes:
    """`GET /drives/{d}/history` of several series: one column of times, and each series' own."""
    buckets = span.buckets
    series = {}
    for name in names:
        if name in buckets.names:
            k = buckets.names.index(name)
            series[name] = {"unit": buckets.units[k], **_columns(buckets, k)}
    return encode(
        {
            "drive": view.name,
            "level": span.level,
            "period_s": buckets.period_s,
            "points": len(buckets),
            "time": iso_utc_list(buckets.time_s),
            "series": series,
            "note": note,
        }
    )


def _columns(buckets: Buckets, k: int) -> dict[str, Any]:
    single = buckets.period_s == 0
    parameter = buckets.is_parameter[k]
    return {
        "value": column(buckets.mean[:, k]),
        "std": column(buckets.std[:, k]),
        "status": dominant(buckets, k) if parameter else None,
        "min": None if single else column(buckets.low[:, k]),
        "max": None if single else column(buckets.high[:, k]),
        "spread": None if single else column(buckets.spread[:, k]),
        "count": None if single else buckets.count[:, k].tolist(),
        "share": None if single or not parameter else shares(buckets, k),
    }


def encode_events(page: EventPage) -> bytes:
    """`GET /drives/{d}/events`."""
    document: Document = {
        "events": [event_document(e) for e in page.events],
        "next": None if page.next is None else str(page.next),
    }
    return encode(document)
