"""`/trend`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from servo_daemon.api.schemas.estimates import Closed, example


class RangeDocument(Closed):
    """Median and 80 % interval. An end that is null is beyond the horizon."""

    low: float | None
    mid: float | None
    high: float | None


class TrendLimitDocument(Closed):
    """A limit of `[drive.limits]`."""

    name: str
    value: float


class TrendChangeDocument(Closed):
    """A step. `exchange`: back towards where the value began; the trend starts anew here."""

    time: str = Field(description="UTC, ISO 8601 with Z; to within 1/160 of the series' length.")
    size: float | None = Field(description="In the parameter's unit.")
    kind: Literal["step", "exchange"]


class ParameterTrendDocument(Closed):
    """The ageing of one parameter."""

    status: Literal["trend", "no_trend", "too_short"] = Field(
        description="`no_trend`: nothing that noise and season do not explain, so no time until a limit. `too_short`: "
        "nothing is said yet."
    )
    text: str = Field(description="In a sentence.")
    reason: str | None = Field(description="In words, why there is no trend.")
    unit: str
    probability: float | None = Field(description="That there is a trend; it is told from 0.98 on.")
    since: str | None = Field(description="Where the trend begins: first data, or the last exchange. UTC.")
    value: RangeDocument | None = Field(description="Now, season and temperature's effect taken out, in `unit`.")
    rate_per_year: RangeDocument | None = Field(description="In `unit` a year.")
    rate_percent_per_year: RangeDocument | None = Field(description="In % of the nominal (else first) value a year.")
    limit: TrendLimitDocument | None = Field(description="The limit it moves to.")
    years_until_limit: RangeDocument | None
    life_used: RangeDocument | None = Field(
        description="Share of the way from the nominal (else the first) value to the nearest limit; 1: reached."
    )
    changes: list[TrendChangeDocument]
    value_at_25_C: float | None = Field(
        description="R at 25 °C, where the winding's temperature is measured; the mean of the last stretch."
    )
    remark: str | None = Field(description="What should be known of the temperature's effect.")


class TrendDocument(Closed):
    """How the parameters of one drive age."""

    model_config = example(
        drive="axis1",
        time="2026-11-21T12:45:21.103Z",
        reason=None,
        warn_before_days=180.0,
        horizon_years=30.0,
        near=[],
        parameters={
            "R": {
                "status": "trend",
                "text": "R +1.8 %/year (1.2–2.5); R_max in 6–11 years",
                "reason": None,
                "unit": "Ω",
                "probability": 0.9994,
                "since": "2024-02-03T12:00:00.000Z",
                "value": {"low": 0.5312, "mid": 0.5331, "high": 0.5350},
                "rate_per_year": {"low": 0.0059, "mid": 0.0089, "high": 0.0123},
                "rate_percent_per_year": {"low": 1.2, "mid": 1.8, "high": 2.5},
                "limit": {"name": "R_max", "value": 0.6418},
                "years_until_limit": {"low": 6.1, "mid": 8.0, "high": 10.9},
                "life_used": {"low": 0.25, "mid": 0.27, "high": 0.28},
                "changes": [{"time": "2024-02-03T12:00:00.000Z", "size": -0.052, "kind": "exchange"}],
                "value_at_25_C": 0.5329,
                "remark": None,
            }
        },
    )

    drive: str
    time: str | None = Field(description="When it was found, UTC; null: not yet.")
    reason: str | None = Field(description="In words, why there is none.")
    warn_before_days: float
    horizon_years: float = Field(description="How far is looked ahead.")
    near: list[str] = Field(description="Parameters whose limit may be reached within `warn_before_days`.")
    parameters: dict[str, ParameterTrendDocument]
