"""What a report's figures keep of long recordings, and how it is written as data."""

from __future__ import annotations

import base64
import json
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from servo_daemon.report import Axis, Bars, Iterations, Line, Mark, Plot, Points, Scatter, Spectrum, TimeSeries
from servo_daemon.report.decimate import keep_points, keep_rows
from servo_daemon.report.encode import encode
from servo_daemon.report.plots import MAX_ROWS, draw, row_limit
from servo_daemon.samples import F64

VOLT = Axis("voltage", "V")


def decode(document: dict[str, Any]) -> F64:
    """What the page's script does."""
    raw = np.frombuffer(base64.b64decode(document["data"]), "<f8" if document.get("wide") else "<f4")
    assert np.all(np.isfinite(raw)), "a NaN in the bits"
    values = raw.astype(float) + document["offset"]
    gaps = document.get("gaps", [])
    for start, stop in zip(gaps[::2], gaps[1::2], strict=True):
        values[start:stop] = np.nan
    return values


def test_every_spike_and_every_edge_of_a_gap_is_kept() -> None:
    n = 60_000
    rng = np.random.default_rng(1)
    lines = [0.01 * rng.standard_normal(n), np.sin(np.arange(n) / 900)]
    spikes = rng.choice(np.arange(100, n - 100, 150), 300, replace=False) + 7
    lines[0][spikes] = 5 + np.arange(300)
    lines[1][20_000:20_003] = np.nan
    rows = keep_rows(lines, 20_000, [lines[1]])
    assert 10_000 < rows.size <= 20_000
    assert (rows[0], rows[-1]) == (0, n - 1)
    assert np.all(np.diff(rows) > 0)
    assert set(spikes) <= set(rows)
    assert {19_999, 20_000, 20_002, 20_003} <= set(rows)
    coarse = rows[np.searchsorted(rows, np.arange(0, n, 60))]
    for k, line in enumerate(lines):  # what a screen shows: the extremes of every 60 samples
        for start, stop in pairwise(coarse):
            whole = line[start : stop + 1]
            if np.isfinite(whole).any():
                inside = rows[(rows >= start - 60) & (rows <= stop + 60)]
                assert np.nanmax(line[inside]) >= np.nanmax(whole), k
                assert np.nanmin(line[inside]) <= np.nanmin(whole), k


@given(
    hnp.arrays(np.float64, st.integers(1, 400), elements=st.floats(-1e6, 1e6) | st.just(float("nan"))),
    st.integers(8, 60),
)
def test_rows_whatever_the_signal(y: F64, limit: int) -> None:
    rows = keep_rows([y], limit, [y])
    assert rows.size <= max(limit, 8)
    assert np.all(np.diff(rows) > 0)
    assert (rows[0], rows[-1]) == (0, y.size - 1)
    if np.isfinite(y).any():
        assert np.nanmax(y[rows]) == np.nanmax(y)
        assert np.nanmin(y[rows]) == np.nanmin(y)
    if np.isnan(y).any() and not np.isnan(y).all():
        assert np.isnan(y[rows]).any()


def test_a_cloud_keeps_its_outline() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal((2, 100_000))
    x[7], y[8] = np.nan, np.inf
    x[50], y[60] = -30.0, 40.0
    rows = keep_points(x, y, 20_000)
    assert 19_000 < rows.size <= 20_000
    assert {50, 60} <= set(rows)
    assert not {7, 8} & set(rows)
    assert np.all(np.diff(x[rows]) >= 0)
    quarter = [np.mean((x[r] > 0) & (y[r] > 0)) for r in (rows, np.arange(100, x.size))]
    assert quarter[0] == pytest.approx(quarter[1], abs=0.02), "the rest is thinned evenly"


@example(np.array([1.79769313e308, -3.08977193e305]))
@given(hnp.arrays(np.float64, st.integers(1, 50), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_an_array_reads_back_and_is_never_nan(values: F64) -> None:
    document = json.loads(json.dumps(encode(values), allow_nan=False))
    back = decode(document)
    known = np.isfinite(values)
    assert np.array_equal(np.isfinite(back), known)
    if known.any():
        span = np.ptp(values[known] * 0.5)
        size = max(span, abs(float(np.max(np.abs(values[known])))) * 1e-8, 1e-300)
        assert np.max(np.abs(back[known] - values[known])) <= 1e-6 * size + float(np.finfo(np.float32).tiny)


def test_ten_hours_at_1_khz_keep_their_milliseconds() -> None:
    t = 36_000 + np.arange(36_000_000, step=1800) / 1000 + 0.001
    t = np.sort(np.concatenate([t, t + 0.001]))
    assert encode(t, ordered=True)["wide"] is True
    assert np.max(np.abs(decode(encode(t, ordered=True)) - t)) < 1e-6
    assert "wide" not in encode(np.arange(60_000) / 1000, ordered=True)
    assert decode(encode(np.arange(9.0))).tolist() == list(range(9))


def test_small_changes_of_a_large_value_stay_visible() -> None:
    temperature = 300 + 1e-4 * np.sin(np.arange(500) / 30)
    assert np.max(np.abs(decode(encode(temperature)) - temperature)) < 1e-10


def test_long_steps_become_gaps() -> None:
    x = np.concatenate([np.arange(100), np.arange(150, 250)]) / 100
    figure = TimeSeries("voltage", x, (Line("V", np.ones(200), np.zeros(200), np.full(200, 2.0)),), VOLT, gap=0.05)
    spec = draw(figure, MAX_ROWS).spec
    times, series = decode(spec["x"]), spec["series"][0]
    assert times.size == 201
    assert np.all(np.diff(times) > 0)
    for name in ("y", "low", "high"):
        assert np.flatnonzero(np.isnan(decode(series[name]))).tolist() == [100]
    assert spec["ends"] == (0.0, 2.49)


def test_logarithmic_axes_leave_out_what_they_cannot_show() -> None:
    f = np.linspace(0, 500, 501)
    y = np.where(f == 20, 0.0, 1 / (1 + f))
    spec = draw(Spectrum("spectrum", f, (Line("a", y),), Axis("density", log=True)), MAX_ROWS).spec
    assert decode(spec["x"])[0] == 1
    assert np.flatnonzero(np.isnan(decode(spec["series"][0]["y"]))).tolist() == [19]
    assert spec["ends"] == (1.0, 500.0)
    with pytest.raises(ValueError, match="shows none"):
        draw(Spectrum("spectrum", np.zeros(1), (Line("a", np.ones(1)),), VOLT), MAX_ROWS)


def test_the_rows_of_a_figure_follow_how_much_the_report_holds() -> None:
    def figure(lines: int, n: int) -> TimeSeries:
        return TimeSeries("f", np.arange(float(n)), tuple(Line(str(k), np.zeros(n)) for k in range(lines)), VOLT)

    assert row_limit([]) == row_limit([figure(1, 100)]) == row_limit([figure(3, 60_000)] * 6) == MAX_ROWS
    many = row_limit([figure(5, 60_000)] * 12)
    assert 4_000 <= many < 10_000
    assert many * 12 * 6 <= 500_000


def test_what_a_figure_says_to_those_who_do_not_see_it() -> None:
    y = np.array([np.nan, -1.5, 24.0])
    figure = TimeSeries("Voltage", np.arange(3.0), (Line("measured", y),), VOLT, marks=(Mark(1, "a step"),))
    words = draw(figure, MAX_ROWS).alternative
    assert words == "Voltage. voltage over time from 0 to 2.000 s. measured: −1.500 to 24.00 V. Marked: a step."
    void = Scatter("Cloud", (Points("p", np.zeros(1), np.array([np.nan])),), VOLT, VOLT)
    assert "p: no values" in draw(void, MAX_ROWS).alternative
    own = Iterations("Cost", np.arange(2.0), (Line("c", np.ones(2)),), VOLT, alternative="falls")
    assert draw(own, MAX_ROWS).alternative == "falls"


def test_how_many_points_are_drawn_is_said() -> None:
    n = 60_000
    figure = TimeSeries("f", np.arange(float(n)), (Line("a", np.sin(np.arange(float(n)))),), VOLT)
    drawing = draw(figure, 5_000)
    assert f"of {n:,} points".replace(",", "\u202f") in drawing.note
    assert decode(drawing.spec["x"]).size <= 5_000
    assert draw(figure, n).note == ""


def test_the_seventh_line_does_not_look_like_the_first() -> None:
    lines = tuple(Line(str(k), np.zeros(2)) for k in range(8))
    legend = draw(TimeSeries("f", np.arange(2.0), lines, VOLT), MAX_ROWS).legend
    assert len({(entry.colour, entry.style) for entry in legend}) == 8


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TimeSeries("f", np.arange(3.0), (), VOLT), "no line"),
        (lambda: TimeSeries("f", np.array([0.0, 0.0]), (Line("a", np.zeros(2)),), VOLT), "increasing"),
        (lambda: Plot("f", np.array([0.0, np.nan]), (Line("a", np.zeros(2)),), VOLT), "increasing"),
        (lambda: Plot("f", np.arange(3.0), (Line("a", np.zeros(2)),), VOLT), r"\(2,\)"),
        (lambda: Plot("f", np.arange(3.0), (Line("a", np.zeros(3), np.zeros(3)),), VOLT), "both its edges"),
        (lambda: Plot("f", np.empty(0), (Line("a", np.empty(0)),), VOLT), "n >= 1"),
        (lambda: Points("p", np.zeros(2), np.zeros(3)), r"\(3,\)"),
        (lambda: Scatter("f", (), VOLT, VOLT), "nothing to draw"),
        (lambda: Bars("f", (), VOLT), "no bar"),
    ],
)
def test_figures_that_cannot_be(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
