"""Summing up against sums over all rows at once, whatever the steps in between."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.published.buckets import STATUSES, Buckets
from servo_daemon.published.rollup import join, roll_up
from tests.unit.history.rows import make_rows


@pytest.mark.parametrize("steps", [(60.0,), (1.0, 60.0), (1.0, 10.0, 60.0)])
def test_minutes_hold_what_their_rows_hold(steps: tuple[float, ...]) -> None:
    rows = make_rows(seconds=150.0)
    rolled = rows
    for step in steps:
        rolled = roll_up(rolled, step)
    minute = np.floor(rows.time_s / 60.0) * 60.0
    assert rolled.time_s.tolist() == np.unique(minute).tolist()
    for k in range(len(rows.names)):
        for n, begin in enumerate(rolled.time_s):
            inside = (minute == begin) & (rows.count[:, k] > 0)
            values = rows.mean[inside, k]
            assert rolled.count[n, k] == len(values)
            if len(values):
                found = (rolled.mean[n, k], rolled.spread[n, k], rolled.low[n, k], rolled.high[n, k])
                assert found == pytest.approx((values.mean(), values.std(), values.min(), values.max()))
            assert rolled.status[n, k].tolist() == rows.status[minute == begin, k].sum(axis=0).tolist()
        if rows.is_parameter[k]:
            inside = (minute == rolled.time_s[0]) & (rows.count[:, k] > 0)
            assert rolled.std[0, k] == pytest.approx(np.sqrt(np.mean(rows.std[inside, k] ** 2)))


def test_nominal_and_held_values_count_for_nothing() -> None:
    code = np.array(
        [[STATUSES.index("estimating") + 1], [STATUSES.index("invalid") + 1], [STATUSES.index("tracking") + 1]]
    )
    value = np.array([[9.0], [9.0], [1.0]])
    rows = Buckets.of_rows(
        np.array([0.0, 0.1, 0.2]), ["R"], ["Ω"], [True], value, np.array([[np.nan], [0.1], [0.1]]), code.astype(np.int8)
    )
    second = roll_up(rows, 1.0)
    assert (second.count[0, 0], second.mean[0, 0], second.high[0, 0]) == (1, 1.0, 1.0)
    assert second.status[0, 0].sum() == 3
    nothing = roll_up(rows.take(slice(0, 2)), 1.0)
    assert nothing.count[0, 0] == 0 and np.isnan(nothing.mean[0, 0]) and np.isnan(nothing.low[0, 0])


def test_parts_of_other_models_are_joined_by_name() -> None:
    old, new = make_rows(seconds=2.0), make_rows(seconds=2.0, begin_s=1000.0, names=("R", "Tc"))
    joined = join([new, old])
    assert np.all(np.diff(joined.time_s) > 0)
    assert set(joined.names) == {"R", "K", "current_A", "Tc"}
    Tc = joined.select(["Tc"])
    assert np.isnan(Tc.mean[: len(old)]).all() and np.array_equal(Tc.mean[len(old) :, 0], new.mean[:, 1])
    assert Tc.count[: len(old)].sum() == 0 and Tc.status[: len(old)].sum() == 0


def test_the_two_parts_of_a_bucket_become_one() -> None:
    rows = make_rows(seconds=3.0)
    whole = roll_up(rows, 1.0)
    cut = join([roll_up(rows.take(slice(0, 14)), 1.0), roll_up(rows.take(slice(14, None)), 1.0)])
    assert len(cut) == len(whole) + 1
    assert roll_up(cut, 1.0).mean == pytest.approx(whole.mean, nan_ok=True)
    assert roll_up(cut, 1.0).spread == pytest.approx(whole.spread, nan_ok=True)
