"""Ageing of one parameter: what is told of series whose truth is known, and of series that tell nothing."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.samples import F64
from servo_daemon.trend.records import Limit, Range, Trend
from servo_daemon.trend.trend import assess
from servo_daemon.trend.warning import is_near
from servo_daemon.trend.words import sentence, span_of
from tests.lives import COPPER_1_K, STEADY, YEAR_D, kinds, make_life

DAYS = np.arange(500.0) + 0.5
R_MAX = Limit("R_max", 1.3, True)
#: Of `make_life`; far from those of calibration and report, which are twice the life's number and that plus one.
_SEED = 1_000_000


def noise(seed: int, std: float = 0.003) -> F64:
    return np.random.default_rng(seed).normal(0.0, std, len(DAYS))


def _width(range_: Range) -> float:
    return (range_.high or 0.0) - (range_.low or 0.0)


def test_wear_is_told_with_its_rate_and_the_time_until_the_limit() -> None:
    told = assess("R", DAYS, 1.0 + 0.1 * DAYS / YEAR_D + noise(1), None, (R_MAX,), 1.0)
    assert told.status == "trend" and told.limit == R_MAX and told.changes == ()
    assert told.years is not None and told.rate_percent is not None and told.used is not None
    left = 3.0 - DAYS[-1] / YEAR_D
    assert told.years.low is not None and told.years.low < left < (told.years.high or np.inf)
    assert told.years.mid == pytest.approx(left, rel=0.1)
    assert told.rate_percent.mid == pytest.approx(10.0, rel=0.05)
    assert told.used.mid == pytest.approx(0.1 * DAYS[-1] / YEAR_D / 0.3, rel=0.05)


def test_a_falling_parameter_comes_to_its_lower_limit_and_one_that_goes_away_to_none() -> None:
    limits = (Limit("K_min", 0.7, False),)
    falling = assess("K", DAYS, 1.0 - 0.1 * DAYS / YEAR_D + noise(2), None, limits, 1.0)
    rising = assess("K", DAYS, 1.0 + 0.1 * DAYS / YEAR_D + noise(2), None, limits, 1.0)
    assert falling.limit == limits[0]
    assert (rising.status, rising.limit, rising.years) == ("trend", None, None)
    assert sentence("K", rising).endswith("no limit within 30 years")


def test_noise_and_season_are_no_trend() -> None:
    """Half a year of a season that nobody measures looks like wear of 16 % a year."""
    rising = 0.04 * -np.cos(2 * np.pi * DAYS / YEAR_D) + noise(3)
    for value in (1.0 + noise(4), 1.0 + rising):
        told = assess("R", DAYS[:180], value[:180], None, (R_MAX,), 1.0)
        assert (told.status, told.years, told.rate_1_y) == ("no_trend", None, None)
        assert sentence("R", told) == "R: no trend"


def test_copper_is_taken_out_where_the_temperature_is_known() -> None:
    warm = 45.0 - 15.0 * np.cos(2 * np.pi * DAYS / YEAR_D)
    seen = (1.0 + 0.05 * DAYS / YEAR_D) * (1.0 + COPPER_1_K * (warm - 25.0)) + noise(5, 0.001)
    blind = assess("R", DAYS, seen, None, (R_MAX,), 1.0)
    told = assess("R", DAYS, seen, warm, (R_MAX,), 1.0)
    assert (blind.at_25_C, blind.remark) == (None, None)
    assert told.status == "trend" and told.rate_percent is not None
    assert told.rate_percent.mid == pytest.approx(5.0, rel=0.1)
    assert blind.rate_percent is None or _width(blind.rate_percent) > _width(told.rate_percent)
    assert told.at_25_C == pytest.approx(1.0 + 0.05 * 500 / YEAR_D, abs=0.003)
    magnets = assess("K", DAYS, seen, warm, (Limit("K_max", 1.3, True),), 1.0)
    assert magnets.at_25_C is None and magnets.remark is not None and "not known" in magnets.remark


def test_the_trend_starts_anew_after_an_exchange() -> None:
    limit = Limit("J_max", 1.3, True)
    since = np.where(DAYS < 300.0, DAYS, DAYS - 300.0)
    told = assess("J", DAYS, 1.0 + 0.2 * since / YEAR_D + noise(6), None, (limit,), 1.0)
    [change] = told.changes
    assert change.is_exchange and change.time_d == pytest.approx(300.0, abs=8.0)
    assert change.size == pytest.approx(-0.2 * 300.0 / YEAR_D, rel=0.1)
    assert told.since_d == pytest.approx(change.time_d, abs=8.0)
    assert told.status == "trend" and told.used is not None
    assert told.used.mid == pytest.approx(0.2 * 200.0 / YEAR_D / 0.3, rel=0.15), "of the new one's life"
    fresh = assess("J", DAYS[:330], 1.0 + 0.2 * since[:330] / YEAR_D + noise(6)[:330], None, (limit,), 1.0)
    assert fresh.status == "too_short" and "since the last exchange" in (fresh.reason or "")


def test_single_steps_are_no_habit_many_are() -> None:
    at = np.array([60.0, 130.0, 220.0, 290.0, 400.0])
    for steps, status in ((1, "no_trend"), (5, "trend")):
        worn = 0.03 * (DAYS[:, None] > at[:steps]).sum(axis=1)
        told = assess("R", DAYS, 1.0 + worn + noise(7, 0.002), None, (R_MAX,), 1.0)
        assert told.status == status
        assert [round(c.size, 2) for c in told.changes] == [0.03] * steps


def test_a_limit_that_is_reached() -> None:
    told = assess("R", DAYS, 1.25 + 0.2 * DAYS / YEAR_D + noise(8), None, (R_MAX,), 1.0)
    assert told.years == Range(0.0, 0.0, 0.0) and sentence("R", told).endswith("R_max is reached")
    assert is_near(told, 1.0)


@pytest.mark.parametrize(
    ("time", "value", "status"),
    [
        (DAYS[:0], DAYS[:0], "too_short"),
        (DAYS, np.full(500, np.nan), "too_short"),
        (DAYS[:40], np.ones(40), "too_short"),
        (np.append(DAYS[:35], 1826.0), np.ones(36), "too_short"),  # a month, and a day five years later
        (DAYS, np.ones(500), "no_trend"),
        (DAYS, np.zeros(500), "no_trend"),
    ],
)
def test_what_tells_nothing_has_no_trend(time: F64, value: F64, status: str) -> None:
    told = assess("R", time, value, None, (R_MAX,))
    assert (told.status, told.years, told.rate_1_y) == (status, None, None)


def test_hours_and_wrong_values_are_days_without_them() -> None:
    hours = np.arange(24.0 * 500.0) / 24.0 + 20_000.0
    value = 1.0 + 0.1 * (hours - 20_000.0) / YEAR_D + 0.05 * np.sin(2 * np.pi * hours)
    value += np.random.default_rng(9).normal(0.0, 0.01, len(hours))
    value[24 * 200 : 24 * 201] = 40.0
    value[::7] = np.nan
    told = assess("R", hours, value, None, (R_MAX,), 1.0)
    assert told.rate_percent is not None and told.rate_percent.mid == pytest.approx(10.0, rel=0.1)
    assert told.changes == ()


def test_bad_arrays_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        assess("R", DAYS, DAYS[:-1])
    with pytest.raises(ValueError, match="decreases"):
        assess("R", DAYS[::-1], DAYS)


def _told(low: float, high: float | None, years: Range | None) -> Trend:
    return Trend("trend", rate_percent=Range(low, (low + (high or low)) / 2, high), limit=R_MAX, years=years)


@pytest.mark.parametrize(
    ("trend", "text"),
    [
        (_told(1.2, 2.5, Range(6.0, 8.0, 11.0)), "R +1.9 %/year (1.2–2.5); R_max in 6–11 years"),
        (_told(-2.5, -1.2, Range(0.3, 0.5, 0.9)), "R -1.9 %/year (1.2–2.5); R_max in 4–11 months"),
        (_told(-1.0, 2.0, Range(3.0, 9.0, None)), "R +0.5 %/year (-1.0 to +2.0); R_max in 3 years or more"),
        (_told(0.01, 0.02, Range(0.01, 0.02, 0.1)), "R +0.015 %/year (0.010–0.020); R_max in 4–37 days"),
    ],
)
def test_in_words(trend: Trend, text: str) -> None:
    assert sentence("R", trend) == text


def test_a_narrow_interval_keeps_its_ends_apart() -> None:
    assert span_of(Range(2.51, 2.52, 2.54)) == "2.5–2.5 years"


@pytest.mark.slow
def test_intervals_hold_and_steady_lives_are_left_in_peace() -> None:
    """72 lives of other seeds than those that constants were chosen by: bounds that chance leaves once in a thousand
    (binomial, of 32 intervals that hold with 80 %: fewer than 18; of 20 steady ones with 2 %: more than 3)."""
    within = intervals = false = 0
    for k, kind in enumerate(kinds(72)):
        life = make_life(kind, _SEED + k)
        day = 0.7 * float(life.time_d[-1])
        known = life.until(day)
        limit = Limit("R_max", life.limit, True)
        years = assess("R", known.time_d, known.value, known.temperature_C, (limit,), 1.0).years
        if years is None or years.low is None:
            continue
        false += kind in STEADY
        intervals += kind not in STEADY
        within += years.low <= (life.crosses_d - day) / YEAR_D <= (years.high or np.inf)
    assert intervals >= 20 and within >= 18 / 32 * intervals
    assert false <= 3
