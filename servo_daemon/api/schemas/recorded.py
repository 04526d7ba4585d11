"""What the documents about samples look like; see `estimates.py`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from servo_daemon.api.schemas.estimates import TIME_EXAMPLE, Closed, example


class CaptureDocument(Closed):
    """One kept recording."""

    model_config = example(
        id="20261121T124451103Z-60000ms-alarm",
        kind="alarm",
        start="2026-11-21T12:44:51.103Z",
        end="2026-11-21T12:45:51.103Z",
        bytes=1_210_400,
        file="axis1-20261121T124451103Z-60000ms-alarm.parquet",
        url="/api/v1/drives/axis1/captures/20261121T124451103Z-60000ms-alarm",
    )

    id: str
    kind: str = Field(description="Of the event that it was kept for; `request`: somebody has asked for it.")
    start: str = Field(description="Arrival of its first sample, UTC.")
    end: str = Field(description="Arrival of its last sample, or the event, if that was noticed later.")
    bytes: int
    file: str = Field(description="Its name when downloaded; `fit`, `diagnose` and `replay` open it.")
    url: str


class CapturesDocument(Closed):
    """The kept recordings of a drive, oldest first."""

    drive: str
    captures: list[CaptureDocument]
    reason: str | None = Field(description="In words, why none are kept; null: they are.")


class CaptureRequestDocument(Closed):
    """What is to be kept."""

    model_config = example(seconds=30)

    seconds: float = Field(60.0, gt=0, le=600, description="At most so much of device time, up to now.")


class ScopeTriggerDocument(Closed):
    """What was triggered on."""

    channel: str
    level: float
    edge: Literal["rising", "falling"]
    time_s: float | None = Field(description="Device time of the first sample beyond the level; null: none was found.")


class SamplesDocument(Closed):
    """Samples at the rate at which they came; all columns have the length of `time_s`."""

    model_config = example(
        drive="axis1",
        time=TIME_EXAMPLE,
        last_s=17.204,
        trigger={"channel": "current_A", "level": 1.0, "edge": "rising", "time_s": 17.002},
        shortened=False,
        time_s=[17.001, 17.002],
        signals={"voltage_V": [4.1, 4.2], "current_A": [0.98, 1.02]},
    )

    drive: str
    time: str | None = Field(description="Arrival of the last sample there is, UTC.")
    last_s: float | None = Field(description="Its device time: `since` of the next question.")
    trigger: ScopeTriggerDocument | None = Field(description="Null: none was asked for.")
    shortened: bool = Field(description="It holds less time than was asked for, as so many samples are too many.")
    time_s: list[float | None] = Field(description="Device time, s.")
    signals: dict[str, list[float | None]] = Field(description="Units are in the names. Null: no measurement.")
