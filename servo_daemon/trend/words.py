"""A trend in a sentence: "R +1.8 %/year (1.2–2.5); R_max in 6–11 years"."""

from __future__ import annotations

import math

from servo_daemon.trend.records import HORIZON_Y, Range, Trend
from servo_daemon.trend.series import YEAR_D


def sentence(parameter: str, trend: Trend) -> str:
    """For the page and the log."""
    if trend.status == "too_short":
        return f"{parameter}: too little data for a trend yet ({trend.reason})"
    if trend.status == "no_trend" or trend.rate_percent is None:
        return f"{parameter}: no trend"
    return f"{parameter} {_rate(trend.rate_percent)}; {_until(trend)}"


def _rate(percent: Range) -> str:
    ends = sorted((percent.low or 0.0, percent.high or 0.0), key=abs)
    mid = percent.mid or 0.0
    digits = _digits(ends[1] - ends[0])
    if ends[0] * ends[1] < 0:  # the sign is open: it belongs to each end
        return f"{mid:+.{digits}f} %/year ({ends[0]:+.{digits}f} to {ends[1]:+.{digits}f})"
    return f"{mid:+.{digits}f} %/year ({abs(ends[0]):.{digits}f}–{abs(ends[1]):.{digits}f})"


def _digits(width: float) -> int:
    """Decimals that show an interval with two figures of its width at least; at most 4."""
    return 1 if width == 0.0 else min(4, max(0, 1 - math.floor(math.log10(abs(width)))))


def _until(trend: Trend) -> str:
    years, limit = trend.years, trend.limit
    if limit is None or years is None or years.low is None:
        return "no limit is set" if trend.used is None else f"no limit within {HORIZON_Y:.0f} years"
    if years.high == 0.0:
        return f"{limit.name} is reached"
    return f"{limit.name} in {span_of(years)}"


def span_of(years: Range) -> str:
    """An interval of times in the unit that suits it: days, months or years."""
    low, high = years.low or 0.0, years.high
    far = low if high is None else high
    units = (("days", YEAR_D, 90.0), ("months", 12.0, 24.0), ("years", 1.0, math.inf))
    unit, per_year = next((u, per) for u, per, most in units if far * per <= most)
    if high is None:
        return f"{low * per_year:.3g} {unit} or more"
    ends = (low * per_year, high * per_year)
    digits = 0 if round(ends[0]) != round(ends[1]) else 1
    return f"{ends[0]:.{digits}f}–{ends[1]:.{digits}f} {unit}"
