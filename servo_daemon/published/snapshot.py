"""What the daemon publishes: immutable records, made by the pipeline thread, read by the API without a lock.

Nothing in here is ever NaN: a value that is not known is None (JSON null, an empty CSV cell).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from servo_daemon.parameters import Status

Connection = Literal["connecting", "connected", "silent", "down", "ended"]


def finite_or_none(value: float | None) -> float | None:
    """The gate every published number passes: None for None, NaN and infinities."""
    return float(value) if value is not None and math.isfinite(value) else None


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """One parameter as published. `std` is 1 σ in `unit`; `reason` says in words why `status` is not tracking; `age_s`
    is the device time since the motion last showed it and it was known (None: never)."""

    name: str
    value: float | None
    std: float | None
    unit: str
    nominal: float | None
    status: Status
    reason: str | None = None
    age_s: float | None = None


@dataclass(frozen=True, slots=True)
class AlarmLimit:
    """A limit of `[drive.limits]` whose alarm can ring: `name` as there (R_max), `value` in the parameter's unit."""

    name: str
    parameter: str
    is_upper: bool
    value: float

    def excess(self, value: float) -> float:
        """By how much a value is beyond; negative inside."""
        return value - self.value if self.is_upper else self.value - value


@dataclass(frozen=True, slots=True)
class Covariance:
    """Joint covariance of the parameters that are known, those with a std and the status `tracking` or `unexcited`.

    Attributes:
        names: n parameters, in the order of the rows.
        values: n × n, symmetric; of the logarithms of positive parameters (relative), of signed ones themselves. Its
            diagonal is that of the published stds.
    """

    names: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class EstimatorView:
    """What one estimator says by itself, beside the fused estimate: parameter -> (value, std), and its own status of
    each where it has one."""

    parameters: Mapping[str, tuple[float | None, float | None]]
    detail: Mapping[str, float | int | bool | str | None] = field(default_factory=dict)
    status: Mapping[str, Status] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Estimate:
    """The pipeline's output at one moment of device time. Free of wall-clock time.

    `equivalents`: R, L and K (value, std) of the other DC motors that stand for a drive of dq values, by name.
    """

    time_s: float
    samples: int
    sample_rate_hz: float | None
    model: tuple[str, ...]
    parameters: tuple[ParameterEstimate, ...]
    state: Mapping[str, float | None]
    estimators: Mapping[str, EstimatorView]
    health: Mapping[str, float | int | bool | str | None]
    covariance: Covariance | None = None
    equivalents: Mapping[str, Mapping[str, tuple[float | None, float | None]]] = field(default_factory=dict)

    @property
    def is_finite(self) -> bool:
        """Whether every number is one: the daemon's last line of defence, and the tests'."""
        numbers = [v for p in self.parameters for v in (p.value, p.std)] + [*self.state.values()]
        return all(math.isfinite(v) for v in numbers if v is not None)


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth telling: reconnects, device restarts, jumps of a parameter, resets.

    `time` is UTC, seconds since the epoch. `kind` is a short machine name ("disconnected", "connected",
    "device_restarted", "silent", "reset", "state_restored", ...); `data` has numbers with units in their names.
    """

    time: float
    kind: str
    message: str
    data: Mapping[str, float | int | str | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One drive at one moment: the estimate and what the daemon knows around it.

    Attributes:
        drive, driver: name and kind of the drive.
        time: UTC seconds since the epoch at which the last sample arrived (host clock); None before the first.
        connection: "connecting" (never opened yet, or just opened and no samples yet), "connected", "silent" (open, but
            no samples), "down" (device away, being retried), "ended" (a finite source is finished).
        reason: in words, when not connected.
        estimate: None until the first samples.
        counters: totals of driver and queue: samples, samples_lost, queue_dropped, crc_errors, reconnects, ...
        overloaded: its samples come faster than they are worked off; the oldest are left out, and counted.
        behind_s: how late its samples are worked off because other programs have the processor, or other drives start
            first; none is left out.
        truth: a simulated drive's true values at this moment; for display only.
    """

    drive: str
    driver: str
    time: float | None
    connection: Connection
    reason: str | None
    estimate: Estimate | None
    counters: Mapping[str, int]
    truth: Mapping[str, float] | None = None
    overloaded: bool = False
    behind_s: float = 0.0
