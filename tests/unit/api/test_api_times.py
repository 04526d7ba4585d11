"""Times in and out."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servo_daemon.api.times import iso_utc_list, parse_time
from servo_daemon.published.units import iso_utc

NOW = 1_795_262_400.25  # 2026-11-21T12:00:00.250Z


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("now", NOW),
        ("-10min", NOW - 600),
        ("-0s", NOW),
        ("-1.5h", NOW - 5400),
        ("-250ms", NOW - 0.25),
        (" -2 d ", NOW - 172_800),
        ("1795262400", NOW - 0.25),
        ("1795262400.25", NOW),
        ("0", 0.0),
        ("2026-11-21T12:00:00.250Z", NOW),
        ("2026-11-21T12:00:00.250", NOW),
        ("2026-11-21T13:00:00.250+01:00", NOW),
        ("2026-11-21T13:00:00.250 01:00", NOW),  # a plus sign that was not percent-encoded
        ("2026-11-21", NOW - 43_200.25),
        ("20261121", NOW - 43_200.25),
    ],
)
def test_accepted(text: str, expected: float) -> None:
    assert parse_time(text, NOW) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "text", ["", "yesterday", "-600", "-10", "10min", "-5y", "nan", "inf", "1e300", "2026-13-01", "--1s", "-1s ago"]
)
def test_refused_with_what_is_accepted(text: str) -> None:
    with pytest.raises(ValueError, match=r"-10min|years 1 and 9999"):
        parse_time(text, NOW)


@settings(max_examples=200, derandomize=True)
@given(st.integers(0, 4_102_444_800_000))
def test_written_times_read_back_to_the_millisecond(milliseconds: int) -> None:
    epoch_s = milliseconds / 1000
    text = iso_utc(epoch_s)
    assert text.endswith("Z")
    assert datetime.fromisoformat(text).astimezone(UTC).timestamp() == pytest.approx(epoch_s, abs=1e-3)
    assert parse_time(text, NOW) == pytest.approx(epoch_s, abs=1e-3)
    assert (
        iso_utc_list(np.array([epoch_s]))[0]
        == datetime.fromtimestamp(epoch_s, UTC).strftime("%Y-%m-%dT%H:%M:%S.") + f"{milliseconds % 1000:03d}Z"
    )


def test_no_times() -> None:
    assert iso_utc_list(np.array([])) == []
