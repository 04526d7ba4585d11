"""Published records as JSON documents. `schemas/` describes the same documents for readers.

Every number passes `scalar`, so no document ever holds NaN, an infinity or a NumPy type.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from servo_daemon.published.snapshot import (
    Event,
    ParameterEstimate,
    Snapshot,
    finite_or_none,
)
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DaemonView, DriveView

Document = dict[str, Any]


def encode(document: Document) -> bytes:
    """The document as compact UTF-8 JSON.

    Raises:
        ValueError: NaN or an infinity in it.
    """
    return json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode("utf-8", "replace")


def scalar(value: object) -> float | int | bool | str | None:
    """A value as JSON can hold it; what is not finite becomes None."""
    if type(value) is float:  # nearly all
        return value if math.isfinite(value) else None
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    return finite_or_none(value) if isinstance(value, float) else str(value)


def _scalars(values: Mapping[str, object]) -> Document:
    return {key: scalar(value) for key, value in values.items()}


def _time_or_none(epoch_s: float | None) -> str | None:
    return None if epoch_s is None else iso_utc(epoch_s)


def _parameters(parameters: Iterable[ParameterEstimate]) -> Document:
    return {
        p.name: {
            "value": scalar(p.value),
            "std": scalar(p.std),
            "unit": p.unit,
            "nominal": scalar(p.nominal),
            "status": p.status,
            "reason": p.reason,
            "age_s": scalar(p.age_s),
        }
        for p in parameters
    }


def estimates_document(drive: DriveView, snapshot: Snapshot) -> Document:
    """`GET /drives/{d}/estimates`. Before the first samples: nominal values or null, status "estimating"."""
    estimate = snapshot.estimate
    health: Document = {
        "connection": snapshot.connection,
        "connection_reason": snapshot.reason,
        "overloaded": snapshot.overloaded,
        "behind_s": round(snapshot.behind_s, 3),
        **_scalars(snapshot.counters),
    }
    common = {"drive": snapshot.drive, "time": _time_or_none(snapshot.time)}
    if estimate is None:
        return {
            **common,
            "samples": 0,
            "sample_rate_hz": None,
            "model": list(drive.model),
            "parameters": _parameters(drive.initial_parameters),
            "state": {"current_A": None, "velocity_rad_s": None, "position_rad": None},
            "estimators": {},
            "health": health,
        }
    equivalents = {name: _pairs(values) for name, values in estimate.equivalents.items()}
    return {
        **common,
        "samples": int(estimate.samples),
        "sample_rate_hz": scalar(estimate.sample_rate_hz),
        "model": list(estimate.model),
        "parameters": _parameters(estimate.parameters),
        "state": _scalars(estimate.state),
        "estimators": {
            name: {
                "parameters": _pairs(view.parameters),
                "detail": _scalars(view.detail),
            }
            for name, view in estimate.estimators.items()
        },
        # Totals of the line win over the pipeline's own: they also count what was lost before it.
        "health": {**_scalars(estimate.health), **health},
        **({"equivalents": equivalents} if equivalents else {}),
    }


def _pairs(values: Mapping[str, tuple[float | None, float | None]]) -> Document:
    return {p: {"value": scalar(value), "std": scalar(std)} for p, (value, std) in values.items()}


class EstimatesEncoder:
    """The estimates document of one drive as bytes, made once per published snapshot however many clients ask.

    Used by the event loop only. Holding the snapshot keeps its identity from being given to another object.
    """

    def __init__(self, drive: DriveView) -> None:
        self._drive = drive
        self._snapshot: Snapshot | None = None
        self._body = b""

    def __call__(self, snapshot: Snapshot) -> bytes:
        if snapshot is not self._snapshot:
            self._body = encode(estimates_document(self._drive, snapshot))
            self._snapshot = snapshot
        return self._body


def drive_summary(drive: DriveView) -> Document:
    """One entry of `GET /drives`."""
    snapshot = drive.snapshot()
    estimate = snapshot.estimate
    return {
        "name": drive.name,
        "driver": drive.driver,
        "connection": snapshot.connection,
        "reason": snapshot.reason,
        "time": _time_or_none(snapshot.time),
        "model": list(drive.model if estimate is None else estimate.model),
        "samples": 0 if estimate is None else int(estimate.samples),
        "sample_rate_hz": None if estimate is None else scalar(estimate.sample_rate_hz),
    }


def drive_document(drive: DriveView) -> Document:
    """`GET /drives/{d}`; with "truth" for a simulated drive only."""
    snapshot = drive.snapshot()
    parameters = drive.initial_parameters if snapshot.estimate is None else snapshot.estimate.parameters
    events = drive.events()
    document = {
        **drive_summary(drive),
        "nominal": {p.name: scalar(p.nominal) for p in parameters},
        "units": {p.name: p.unit for p in parameters},
        "signals": drive.meaning.document,
        "limits": [
            {"name": a.name, "parameter": a.parameter, "value": scalar(a.value), "is_upper": a.is_upper}
            for a in drive.limits
        ],
        "counters": _scalars(snapshot.counters),
        "history": {
            "names": list(drive.history.names()),
            "rows": len(drive.history),
            "capacity": drive.history.capacity,
            "rate_hz": drive.history.rate_hz,
        },
        "last_event": _time_or_none(events[-1].time if events else None),
    }
    if snapshot.truth is not None:
        document["truth"] = _scalars(snapshot.truth)
    return document


def event_document(event: Event) -> Document:
    """One entry of `GET /drives/{d}/events`."""
    return {
        "time": iso_utc(event.time),
        "kind": event.kind,
        "message": event.message,
        "data": _scalars(event.data),
    }


def health_document(daemon: DaemonView) -> Document:
    """`GET /health`."""
    problems = list(daemon.problems())
    return {
        "status": "failing" if problems else "ok",
        "problems": problems,
        "version": daemon.version,
        "started": iso_utc(daemon.started),
        "uptime_s": round(max(0.0, time.time() - daemon.started), 3),
        "drives": {name: drive.snapshot().connection for name, drive in daemon.drives.items()},
        "sinks": {
            sink.name: {
                "connected": sink.connected,
                "waiting": sink.waiting,
                "sent": sink.sent,
                "dropped": sink.dropped,
                "reason": sink.reason,
            }
            for sink in daemon.sinks
        },
    }


def ready_document(daemon: DaemonView) -> tuple[bool, Document]:
    """`GET /ready`: whether any drive that is not down has delivered samples to this process, and what each waits for.
    One that is switched off and whose line is open (silent) does not take the daemon out of service."""
    drives: Document = {}
    ready = False
    for name, drive in daemon.drives.items():
        snapshot = drive.snapshot()
        fresh = snapshot.time is not None and snapshot.connection != "down"
        ready = ready or fresh
        drives[name] = {
            "ready": fresh,
            "connection": snapshot.connection,
            "reason": snapshot.reason if fresh else snapshot.reason or "no samples yet",
        }
    return ready, {"ready": ready, "drives": drives}
