"""Trends from the store: found, warned of once, in API and metrics, and what happens without a store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.api.app import create_app
from servo_daemon.api.schemas.trend import TrendDocument
from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.daemon.trends.coordinator import TrendCoordinator
from servo_daemon.daemon.trends.watch import FAR, NEAR, already_told, warnings
from servo_daemon.errors import ConfigError
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.archive import ArchiveUnavailableError, Document, EventPage, Span
from servo_daemon.published.buckets import Buckets
from servo_daemon.published.history import STATUS_BY_CODE
from servo_daemon.published.metrics import render_metrics
from servo_daemon.published.rollup import roll_up
from servo_daemon.published.snapshot import Event
from servo_daemon.published.trends import DriveTrends
from servo_daemon.samples import make_block
from servo_daemon.trend.records import Limit, Range, Trend
from tests.fake_daemon import T0, fake_daemon
from tests.http_rig import Client
from tests.unit.history.world import World

R_MAX = Limit("R_max", 1.3, True)


def configured(**limits: object) -> DriveConfig:
    drive = {"name": "axis1", "driver": "fed", "nominal": {"R": 0.5, "K": 0.3}, "limits": limits}
    return parse_config({"drive": [drive]}).drive[0]


@dataclass
class Source:
    """A drive whose history was recorded."""

    active: DriveConfig
    log: EventLog = field(default_factory=lambda: EventLog("axis1"))
    trends: DriveTrends = field(default_factory=DriveTrends)
    name: str = "axis1"

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.log.all()]


@dataclass
class Store:
    """An `Archive` with a mean a day: R wears 20 % a year, K does not, J was never known. `seen` are its events."""

    days: int = 420
    seen: Sequence[Event] = ()

    @property
    def now(self) -> float:
        return T0 + self.days * 86400.0

    def names(self, drive: str) -> tuple[str, ...]:
        return ("R", "K", "J")

    def documents(self, drive: str, kind: str, limit: int) -> Sequence[Document]:
        return ()

    def document(self, drive: str, kind: str, number: int) -> Document | None:
        return None

    def events(self, drive: str, kinds: Sequence[str], *_more: object) -> EventPage:
        return EventPage(tuple(e for e in self.seen if e.kind in kinds), None)

    def span(
        self, drive: str, names: Sequence[str] | None, start_s: float, end_s: float | None, points: int | None,
        level: str | None = None,
    ) -> Span:  # fmt: skip
        assert level == "1 h" and names is not None and start_s < T0
        rng, day = np.random.default_rng(1), np.arange(self.days)
        R = 0.5 * (1.0 + 0.2 * day / 365.25 + 0.003 * rng.normal(size=self.days))
        K = 0.3 * (1.0 + 0.003 * rng.normal(size=self.days))
        value = np.column_stack([R, K, np.full(self.days, 9.0)])
        code = np.tile(np.array([_code("tracking"), _code("tracking"), _code("invalid")], np.int8), (self.days, 1))
        rows = Buckets.of_rows(
            T0 + 86400.0 * day, self.names(drive), ("Ω", "", ""), (True,) * 3, value, np.full_like(value, 0.01), code
        )
        return Span("1 h", start_s, self.now, roll_up(rows, 3600.0).select(names))


def _code(status: str) -> int:
    return STATUS_BY_CODE.index(status)


@pytest.fixture(scope="module")
def found() -> DriveTrends:
    """Of a drive with an upper limit of R."""
    source, store = Source(configured(R_max="+30 %")), Store()
    TrendCoordinator(store, [source], lambda: store.now).turn()
    return source.trends


def test_trends_are_found_in_the_store_and_a_near_limit_is_told_once() -> None:
    source, store = Source(configured(R_max="+30 %", K_min="-30 %", warn_before="0.5 y")), Store()
    coordinator = TrendCoordinator(store, [source], lambda: store.now)
    assert source.trends.time is None and "minute" in (source.trends.reason or "")
    coordinator.turn()
    R, K, J = (source.trends.trends[name] for name in ("R", "K", "J"))
    left = 1.5 - 420 / 365.25
    assert R.years is not None and R.years.low is not None and R.years.high is not None
    assert R.years.low < left < R.years.high and R.limit is not None and R.limit.name == "R_max"
    assert (K.status, K.years, J.status) == ("no_trend", None, "too_short"), "what was invalid is no data"
    assert source.trends.near == {"R"} and source.kinds == [NEAR]
    coordinator.turn()
    assert source.kinds == [NEAR]
    again, store.seen = Source(source.active, source.log), source.log.all()  # the daemon is started again
    TrendCoordinator(store, [again], lambda: store.now).turn()
    assert again.trends.near == {"R"} and source.kinds == [NEAR], "it stands since before the start"


def test_a_warning_ends_with_the_exchange_and_not_with_noise() -> None:
    def near_by(low: float | None) -> DriveTrends:
        years = None if low is None else Range(low, low + 0.1, low + 0.2)
        trend = Trend("no_trend" if years is None else "trend", limit=R_MAX, years=years)
        near = frozenset({"R"} if low is not None and low * 365.25 < 180.0 else ())
        return DriveTrends(0.0, None, 180.0, {"R": trend}, near)

    standing: frozenset[str] = frozenset()
    told = []
    for low in (0.8, 0.4, 0.6, 0.4, 0.8, 0.3, None):
        standing, messages = warnings(standing, near_by(low))
        told.append([kind for kind, _, _ in messages])
    assert told == [[], [NEAR], [], [], [FAR], [NEAR], [FAR]]
    events = tuple(Event(float(k), kind, "", {"parameter": "R"}) for k, kind in enumerate((NEAR, FAR, NEAR)))
    assert already_told(events) == {"R"} and already_told(events[:2]) == frozenset()


class Broken(Store):
    def span(self, *asked: object) -> Span:  # type: ignore[override]
        raise ArchiveUnavailableError("the disk is gone")


def test_trends_are_asked_of_the_real_store(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path)
    world.run(3.0)
    source = Source(configured())
    TrendCoordinator(world.archive, [source], lambda: world.now).turn()
    assert {name: t.status for name, t in source.trends.trends.items()} == {"R": "too_short"}


def test_without_a_store_it_is_said_why_there_are_none() -> None:
    source = Source(configured())
    TrendCoordinator(Broken(), [source]).turn()
    assert (source.trends.trends, source.trends.reason) == ({}, "the disk is gone")
    TrendCoordinator(None, [source]).turn()
    assert source.trends.time is None and "state_dir" in (source.trends.reason or "")


def test_api_and_metrics_show_what_was_found(found: DriveTrends) -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].trends = found
    client = Client(create_app(daemon))
    response = client.get("/api/v1/drives/axis1/trend")
    document = TrendDocument.model_validate(response.json())
    R = document.parameters["R"]
    assert document.near == ["R"] and R.years_until_limit is not None and R.limit is not None
    assert R.text.startswith("R +") and R.unit == "Ω" and R.since is not None and R.since.startswith("2026-11-2")
    assert (
        client.get("/api/v1/drives/axis1/trend", headers={"If-None-Match": response.headers["etag"]}).status_code == 304
    )
    lines = render_metrics(daemon)
    of = 'drive="axis1",parameter="R",limit="R_max",probability="0.1"'
    [seconds] = [line.split()[-1] for line in lines.splitlines() if "time_until_limit_seconds{" + of in line]
    assert float(seconds) == pytest.approx(R.years_until_limit.low * 365.25 * 86400.0, rel=1e-6)  # type: ignore[operator]
    assert 'servo_daemon_limit_near{drive="axis1"} 1' in lines and "life_used_ratio" in lines
    assert 'time_until_limit_seconds{drive="axis1",parameter="K"' not in lines
    empty = TrendDocument.model_validate(Client(create_app(fake_daemon())).get("/api/v1/drives/axis1/trend").json())
    assert empty.parameters == {} and empty.reason is not None


def test_a_measured_temperature_is_among_the_states() -> None:
    time = np.arange(0.0, 0.5, 1e-3)
    still = np.zeros_like(time)
    warm = np.where(time < 0.2, 30.0, 31.0)
    warm[-1] = np.nan
    block = make_block(time, voltage_V=still, current_A=still, position_rad=still, temperature_C=warm)
    whole = [e.state.get("temperature_C") for e in Pipeline(configured()).process(block)]
    assert {whole[0], whole[-1]} == {30.0, 31.0}
    plain = make_block(time, voltage_V=still, current_A=still, position_rad=still)
    assert "temperature_C" not in Pipeline(configured()).process(plain)[-1].state


def test_warn_before_is_a_time() -> None:
    assert configured(warn_before="26 w").limits.warn_before_d == 182.0
    with pytest.raises(ConfigError, match="warn_before: '26' is not a time"):
        configured(warn_before="26")
    assert (
        configured().signals.meaning() == configured().signals.model_copy(update={"temperature": "winding"}).meaning()
    )
