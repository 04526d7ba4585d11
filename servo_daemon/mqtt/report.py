"""What is told of a drive at one moment: only what is known now has a value."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final, Protocol

from servo_daemon.published.sinks import EventSource, encode
from servo_daemon.published.snapshot import AlarmLimit, ParameterEstimate, Snapshot
from servo_daemon.published.units import iso_utc

#: The state channels that change slowly enough for one value a second.
_SLOW: Final = ("temperature_C",)
#: What `health.alarms` calls gains that no longer suit the motor.
MARGIN_ALARM: Final = "controller_margin"


class Source(Protocol):
    """A drive, as far as it is told of."""

    @property
    def name(self) -> str: ...
    @property
    def driver(self) -> str: ...
    @property
    def initial_parameters(self) -> Sequence[ParameterEstimate]: ...
    @property
    def limits(self) -> Sequence[AlarmLimit]: ...
    @property
    def log(self) -> EventSource: ...
    def snapshot(self) -> Snapshot: ...


@dataclass(frozen=True, slots=True)
class Reading:
    """A parameter. `value` and `std` (1 σ) are None unless its status is tracking and the drive connected."""

    name: str
    unit: str
    status: str
    value: float | None
    std: float | None


@dataclass(frozen=True, slots=True)
class Report:
    """One drive at one moment.

    Attributes:
        time: of its last sample, of a drive without samples of the report; UTC seconds since the epoch.
        alarms: whether each alarm that can ring does; None: not known, there have been no samples.
        state: slow states such as `temperature_C`.
    """

    drive: str
    driver: str
    time: float
    connection: str
    reason: str | None
    parameters: tuple[Reading, ...]
    alarms: Mapping[str, bool | None]
    state: Mapping[str, float | None]

    def document(self) -> dict[str, Any]:
        """As JSON has it; `alarm` is whether any rings."""
        known = [rings for rings in self.alarms.values() if rings is not None]
        return {
            "drive": self.drive,
            "time": iso_utc(self.time),
            "connection": self.connection,
            "reason": self.reason,
            "parameters": {
                p.name: {"value": p.value, "std": p.std, "unit": p.unit, "status": p.status} for p in self.parameters
            },
            "alarm": any(known) if known or not self.alarms else None,
            "alarms": dict(self.alarms),
            "state": dict(self.state),
        }

    def unknown(self) -> Report:
        """The same drive without a value."""
        return replace(
            self,
            parameters=tuple(replace(p, value=None, std=None) for p in self.parameters),
            alarms=dict.fromkeys(self.alarms),
            state=dict.fromkeys(self.state),
        )

    def body(self) -> bytes:
        """The document as compact UTF-8."""
        return encode(self.document())


def report_of(source: Source, snapshot: Snapshot, now: float) -> Report:
    """What is told of a snapshot.

    Args:
        now: UTC seconds since the epoch.
    """
    estimate, live = snapshot.estimate, snapshot.connection == "connected"
    parameters = source.initial_parameters if estimate is None else estimate.parameters
    state = {} if estimate is None else {k: v if live else None for k, v in estimate.state.items() if k in _SLOW}
    return Report(
        drive=snapshot.drive,
        driver=snapshot.driver,
        time=snapshot.time if live and snapshot.time is not None else now,
        connection=snapshot.connection,
        reason=snapshot.reason,
        parameters=tuple(_reading(p, live) for p in parameters),
        alarms=_alarms(source, snapshot),
        state=state,
    )


def _reading(p: ParameterEstimate, live: bool) -> Reading:
    known = live and p.status == "tracking"
    return Reading(p.name, p.unit, p.status, p.value if known else None, p.std if known else None)


def _alarms(source: Source, snapshot: Snapshot) -> dict[str, bool | None]:
    names = [limit.name for limit in source.limits]
    if snapshot.estimate is None:
        return dict.fromkeys(names)
    health = snapshot.estimate.health
    if "controller_margin_low" in health:  # it is watched
        names.append(MARGIN_ALARM)
    ringing = str(health.get("alarms") or "").split(",")
    return {name: name in ringing for name in names}


def report_from(body: bytes) -> Report:
    """The report of which this is the body. (Its driver is not in there.)"""
    d = json.loads(body)
    parameters = (Reading(n, p["unit"], p["status"], p["value"], p["std"]) for n, p in d["parameters"].items())
    time_s = _epoch_s(d["time"])
    return Report(d["drive"], "", time_s, d["connection"], d["reason"], tuple(parameters), d["alarms"], d["state"])


def event_time(body: bytes) -> float:
    """When an event happened of which this is the body: UTC, seconds since the epoch."""
    return _epoch_s(json.loads(body)["time"])


def _epoch_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()
