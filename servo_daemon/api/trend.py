"""`/trend`: what is published of the ageing of a drive's parameters, as a document."""

from __future__ import annotations

from servo_daemon.api.documents import Document, scalar
from servo_daemon.published.trends import DAY_S
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DriveView
from servo_daemon.trend.records import HORIZON_Y, Change, Range, Trend
from servo_daemon.trend.words import sentence


def trend_document(view: DriveView) -> Document:
    """`GET /drives/{drive}/trend`."""
    found = view.trends
    shown = view.initial_parameters if (estimate := view.snapshot().estimate) is None else estimate.parameters
    units = {p.name: p.unit for p in shown}
    return {
        "drive": view.name,
        "time": None if found.time is None else iso_utc(found.time),
        "reason": found.reason,
        "warn_before_days": found.warn_before_d,
        "horizon_years": HORIZON_Y,
        "near": sorted(found.near),
        "parameters": {name: _trend(name, units.get(name, ""), trend) for name, trend in found.trends.items()},
    }


def _trend(name: str, unit: str, trend: Trend) -> Document:
    limit = trend.limit
    return {
        "status": trend.status,
        "text": sentence(name, trend),
        "reason": trend.reason,
        "unit": unit,
        "probability": scalar(trend.probability),
        "since": None if trend.since_d is None else iso_utc(trend.since_d * DAY_S),
        "value": _range(trend.level),
        "rate_per_year": _range(trend.rate_1_y),
        "rate_percent_per_year": _range(trend.rate_percent),
        "limit": None if limit is None else {"name": limit.name, "value": limit.value},
        "years_until_limit": _range(trend.years),
        "life_used": _range(trend.used),
        "changes": [_change(change) for change in trend.changes],
        "value_at_25_C": scalar(trend.at_25_C),
        "remark": trend.remark,
    }


def _range(of: Range | None) -> Document | None:
    return None if of is None else {"low": scalar(of.low), "mid": scalar(of.mid), "high": scalar(of.high)}


def _change(change: Change) -> Document:
    kind = "exchange" if change.is_exchange else "step"
    return {"time": iso_utc(change.time_d * DAY_S), "size": scalar(change.size), "kind": kind}
