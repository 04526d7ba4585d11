"""What a daemon answers, as typed records. A number that is not known is None, or NaN in an array."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def moment(text: str | None) -> datetime | None:
    """A time of the API, with its zone (UTC)."""
    return None if text is None else datetime.fromisoformat(text)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as published; `std` is 1 σ in `unit`, `reason` says why `status` is not "tracking"."""

    name: str
    value: float | None
    std: float | None
    unit: str
    nominal: float | None
    status: str
    reason: str | None
    age_s: float | None


@dataclass(frozen=True, slots=True)
class Estimates:
    """The estimates of one drive at one moment: `estimates["R"].value`.

    Attributes:
        time: arrival of the last sample; None: there was none yet.
        state: current, speed and position by their names with units.
        estimators: what each estimator says by itself, as in the document.
    """

    drive: str
    time: datetime | None
    samples: int
    sample_rate_hz: float | None
    model: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    state: Mapping[str, float | None]
    estimators: Mapping[str, Any]
    health: Mapping[str, Any]

    def __getitem__(self, name: str) -> Parameter:
        return self.parameters[name]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Estimates:
        """From `GET /drives/{d}/estimates`."""
        parameters = {
            n: Parameter(n, p["value"], p["std"], p["unit"], p["nominal"], p["status"], p["reason"], p.get("age_s"))
            for n, p in document["parameters"].items()
        }
        return cls(
            document["drive"], moment(document["time"]), document["samples"], document["sample_rate_hz"],
            tuple(document["model"]), parameters, document["state"], document["estimators"], document["health"],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Series:
    """One parameter or state channel; arrays of the length of the times.

    Attributes:
        value: as recorded, or the means of buckets; std: published 1 σ.
        min, max, spread, count: of the values in each bucket; None for single rows.
        status: None for a state channel; its elements None where the parameter did not exist.
    """

    unit: str | None
    value: F64
    std: F64
    min: F64 | None
    max: F64 | None
    spread: F64 | None
    count: NDArray[np.int64] | None
    status: NDArray[np.object_] | None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Series:
        """From a series of `GET /drives/{d}/history`."""

        def floats(key: str) -> F64 | None:
            return None if document[key] is None else np.array(document[key], dtype=np.float64)

        nothing = np.empty(0)
        count, status = document["count"], document["status"]
        return cls(
            document["unit"],
            nothing if (value := floats("value")) is None else value,
            nothing if (std := floats("std")) is None else std,
            floats("min"), floats("max"), floats("spread"),
            None if count is None else np.array(count, dtype=np.int64),
            None if status is None else np.array(status, dtype=object),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class History:
    """Series over time: `history["R"].value` over `history.time`.

    Attributes:
        level: "rows", "1 s", "1 min" or "1 h"; `period_s` the length of a bucket, 0 for single rows.
        time: (n,) UTC, begin of each bucket.
        note: why these are only the last minutes from memory; None: they are not.
    """

    drive: str
    level: str
    period_s: float
    time: NDArray[np.datetime64]
    series: Mapping[str, Series]
    note: str | None

    def __getitem__(self, name: str) -> Series:
        return self.series[name]

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> History:
        """From `GET /drives/{d}/history`, of one series or several."""
        one = document.get("parameter")
        found = {one: document} if one is not None else document["series"]
        time = np.array([text.removesuffix("Z") for text in document["time"]], dtype="datetime64[ms]")
        series = {name: Series.of(d) for name, d in found.items()}
        return cls(document["drive"], document["level"], document["period_s"], time, series, document["note"])

    def to_pandas(self) -> Any:
        """A DataFrame over UTC times: for each series P the columns `P`, `P_std`, `P_min`, … that it has.

        Raises:
            ImportError: pandas is not installed.
        """
        pandas = importlib.import_module("pandas")
        columns: dict[str, Any] = {}
        for name, s in self.series.items():
            columns[name] = s.value
            extra = {"std": s.std if s.status is not None else None, "min": s.min, "max": s.max, "spread": s.spread,
                     "count": s.count, "status": s.status}  # fmt: skip
            columns |= {f"{name}_{key}": values for key, values in extra.items() if values is not None}
        return pandas.DataFrame(columns, index=pandas.DatetimeIndex(self.time, tz="UTC", name="time"))


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to a drive; the kinds are in docs/operations.md."""

    time: datetime
    kind: str
    message: str
    data: Mapping[str, Any]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Event:
        """From an entry of `GET /drives/{d}/events`."""
        when = datetime.fromisoformat(document["time"])
        return cls(when, document["kind"], document["message"], document["data"])


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What a drive's model lacks, or how far the search is.

    Attributes:
        status: "idle", "running", "done", "failed".
        verdict: "none", "found", "unexplained"; None: there is no result.
        effects: names of what was found.
        progress: 0 … 1; step: what it does.
        reason: why it failed, or why one cannot be begun.
        result: the document of `servo-daemon diagnose`.
        adoptable: whether what was found can become the model now.
    """

    status: str
    verdict: str | None
    effects: tuple[str, ...]
    progress: float | None
    step: str | None
    reason: str | None
    result: Mapping[str, Any] | None
    adoptable: bool

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Diagnosis:
        """From `GET /drives/{d}/diagnosis`."""
        result = document["result"]
        effects: Sequence[Mapping[str, Any]] = () if result is None else result["effects"]
        return cls(
            document["status"], None if result is None else result["verdict"], tuple(e["name"] for e in effects),
            document["progress"], document["step"], document["reason"], result, document["adoption"]["allowed"],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Model:
    """The model that a drive has now: effects on top of the linear motor.

    Attributes:
        time: of the first estimate with it; None: there is none yet.
        done: False: it waits for samples.
    """

    effects: tuple[str, ...]
    time: datetime | None
    done: bool


@dataclass(frozen=True, slots=True)
class Capture:
    """A recording that the daemon keeps.

    Attributes:
        kind: of the event that it was kept for; "request": somebody has asked for it.
        start, end: arrival of its first and last sample.
        size: bytes.
        file: its name when it is saved: Parquet, or CSV in gzip.
    """

    id: str
    kind: str
    start: datetime
    end: datetime
    size: int
    file: str

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Capture:
        """From an entry of `GET /drives/{d}/captures`."""
        start, end = (datetime.fromisoformat(document[key]) for key in ("start", "end"))
        return cls(document["id"], document["kind"], start, end, document["bytes"], document["file"])


@dataclass(frozen=True, slots=True)
class Samples:
    """A snapshot of the signals at sample rate: `samples["current_A"]` over `samples.time_s`.

    Attributes:
        time: arrival of the last sample there is; None: there was none yet.
        time_s: (n,) device time, s.
        signals: (n,) each, units in their names.
        trigger_s: device time of the first sample beyond the level; None: none was asked for or found.
        shortened: less time than was asked for, as so many samples are too many.
    """

    time: datetime | None
    time_s: F64
    signals: Mapping[str, F64]
    trigger_s: float | None
    shortened: bool

    def __getitem__(self, name: str) -> F64:
        return self.signals[name]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Samples:
        """From `GET /drives/{d}/samples`."""
        trigger = document["trigger"]
        signals = {name: np.array(values, dtype=np.float64) for name, values in document["signals"].items()}
        return cls(
            moment(document["time"]), np.array(document["time_s"], dtype=np.float64), signals,
            None if trigger is None else trigger["time_s"], document["shortened"],
        )  # fmt: skip
