"""Bytes give back what was put in, to the digits that are promised, and never something else."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servo_daemon.api.times import iso_utc_list
from servo_daemon.history.codec import BlockError, dump, pack, unpack
from servo_daemon.published.buckets import Buckets
from servo_daemon.published.rollup import roll_up
from tests.unit.history.rows import make_rows

ROWS = make_rows(seconds=60.0)


@pytest.mark.parametrize("rows", [ROWS, roll_up(ROWS, 1.0)], ids=["rows", "seconds"])
def test_an_open_block_is_exact(rows: Buckets) -> None:
    again = unpack(dump(rows))
    for f in fields(rows):
        before, after = getattr(rows, f.name), getattr(again, f.name)
        equal = np.array_equal(before, after, equal_nan=True) if isinstance(before, np.ndarray) else before == after
        assert equal, f.name


@pytest.mark.parametrize("period_s", [0.0, 1.0])
def test_a_packed_block_rounds_as_it_says(period_s: float) -> None:
    rows = roll_up(ROWS, period_s) if period_s else ROWS
    again = unpack(pack(rows))
    assert again.names == rows.names and again.units == rows.units and again.is_parameter == rows.is_parameter
    assert again.time_s == pytest.approx(rows.time_s, abs=5e-4)
    assert np.array_equal(again.count, rows.count) and np.array_equal(again.status, rows.status)
    smallest = np.nanmin(rows.std, axis=0, initial=np.inf, where=np.isfinite(rows.std))
    for k in range(2):
        assert np.nanmax(np.abs(again.mean[:, k] - rows.mean[:, k])) <= smallest[k] / 16 / 2
    assert np.array_equal(np.isnan(again.mean), np.isnan(rows.mean))
    assert again.std == pytest.approx(rows.std, rel=0.017, nan_ok=True)
    if period_s:
        known = rows.count > 0
        assert np.all(again.low[known] <= rows.low[known] + 1e-9) and np.all(
            again.high[known] >= rows.high[known] - 1e-9
        )
        assert np.all(rows.low[known] - again.low[known] <= 0.01 / 8)
        assert again.spread == pytest.approx(rows.spread, rel=0.017, nan_ok=True)


def test_rounding_again_changes_nothing() -> None:
    once = unpack(pack(ROWS))
    assert np.array_equal(unpack(pack(once)).mean, once.mean, equal_nan=True)


def test_a_row_is_called_the_same_before_and_after() -> None:
    rows = replace(ROWS, time_s=ROWS.time_s[0] // 1 + np.arange(len(ROWS)) / 8 + 0.0005)
    assert iso_utc_list(unpack(pack(rows)).time_s) == iso_utc_list(rows.time_s)


def test_one_series_of_many() -> None:
    one = unpack(pack(ROWS), ["K", "no such"])
    assert one.names == ("K",)
    assert one.mean[:, 0] == pytest.approx(unpack(pack(ROWS)).mean[:, 1], nan_ok=True)
    assert unpack(pack(ROWS), []).mean.shape == (len(ROWS), 0)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=False, width=64), min_size=1, max_size=30))
def test_any_number_comes_back(values: list[float]) -> None:
    """Without a std to round to (told, not estimated), and a state channel's single rows: exactly."""
    value = np.array(values)[:, None]
    rows = Buckets.of_rows(
        np.arange(len(values)) * 1.0, ["R"], [None], [True], value, np.full_like(value, np.nan),
        np.full(value.shape, 5, np.int8),
    )  # fmt: skip
    assert np.array_equal(unpack(pack(rows)).mean, value, equal_nan=True)


@pytest.mark.parametrize("make", [dump, pack])
def test_damaged_bytes_are_an_error(make: object) -> None:
    data = bytearray(dump(ROWS) if make is dump else pack(ROWS))
    for at in (0, 3, 6, 12, 30, len(data) // 2, len(data) - 3):
        bad = bytearray(data)
        bad[at] ^= 0x55
        with pytest.raises(BlockError):
            unpack(bytes(bad))
    with pytest.raises(BlockError):
        unpack(bytes(data[: len(data) // 2]))


def test_a_packed_minute_is_small() -> None:
    assert len(pack(ROWS)) < len(dump(ROWS)) / 4
