"""`/fleet`: all drives at a glance."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from servo_daemon.api.documents import Document, encode, event_document, scalar
from servo_daemon.parameters import KNOWN
from servo_daemon.published.snapshot import ParameterEstimate, Snapshot
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DaemonView, DriveView

#: Statuses that want an eye on them, the worst first; the others are as it should be, or will be in seconds.
_TROUBLED = ("invalid", "at_bound")
#: An answer serves all who ask within so long, s: a quarter of the time between two questions of a page.
KEPT_S: Final = 0.5


class FleetEncoder:
    """The document as bytes, made anew at most every `KEPT_S` however many ask. Used by the event loop only.

    Args:
        clock: seconds, monotonic.
    """

    def __init__(self, daemon: DaemonView, clock: Callable[[], float] = time.monotonic) -> None:
        self._daemon, self._clock = daemon, clock
        self._made_s = -math.inf
        self._body = b""

    def __call__(self) -> bytes:
        now_s = self._clock()
        if now_s - self._made_s >= KEPT_S:
            self._body = encode(fleet_document(self._daemon))
            self._made_s = now_s
        return self._body


def fleet_document(daemon: DaemonView) -> Document:
    """`GET /fleet`."""
    return {"drives": [_drive(d) for d in daemon.drives.values()], "problems": list(daemon.problems())}


def _drive(drive: DriveView) -> Document:
    snapshot = drive.snapshot()
    estimate = snapshot.estimate
    parameters = drive.initial_parameters if estimate is None else estimate.parameters
    diagnosis, events = drive.diagnosis.diagnosis, drive.events()
    return {
        "name": drive.name,
        "driver": drive.driver,
        "connection": snapshot.connection,
        "reason": snapshot.reason,
        "time": None if snapshot.time is None else iso_utc(snapshot.time),
        "model": list(drive.model if estimate is None else estimate.model),
        "simulated": snapshot.truth is not None,
        "statuses": dict(Counter(p.status for p in parameters)),
        "parameters": {
            p.name: {
                "value": scalar(p.value),
                "std": scalar(p.std),
                "unit": p.unit,
                "status": p.status,
                "change_percent": None if (change := _change(p)) is None else round(100.0 * change, 3),
            }
            for p in parameters
        },
        "worst": _worst(parameters, _alarms(snapshot)),
        "alarms": _alarms(snapshot),
        "diagnosis": {"status": diagnosis.status, "verdict": diagnosis.verdict, "effects": list(diagnosis.effects)},
        "last_event": event_document(events[-1]) if events else None,
    }


def _alarms(snapshot: Snapshot) -> list[str]:
    """Names of those that ring: keys of `[drive.limits]`, `controller_margin`."""
    told = None if snapshot.estimate is None else snapshot.estimate.health.get("alarms")
    return str(told).split(",") if told else []


def _change(p: ParameterEstimate) -> float | None:
    """How far a known value is from its nominal one, as a share of it."""
    if p.status not in KNOWN or p.value is None or p.nominal is None or not p.nominal:
        return None
    change = (p.value - p.nominal) / abs(p.nominal)
    return change if math.isfinite(change) else None


def _worst(parameters: Sequence[ParameterEstimate], alarms: list[str]) -> Document | None:
    """The parameter to look at first, and why: one whose alarm rings, else one in trouble, else the one that is
    farthest from its nominal value. None: nothing is known yet."""
    by_name = {p.name: p for p in parameters}
    for alarm in alarms:
        if (ringing := by_name.get(alarm.rpartition("_")[0])) is not None:
            return {"parameter": ringing.name, "why": f"alarm {alarm}"}
    for status in _TROUBLED:
        if (troubled := next((p for p in parameters if p.status == status), None)) is not None:
            return {"parameter": troubled.name, "why": troubled.reason or status.replace("_", " ")}
    changes = [(abs(change), p.name, change) for p in parameters if (change := _change(p)) is not None]
    if not changes:
        return None
    _, name, change = max(changes)
    return {"parameter": name, "why": f"{100.0 * change:+.1f} % from nominal"}
