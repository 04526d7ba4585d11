"""The ring of published rows against a list that never forgets, and its pace, threads and thinning."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servo_daemon.published.history import STATUS_BY_CODE, HistoryRing, HistorySeries, thin
from servo_daemon.published.snapshot import ParameterEstimate, Snapshot, Status
from servo_daemon.published.units import split_unit
from tests.fake_daemon import make_estimate, make_snapshot

NAMES = ("R", "L", "Tc")
STATUSES: tuple[Status, ...] = ("estimating", "tracking", "invalid")
numbers = st.none() | st.floats(-1e3, 1e3, allow_subnormal=False)


@dataclass(frozen=True)
class Row:
    time: float
    parameters: dict[str, tuple[float | None, float | None, Status]]
    state: dict[str, float | None]
    truth: dict[str, float] | None

    def snapshot(self) -> Snapshot:
        parameters = tuple(
            ParameterEstimate(name, value, std, "unit", None, status)
            for name, (value, std, status) in self.parameters.items()
        )
        estimate = make_estimate(1.0, parameters, state=self.state)
        return replace(make_snapshot(), time=self.time, estimate=estimate, truth=self.truth)


@st.composite
def histories(draw: st.DrawFn) -> list[Row]:
    """Rows a second or more apart, sometimes with the clock set back; parameters and channels come and go."""
    time = 1000.0
    rows = []
    for _ in range(draw(st.integers(0, 25))):
        time += draw(st.sampled_from([1.0, 2.5, 1.0, -7.25]))
        names = draw(st.sets(st.sampled_from(NAMES)))
        values = st.tuples(numbers, numbers, st.sampled_from(STATUSES))
        parameters = {name: draw(values) for name in sorted(names)}
        channels = draw(st.sets(st.sampled_from(["current_A", "velocity_rad_s"])))
        state = {name: draw(numbers) for name in sorted(channels)}
        truth = draw(st.none() | st.just({"R": time / 1e3, "other": 1.0}))
        rows.append(Row(time, parameters, state, truth))
    return rows


def known_or_none(array: np.ndarray) -> list[float | None]:
    return [None if math.isnan(v) else v for v in array.tolist()]


def twin_query(rows: list[Row], name: str, start: float | None, end: float | None) -> list[tuple[object, ...]]:
    """(time, value, std, status, truth) by plain search."""
    found = []
    for row in rows:
        if (start is not None and row.time < start) or (end is not None and row.time > end):
            continue
        if name in row.parameters:
            value, std, status = row.parameters[name]
            found.append((row.time, value, std, status, (row.truth or {}).get(name)))
        elif name not in NAMES:
            found.append((row.time, row.state.get(name), None, None, None))
    return sorted(found, key=lambda r: float(str(r[0])))


def as_tuples(series: HistorySeries) -> list[tuple[object, ...]]:
    n = len(series)
    status: list[str | None] = [None] * n if series.status is None else [STATUS_BY_CODE[c] for c in series.status]
    truth = [None] * n if series.truth is None else known_or_none(series.truth)
    columns = (series.time_s.tolist(), known_or_none(series.value), known_or_none(series.std), status, truth)
    return list(zip(*columns, strict=True))


@settings(max_examples=80, derandomize=True, deadline=None)
@given(histories(), st.integers(1, 12), st.none() | st.floats(980, 1040), st.none() | st.floats(980, 1040))
def test_like_a_list_that_never_forgets(rows: list[Row], capacity: int, start: float | None, end: float | None) -> None:
    ring = HistoryRing(capacity)
    kept = [row for row in rows if ring.append(row.snapshot())]
    assert kept == rows  # a second apart is slow enough, and a clock set back starts anew
    kept = kept[-capacity:]
    assert len(ring) == len(kept)
    assert set(ring.names()) == {name for row in kept for name in (*row.parameters, *row.state)}
    for name in ring.names():
        assert as_tuples(ring.query(name, start, end)) == twin_query(kept, name, start, end)
    for name in {*NAMES, "current_A", "nothing"} - set(ring.names()):
        with pytest.raises(KeyError):
            ring.query(name)


def paced(ring: HistoryRing, times: np.ndarray) -> int:
    template = make_snapshot()
    return sum(ring.append(replace(template, time=float(t))) for t in times)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.floats(5.0, 200.0), st.integers(0, 2**32 - 1))
def test_rows_come_at_no_more_than_the_rate(publish_hz: float, seed: int) -> None:
    jitter = np.random.default_rng(seed).uniform(-0.2, 0.2, 400)
    times = 1000.0 + (np.arange(400) + jitter) / publish_hz
    kept = paced(HistoryRing(1000), times)
    assert kept <= 10.0 * (times[-1] - times[0]) + 2
    if publish_hz > 40:
        assert kept >= 0.85 * 10.0 * (times[-1] - times[0])


def test_publishing_at_the_rate_with_jitter_loses_nothing() -> None:
    jitter = np.random.default_rng(1).uniform(-0.02, 0.02, 500)
    assert paced(HistoryRing(1000), 1000.0 + 0.1 * np.arange(500) + jitter) == 500


def test_nothing_new_is_no_row() -> None:
    ring = HistoryRing()
    assert not ring.append(make_snapshot(estimate=None))
    assert not ring.append(make_snapshot(time=None))
    assert ring.append(make_snapshot())
    assert not ring.append(make_snapshot())
    assert len(ring) == 1


def test_memory_stays_flat_while_models_come_and_go() -> None:
    ring = HistoryRing(5)
    for k in range(200):
        parameters = (ParameterEstimate(f"P{k}", 1.0, 0.1, "", None, "tracking"),)
        ring.append(make_snapshot(t=k, estimate=make_estimate(k, parameters, state={})))
    assert ring.names() == ("P195", "P196", "P197", "P198", "P199")


def series(values: list[float]) -> HistorySeries:
    array = np.array(values, dtype=float)
    time_s = np.arange(array.size, dtype=float)
    return HistorySeries("R", "Ω", time_s, array, np.zeros(array.size), np.ones(array.size, np.int8), time_s)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.lists(st.floats(-10, 10) | st.just(math.nan), min_size=1, max_size=200), st.integers(2, 50))
def test_thinning_keeps_ends_and_extremes(values: list[float], points: int) -> None:
    whole = series(values)
    few = thin(whole, points)
    assert 1 <= len(few) <= max(points, 1)
    rows = few.time_s.astype(int)
    assert rows.tolist() == sorted(set(rows.tolist()))
    assert rows[0] == 0
    assert rows[-1] == len(values) - 1
    np.testing.assert_array_equal(few.value, whole.value[rows])  # recorded rows, nothing averaged
    if points >= 4 and not np.isnan(whole.value).all():
        assert np.nanmax(few.value) == np.nanmax(whole.value)
        assert np.nanmin(few.value) == np.nanmin(whole.value)
    if len(values) <= points:
        assert len(few) == len(values)


def test_thinning_to_less_than_two_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        thin(series([1.0]), 1)


def test_readers_see_whole_rows_while_the_writer_writes() -> None:
    """Every row holds one number in all its columns; a torn row would mix two."""
    ring = HistoryRing(50)
    torn: list[HistorySeries] = []
    reads = 0
    done = threading.Event()

    def snapshot(k: float) -> Snapshot:
        parameters = (ParameterEstimate("R", k, k, "Ω", None, "tracking"),)
        estimate = make_estimate(1.0, parameters, state={"current_A": k})
        return replace(make_snapshot(), time=k, estimate=estimate, truth={"R": k})

    def read() -> None:
        nonlocal reads
        while not done.is_set():
            s = ring.query("R")
            assert s.truth is not None
            whole = (s.value == s.time_s) & (s.std == s.time_s) & (s.truth == s.time_s)
            reads += 1
            if not whole.all() or (np.diff(s.time_s) <= 0).any() or len(s) > 50:
                torn.append(s)

    ring.append(snapshot(0.0))
    threads = [threading.Thread(target=read) for _ in range(2)]
    for thread in threads:
        thread.start()
    k = 0
    while k < 3000 or reads < 20:
        k += 1
        ring.append(snapshot(float(k)))
    done.set()
    for thread in threads:
        thread.join(10)
    assert not torn
    assert len(ring) == 50


@pytest.mark.parametrize(("capacity", "rate_hz"), [(0, 10.0), (10, 0.0), (10, math.nan)])
def test_an_impossible_ring_is_refused(capacity: int, rate_hz: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        HistoryRing(capacity, rate_hz)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("velocity_rad_s", ("velocity", "rad/s")),
        ("position_rad", ("position", "rad")),
        ("current_A", ("current", "A")),
        ("velocity_m_s", ("velocity", "m/s")),
        ("theta", ("theta", None)),
    ],
)
def test_units_in_names(name: str, parts: tuple[str, str | None]) -> None:
    assert split_unit(name) == parts


@pytest.mark.parametrize(
    ("times", "held", "elsewhere"),
    [
        ([100.0, 101.0, 102.0], 100.5, 99.0),
        ([0.0, 1.0, 5000.0, 5001.0], 5000.5, 4000.0),  # a wrong year at first: earlier processes wrote before 5000
        ([5000.0, 5001.0, 4000.0, 4001.0], 5001.5, 4500.0),  # set back; the oldest that is kept is of the wrong time
    ],
)
def test_what_may_lie_in_a_store_alone_is_not_held(times: list[float], held: float, elsewhere: float) -> None:
    ring = HistoryRing(capacity=5)
    assert not ring.holds(0.0)
    for time in times:
        ring.append(Row(time, {}, {}, None).snapshot())
    assert ring.holds(held) and not ring.holds(elsewhere)
