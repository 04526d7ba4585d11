"""What the documents of the REST API look like: for OpenAPI, and for the test that holds `documents.py` to it.

Answers are not validated at run time (they are built from typed records); these models describe them.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from servo_daemon.parameters import Status
from servo_daemon.published.snapshot import Connection

Scalar = float | int | bool | str | None

_EXAMPLE_R = {
    "value": 0.6391,
    "std": 0.0012,
    "unit": "Ω",
    "nominal": 0.4937,
    "status": "tracking",
    "reason": None,
    "age_s": 0.0,
}
TIME_EXAMPLE = "2026-11-21T12:45:21.103Z"


class Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def example(**document: Any) -> ConfigDict:
    return ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra={"examples": [document]})


class ParameterDocument(Closed):
    """One parameter as published."""

    model_config = example(**_EXAMPLE_R)

    value: float | None = Field(description="In `unit`. While `estimating` the nominal value, or null; never NaN.")
    std: float | None = Field(description="Standard deviation, 1 σ, in `unit`; null where it is not known.")
    unit: str = Field(description="SI unit; empty for a number without a dimension.")
    nominal: float | None = Field(description="The configured (datasheet) value, in `unit`.")
    status: Status = Field(
        description="`estimating`: not yet qualified. `tracking`: follows the motor. `unexcited`: held, the motion "
        "says nothing about it now. `at_bound`: pressed against a physical bound. `fixed`: told, not estimated. "
        "`invalid`: do not use."
    )
    reason: str | None = Field(description="In words, why the status is not `tracking`.")
    age_s: float | None = Field(
        description="Device time since the motion last showed the parameter and it was known, in s; null: it never was."
    )


class EstimatorParameterDocument(Closed):
    """What one estimator says of one parameter, in the parameter's unit."""

    value: float | None
    std: float | None = Field(description="Standard deviation, 1 σ.")


class EstimatorDocument(Closed):
    """One estimator by itself, beside the published estimate; for diagnosis, not for control."""

    parameters: dict[str, EstimatorParameterDocument]
    detail: dict[str, Scalar] = Field(
        description="Numbers and texts of this estimator, units in their names; they may change between releases."
    )


class EstimatesDocument(Closed):
    """The estimates of one drive at one moment."""

    model_config = example(
        drive="axis1",
        time=TIME_EXAMPLE,
        samples=123456,
        sample_rate_hz=1000.2,
        model=["coulomb_friction"],
        parameters={"R": _EXAMPLE_R},
        state={"current_A": 1.52, "velocity_rad_s": 6.07, "position_rad": 0.873},
        estimators={"ekf": {"parameters": {"R": {"value": 0.6391, "std": 0.0012}}, "detail": {"resets": 0}}},
        health={
            "innovation_white": True,
            "samples_lost": 0,
            "connection": "connected",
            "connection_reason": None,
            "overloaded": False,
            "behind_s": 0.0,
        },
    )

    drive: str
    time: str | None = Field(
        description="Arrival of the last sample used: UTC, ISO 8601 with Z. Null before the first sample."
    )
    samples: int = Field(description="Samples used so far.")
    sample_rate_hz: float | None = Field(description="Hz, measured in the device's own time.")
    model: list[str] = Field(description="Effects on top of the linear motor.")
    parameters: dict[str, ParameterDocument]
    state: dict[str, float | None] = Field(
        description="Current (A), speed (rad/s), position (rad), and voltage (V) where it is known."
    )
    estimators: dict[str, EstimatorDocument] = Field(
        description="The estimators behind the estimate, by name: `ekf`, `rls`, with a learned model `grnn`, from a "
        "drive that estimates itself `onboard`."
    )
    health: dict[str, Scalar] = Field(
        description="How well it goes: `connection` and its reason (of a connected drive: what is wrong with what it "
        "sends), `innovation_white`, `samples_lost` and the other counters of the line; `overloaded`: samples come "
        "faster than they are worked off, and the oldest are left out (in `queue_dropped`, and so in `samples_lost`); "
        "`behind_s`: so late they are worked off because other programs have the processor or other drives start "
        "first, and none is left out; `scale_hint`: that K, J and B stand to their nominal values as an angle in "
        "another scale makes them; units in the names."
    )
    equivalents: dict[str, dict[str, EstimatorParameterDocument]] | None = Field(
        None,
        description="Of a drive of dq values only: R, L and K of the other DC motors that stand for it.",
    )


class DriveSummaryDocument(Closed):
    """One configured drive."""

    model_config = example(
        name="axis1",
        driver="simulated",
        connection="connected",
        reason=None,
        time=TIME_EXAMPLE,
        model=[],
        samples=123456,
        sample_rate_hz=1000.2,
    )

    name: str
    driver: str = Field(description="`simulated`, `serial`, `can`, `replay` or a plugin's name.")
    connection: Connection = Field(
        description="`connecting`: no samples yet. `silent`: open, but nothing arrives. `down`: the device is away and "
        "tried again. `ended`: a finite source is finished."
    )
    reason: str | None = Field(description="In words, when not `connected`.")
    time: str | None = Field(description="Arrival of the last sample, UTC.")
    model: list[str]
    samples: int
    sample_rate_hz: float | None = Field(description="Hz.")


class DrivesDocument(Closed):
    """The configured drives, in the order of the configuration."""

    drives: list[DriveSummaryDocument]


class HistoryInfoDocument(Closed):
    """What the history in memory holds."""

    names: list[str] = Field(description="Parameters and state channels that /history knows.")
    rows: int
    capacity: int
    rate_hz: float = Field(description="Rows a second at most, Hz.")


class LimitDocument(Closed):
    """A limit of `[drive.limits]` whose alarm can ring; `health.alarms` names those that do."""

    name: str = Field(examples=["R_max"])
    parameter: str
    value: float = Field(description="In the parameter's unit.")
    is_upper: bool


class SignalsDocument(Closed):
    """Which DC motor the parameters are of, and how the drive's own signals become that motor's."""

    convention: Literal["dc", "dq"]
    publish: Literal["phase", "line", "kt"] = Field(description="With `dq`: which equivalent R, L and K are in.")
    pole_pairs: int
    gear_ratio: float = Field(description="Turns of the motor for one of what the position is measured at.")


class DriveDocument(DriveSummaryDocument):
    """One drive in full."""

    nominal: dict[str, float | None] = Field(description="Configured values, in the units of `units`.")
    units: dict[str, str]
    signals: SignalsDocument
    limits: list[LimitDocument]
    counters: dict[str, int] = Field(description="Totals of driver and queue since the start.")
    history: HistoryInfoDocument
    last_event: str | None = Field(description="Time of the newest event, UTC; a reason to ask for /events.")
    truth: dict[str, float | None] | None = Field(
        default=None,
        description="Only of a simulated drive: the simulated motor's true values now. No estimator sees them.",
    )


class ResetDocument(Closed):
    """The reset has been asked for; the pipeline does it before its next samples, and an event tells."""

    model_config = example(drive="axis1", accepted=True)

    drive: str
    accepted: bool


class SinkDocument(Closed):
    """A broker or webhook that is sent to. One that is away is not the daemon's fault."""

    connected: bool | None = Field(description="Null before the first attempt.")
    waiting: int = Field(description="Events and states that are kept for it.")
    sent: int = Field(description="Messages that have arrived.")
    dropped: int = Field(description="Events and states that were given up.")
    reason: str | None = Field(description="Why it cannot be reached.")


class HealthDocument(Closed):
    """Whether the daemon itself works. A drive that is switched off is not its fault."""

    model_config = example(
        status="ok",
        problems=[],
        version="0.1.0",
        started=TIME_EXAMPLE,
        uptime_s=3600.5,
        drives={"axis1": "connected"},
        sinks={"mqtt": {"connected": True, "waiting": 0, "sent": 3600, "dropped": 0, "reason": None}},
    )

    status: Literal["ok", "failing"]
    problems: list[str]
    version: str
    started: str
    uptime_s: float = Field(description="Seconds.")
    drives: dict[str, Connection]
    sinks: dict[str, SinkDocument] = Field(description="`mqtt`, `webhook_1`, …: what is sent elsewhere.")


class ReadyDriveDocument(Closed):
    """Whether one drive has delivered samples since the daemon started."""

    ready: bool
    connection: Connection
    reason: str | None


class ReadyDocument(Closed):
    """Ready from the first samples of any drive on."""

    model_config = example(ready=True, drives={"axis1": {"ready": True, "connection": "connected", "reason": None}})

    ready: bool
    drives: dict[str, ReadyDriveDocument]


class ProblemDocument(BaseModel):
    """RFC 9457 problem details; further members depend on `code`."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra={
            "examples": [
                {
                    "type": "about:blank",
                    "title": "Not Found",
                    "status": 404,
                    "detail": "There is no drive 'axis9'; the drives are axis1, axis2.",
                    "instance": "/api/v1/drives/axis9",
                    "code": "unknown_drive",
                    "known": ["axis1", "axis2"],
                }
            ]
        },
    )

    type: str
    title: str
    status: int
    detail: str
    instance: str
    code: str = Field(description="Short machine name.")
