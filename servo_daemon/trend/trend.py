"""The trend of one parameter and the time until its limit, or that there is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.trend.evidence import Fit, fits
from servo_daemon.trend.prognosis import Futures, futures, has_habit
from servo_daemon.trend.records import HORIZON_Y, Change, Limit, Range, Trend
from servo_daemon.trend.series import YEAR_D, Series, daily, stretched
from servo_daemon.trend.shapes import Columns, Priors, columns
from servo_daemon.trend.temperature import TemperatureEffect, at_reference, effect_on

#: Days with data, from first to last, and stretches, below which nothing is said: twice the unknowns of a wandering
#: trend.
FEWEST_DAYS: Final = 30
SHORTEST_D: Final = 60.0
FEWEST_VALUES: Final = 24
#: A trend is told where its probability is at least this. Measured: benchmarks/life_trend.py.
SURE: Final = 0.98
#: Ends of the 80 % interval.
_ENDS: Final = (0.1, 0.5, 0.9)
#: Where no limit is given the scale of what matters is that of the usual one, "+30 %".
_USUAL_MARGIN: Final = 0.3
#: A step back by this share of the way to the limit at least is an exchange or a repair, not wear.
_BACK: Final = 0.1


def assess(
    parameter: str,
    time_d: F64,
    value: F64,
    temperature_C: F64 | None = None,
    limits: tuple[Limit, ...] = (),
    nominal: float | None = None,
    *,
    of_winding: bool = True,
) -> Trend:
    """The trend of a parameter from means of hours or days.

    Args:
        parameter: its name, by which the temperature's effect is known.
        time_d: days, oldest first, shape (n,).
        value: in the parameter's unit; NaN where it was not known. Shape (n,).
        temperature_C: NaN where not known, shape (n,). None: never.
        limits: of `[drive.limits]`.
        nominal: None: the value at the beginning stands for it.
        of_winding: whether the temperature is the winding's.

    Raises:
        ValueError: arrays whose shapes differ, or times that decrease.
    """
    effect = effect_on(parameter, of_winding=of_winding)
    days = daily(time_d, value, temperature_C)
    if days.temperature_C is not None:
        days = replace(days, value=at_reference(effect, days.value, days.temperature_C))
    changes: tuple[Change, ...] = ()
    while True:
        series = stretched(days)
        short = _too_short(series, bool(changes))
        if short is not None:
            return Trend("too_short", short, since_d=_first(series), changes=changes)
        study = _Study(series, effect, limits, nominal)
        exchange = study.exchange()
        changes = (*changes, *study.changes(exchange))
        if exchange is None:
            return study.trend(changes)
        days = days.since(series.time_d[exchange])


def _first(series: Series) -> float | None:
    return float(series.time_d[0]) if len(series) else None


def _too_short(series: Series, anew: bool) -> str | None:
    days = float(series.days.sum())
    span = float(series.time_d[-1] - series.time_d[0]) if len(series) else 0.0
    if days >= FEWEST_DAYS and span >= SHORTEST_D and len(series) >= FEWEST_VALUES:
        return None
    since = " since the last exchange" if anew else ""
    had = f"{days:.0f} {'day' if days == 1.0 else 'days'} with data{since}"
    return f"{had}; needed are {FEWEST_DAYS}, over {SHORTEST_D:.0f} days"


class _Study:
    """A series since its last exchange, as far as that is known."""

    def __init__(
        self, series: Series, effect: TemperatureEffect, limits: tuple[Limit, ...], nominal: float | None
    ) -> None:
        self._series, self._effect, self._limits = series, effect, limits
        began = float(np.median(series.value[: max(3, len(series) // 20)]))
        self._new = began if nominal is None else nominal
        self._scale = abs(began) or abs(self._new) or 1.0
        self._offset = began
        margins = [abs(limit.value - self._new) / self._scale for limit in limits]
        margin = max(min(margins, default=_USUAL_MARGIN), 0.02)
        known = series.temperature_C is not None
        self._priors = Priors(margin, effect.further_1_K, effect.season[0 if known else 1])
        warm = None if series.temperature_C is None else series.temperature_C - np.mean(series.temperature_C)
        self._columns: Columns = columns(series.time_d, float(series.time_d[0]), warm, self._priors)
        self._fits = fits(series, (series.value - began) / self._scale, self._columns, self._priors)
        weights = np.exp([f.log_evidence - self._fits[0].log_evidence for f in self._fits])
        self._weights: F64 = weights / weights.sum()

    @property
    def _best(self) -> Fit:
        return self._fits[0]

    def exchange(self) -> int | None:
        """The last step of the most likely fit that goes back to where the value began, the number of the first value
        after it; None: there is none."""
        best = self._best
        found = None
        level = 0.0
        first, last = len(self._columns.common), len(best.mean) - len(best.steps)
        worn = self._columns.values[:, list(self._columns.by_shape[best.shape_number])] @ best.mean[first:last]
        for at, size in best.events:
            before = level + float(worn[at])
            if abs(before + size) < abs(before) and abs(size) > _BACK * self._priors.margin:
                found = at
            level += size
        return found

    def changes(self, exchange: int | None) -> tuple[Change, ...]:
        """Steps of the most likely fit, up to the exchange if there is one."""
        last = len(self._series) if exchange is None else exchange
        return tuple(
            Change(float(self._series.time_d[at]), size * self._scale, at == exchange)
            for at, size in self._best.events
            if at <= last
        )

    def trend(self, changes: tuple[Change, ...]) -> Trend:
        """The trend that is told, with these changes."""
        has = np.array([_is_trend(f) for f in self._fits])
        probability = float(self._weights[has].sum())
        series, start = self._series, float(self._series.time_d[0])
        now_y = (float(series.time_d[-1]) - start) / YEAR_D
        sure = probability >= SURE
        weights = np.where(has, self._weights, 0.0) if sure else self._weights
        drawn = futures(self._fits, weights, self._columns, self._priors, now_y)
        copper = self._effect.known_1_K > 0 and series.temperature_C is not None
        told = Trend(
            "no_trend",
            "no change that noise and season do not explain",
            probability=probability,
            since_d=start,
            level=_range(drawn.now, self._scale, self._offset),
            used=self._used(drawn),
            changes=changes,
            at_25_C=float(series.value[-1]) if copper else None,
            remark=None if series.temperature_C is None else self._effect.remark,
        )
        if not sure:
            return told
        years, limit = self._nearest(drawn)
        return replace(
            told,
            status="trend",
            reason=None,
            rate_1_y=_range(drawn.rate_1_y, self._scale),
            rate_percent=_range(drawn.rate_1_y, 100.0 * self._scale / (abs(self._new) or self._scale)),
            years=years,
            limit=limit,
        )

    def _relative(self, limit: Limit) -> float:
        return (limit.value - self._offset) / self._scale

    def _nearest(self, drawn: Futures) -> tuple[Range | None, Limit | None]:
        """The limit that most futures reach, and when; None: fewer than half reach one."""
        found: tuple[Range | None, Limit | None] = (None, None)
        most = 0.5
        for limit in self._limits:
            years = drawn.years_until(self._relative(limit), is_upper=limit.is_upper)
            share = float(np.mean(years < HORIZON_Y))
            if share >= most:
                most, found = share, (_range(years), limit)
        return found

    def _used(self, drawn: Futures) -> Range | None:
        if not self._limits:
            return None
        now = drawn.now * self._scale + self._offset
        shares = [(now - self._new) / (limit.value - self._new) for limit in self._limits if limit.value != self._new]
        if not shares:
            return None
        nearest = max(shares, key=lambda s: float(np.median(s)))
        return _range(np.maximum(nearest, 0.0))


def _is_trend(fit: Fit) -> bool:
    """Not single events, nor wandering without a direction."""
    return fit.shape.kind != "none" and (fit.shape.kind != "stepwise" or has_habit(fit))


def _range(values: F64, scale: float = 1.0, offset: float = 0.0) -> Range:
    low, mid, high = np.quantile(values, _ENDS, method="nearest") * scale + offset
    return Range(*(float(v) if np.isfinite(v) else None for v in (low, mid, high)))
