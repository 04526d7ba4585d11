"""What the documents about the past look like; see `estimates.py`."""

from __future__ import annotations

from pydantic import Field

from servo_daemon.api.schemas.estimates import TIME_EXAMPLE, Closed, Scalar, example
from servo_daemon.parameters import Status
from servo_daemon.published.diagnosis_state import DiagnosisStatus
from servo_daemon.published.snapshot import Connection

_LEVEL = "Which of the kept resolutions this is from: `rows` (ten a second), `1 s`, `1 min`, `1 h`."
_PERIOD = "Length of a bucket, s; 0: single rows. A time is the begin of its bucket."
_NOTE = "In words, why the store could not be asked; then these are the last minutes from memory. Else null."
_STATUS = "The one that most rows of the bucket had. Null for a state channel."


class SeriesDocument(Closed):
    """One series; all columns have the length of `time`."""

    unit: str | None
    value: list[float | None] = Field(description="In `unit`; of a bucket the mean of the known values.")
    std: list[float | None] = Field(
        description="1 σ as published, in `unit`; of a bucket the root mean square. Null throughout for a channel."
    )
    status: list[Status | None] | None = Field(description=_STATUS)
    min: list[float | None] | None = Field(description="Lowest known value of each bucket; null for single rows.")
    max: list[float | None] | None = Field(description="Highest known value of each bucket; null for single rows.")
    spread: list[float | None] | None = Field(
        description="Standard deviation of the values within each bucket; null for single rows."
    )
    count: list[int] | None = Field(description="Known values in each bucket; null for single rows.")
    share: dict[str, list[float | None]] | None = Field(
        description="By status, which share of the rows had it; null for single rows and channels."
    )


class HistoryDocument(SeriesDocument):
    """One parameter or state channel over time: columns of equal length, oldest first."""

    model_config = example(
        drive="axis1",
        parameter="R",
        unit="Ω",
        points=2,
        level="rows",
        period_s=0,
        time=[TIME_EXAMPLE, "2026-11-21T12:45:21.203Z"],
        value=[0.6391, 0.6392],
        std=[0.0012, 0.0012],
        status=["tracking", "tracking"],
        truth=[0.6394, 0.6394],
        min=None,
        max=None,
        spread=None,
        count=None,
        share=None,
        note=None,
    )

    drive: str
    parameter: str
    points: int = Field(description="Length of the columns.")
    level: str = Field(description=_LEVEL)
    period_s: float = Field(description=_PERIOD)
    time: list[str] = Field(description="UTC, ISO 8601 with Z.")
    truth: list[float | None] | None = Field(description="A simulated drive's true value; else null.")
    note: str | None = Field(description=_NOTE)


class HistoriesDocument(Closed):
    """Several parameters or state channels over time."""

    model_config = example(
        drive="axis1",
        level="1 h",
        period_s=3600,
        points=1,
        time=[TIME_EXAMPLE],
        series={
            "R": {
                "unit": "Ω",
                "value": [0.6391],
                "std": [0.0012],
                "status": ["tracking"],
                "min": [0.63],
                "max": [0.65],
                "spread": [0.004],
                "count": [36000],
                "share": {"tracking": [1.0]},
            }
        },
        note=None,
    )

    drive: str
    level: str = Field(description=_LEVEL)
    period_s: float = Field(description=_PERIOD)
    points: int = Field(description="Length of the columns.")
    time: list[str] = Field(description="UTC, ISO 8601 with Z.")
    series: dict[str, SeriesDocument] = Field(description="Those of which anything is kept in that span.")
    note: str | None = Field(description=_NOTE)


class EventDocument(Closed):
    """Something worth telling: a reconnect, a restart of the device, a reset, a jump of a parameter."""

    model_config = example(
        time=TIME_EXAMPLE, kind="disconnected", message="/dev/ttyUSB0 went away", data={"attempts": 1}
    )

    time: str
    kind: str = Field(description="Short machine name.")
    message: str
    data: dict[str, Scalar] = Field(description="Numbers with units in their names.")


class EventsDocument(Closed):
    """The newest events that match, oldest first."""

    events: list[EventDocument]
    next: str | None = Field(description="`before` of the page with the events before these; null: there are none.")


class FleetParameterDocument(Closed):
    """One parameter at a glance."""

    value: float | None = Field(description="In `unit`.")
    std: float | None = Field(description="1 σ, in `unit`.")
    unit: str
    status: Status
    change_percent: float | None = Field(description="From the nominal value; null where one of them is not known.")


class WorstDocument(Closed):
    """The parameter to look at first."""

    parameter: str
    why: str = Field(description="In words: an alarm, a reason, or how far it is from nominal.")


class FleetDiagnosisDocument(Closed):
    """The last diagnosis in short."""

    status: DiagnosisStatus
    verdict: str | None
    effects: list[str]


class FleetDriveDocument(Closed):
    """One drive at a glance."""

    name: str
    driver: str
    connection: Connection
    reason: str | None = Field(description="In words, when not `connected`.")
    time: str | None = Field(description="Arrival of the last sample, UTC.")
    model: list[str]
    simulated: bool
    statuses: dict[str, int] = Field(description="How many parameters have which status.")
    parameters: dict[str, FleetParameterDocument]
    worst: WorstDocument | None = Field(description="Null: nothing is known yet.")
    alarms: list[str] = Field(description="Those that ring: keys of `[drive.limits]`, `controller_margin`.")
    diagnosis: FleetDiagnosisDocument
    last_event: EventDocument | None


class FleetDocument(Closed):
    """All drives at a glance, in the order of the configuration."""

    model_config = example(
        drives=[
            {
                "name": "axis1",
                "driver": "serial",
                "connection": "connected",
                "reason": None,
                "time": TIME_EXAMPLE,
                "model": [],
                "simulated": False,
                "statuses": {"tracking": 5},
                "parameters": {
                    "R": {"value": 0.6391, "std": 0.0012, "unit": "Ω", "status": "tracking", "change_percent": 29.4}
                },
                "worst": {"parameter": "R", "why": "alarm R_max"},
                "alarms": ["R_max"],
                "diagnosis": {"status": "idle", "verdict": None, "effects": []},
                "last_event": None,
            }
        ],
        problems=[],
    )

    drives: list[FleetDriveDocument]
    problems: list[str] = Field(description="What is wrong with the daemon itself, in words.")
