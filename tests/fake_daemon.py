"""A daemon for tests of the API and the page: records as the pipeline would publish them, made up on demand."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

from servo_daemon.parameters import LINEAR
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.published.archive import Archive, Captures, KeptCapture
from servo_daemon.published.diagnosis_state import Adoption, Diagnosis, DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.knowledge import LoopFacts
from servo_daemon.published.sinks import SinkState
from servo_daemon.published.snapshot import (
    AlarmLimit,
    Connection,
    Covariance,
    Estimate,
    EstimatorView,
    Event,
    ParameterEstimate,
    Snapshot,
    Status,
)
from servo_daemon.published.trends import DriveTrends
from servo_daemon.published.view import ModelChange, StartValues, initial_parameters
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: A fixed moment, so that answers can be compared as text: 2026-11-21T12:00:00Z.
T0 = 1_795_262_400.0
NOMINAL = {"R": 0.7011, "L": 3.1877e-3, "K": 0.1991, "J": 0.013456, "B": 0.33753}
TRUE = {"R": 0.4937, "L": 2.2769e-3, "K": 0.30628, "J": 0.009751, "B": 0.51141}
UNITS = {p.name: p.unit for p in LINEAR}


def parameters_at(t: float, status: Status = "tracking", reason: str | None = None) -> tuple[ParameterEstimate, ...]:
    """The five parameters `t` seconds after the start, settling on their true values."""
    out = []
    for k, (name, true) in enumerate(TRUE.items()):
        std = true * (0.002 + 0.05 * math.exp(-t / 5.0))
        value = true * (1.0 + 0.02 * math.exp(-t / 8.0) * math.cos(t + k)) + 0.3 * std * math.sin(1.7 * t + 2 * k)
        out.append(ParameterEstimate(name, value, std, UNITS[name], NOMINAL[name], status, reason))
    return tuple(out)


def covariance_of(parameters: Sequence[ParameterEstimate]) -> Covariance | None:
    """Of the known ones, without correlations."""
    known = [p for p in parameters if p.status == "tracking" and p.value and p.std and 0 < p.std < p.value < math.inf]
    if not known:
        return None
    rows = [tuple(((p.std or 0.0) / (p.value or 1.0)) ** 2 * (p is q) for q in known) for p in known]
    return Covariance(tuple(p.name for p in known), tuple(rows))


def make_estimate(t: float = 1.0, parameters: Sequence[ParameterEstimate] | None = None, **changes: object) -> Estimate:
    """An estimate `t` seconds after the start; `changes` replace fields."""
    shown = tuple(parameters_at(t) if parameters is None else parameters)
    pairs = {p.name: (p.value, p.std) for p in shown}
    estimate = Estimate(
        time_s=t,
        samples=int(1000 * t),
        sample_rate_hz=1000.2,
        model=(),
        parameters=shown,
        state={
            "current_A": 3.2 * math.sin(2.1 * t),
            "velocity_rad_s": 6.0 * math.cos(2.1 * t),
            "position_rad": 0.8726 * math.sin(0.7 * t),
        },
        estimators={"ekf": EstimatorView(pairs, {"restarts": 0}), "rls": EstimatorView(pairs)},
        health={"innovation_white": True, "step_time_us": 8.5},
        covariance=covariance_of(shown),
    )
    return replace(estimate, **changes)  # type: ignore[arg-type]


def make_snapshot(drive: str = "axis1", t: float = 1.0, **changes: object) -> Snapshot:
    """A connected drive's snapshot `t` seconds after T0; `changes` replace fields."""
    snapshot = Snapshot(
        drive=drive,
        driver="simulated",
        time=T0 + t,
        connection="connected",
        reason=None,
        estimate=make_estimate(t),
        counters={"samples": int(1000 * t), "samples_lost": 0, "queue_dropped": 0, "queue_samples": 3},
        truth=TRUE,
    )
    return replace(snapshot, **changes)  # type: ignore[arg-type]


RUNNING = Diagnosis("running", "request", (), T0, None, 60_000, 60.0, 0.35, "round 1: fitting coulomb_friction")


@dataclass
class FakeDrive:
    """A `DriveView` whose snapshot the test sets."""

    name: str = "axis1"
    driver: str = "simulated"
    model: tuple[str, ...] = ()
    meaning: SignalMeaning = field(default_factory=SignalMeaning)
    history: HistoryRing = field(default_factory=HistoryRing)
    current: Snapshot | None = None
    log: deque[Event] = field(default_factory=lambda: deque(maxlen=100))
    resets: int = 0
    limits: Sequence[AlarmLimit] = ()
    ring: SampleRing = field(default_factory=lambda: SampleRing(60.0))
    trends: DriveTrends = field(default_factory=DriveTrends)
    loop: LoopFacts = field(default_factory=lambda: LoopFacts(nominal=NOMINAL))
    diagnosis: DiagnosisView = field(default_factory=lambda: DiagnosisView(Diagnosis(), Adoption(False), True, None))
    refusal: Exception | None = None  # of the next request
    outcome: ModelChange | None = None  # of a change of the model; None: it takes for ever
    asked: list[tuple[tuple[str, ...], dict[str, object]]] = field(default_factory=list)
    was_asked: threading.Event = field(default_factory=threading.Event)

    @property
    def initial_parameters(self) -> Sequence[ParameterEstimate]:
        return initial_parameters(LINEAR, NOMINAL)

    def snapshot(self) -> Snapshot:
        if self.current is None:
            self.current = Snapshot(self.name, self.driver, None, "connecting", "port is opened", None, {})
        return self.current

    newest = snapshot

    def publish(self, snapshot: Snapshot) -> None:
        self.current = snapshot
        self.history.append(snapshot)

    def lose(self, connection: Connection, reason: str) -> None:
        """The drive goes away: what was known becomes invalid, as in the daemon."""
        last = self.snapshot()
        assert last.estimate is not None
        stale = tuple(replace(p, status="invalid", reason=reason) for p in last.estimate.parameters)
        estimate = replace(last.estimate, parameters=stale)
        self.current = replace(last, connection=connection, reason=reason, estimate=estimate)

    def events(self) -> Sequence[Event]:
        return tuple(self.log)

    def samples(self) -> Sequence[SampleBlock]:
        return self.ring.blocks()

    def request_reset(self) -> None:
        self.resets += 1

    def request_model(self, effects: Sequence[str], start: StartValues) -> Future[ModelChange]:
        if isinstance(self.refusal, Exception):
            raise self.refusal
        self.asked.append((tuple(effects), dict(start)))
        self.was_asked.set()
        future: Future[ModelChange] = Future()
        if self.outcome is not None:
            self.model = tuple(effects)
            future.set_result(self.outcome)
        return future

    def request_diagnosis(self) -> None:
        if isinstance(self.refusal, Exception):
            raise self.refusal
        self.diagnosis = replace(self.diagnosis, diagnosis=RUNNING, allowed=False, reason="one is running")


@dataclass
class FakeCaptures:
    """`published.archive.Captures` of what the test puts there."""

    captures: list[KeptCapture] = field(default_factory=list)
    refusal: Exception | None = None
    asked: list[float] = field(default_factory=list)

    def of(self, drive: str) -> Sequence[KeptCapture]:
        return [k for k in self.captures if k.drive == drive]

    def request(self, drive: str, seconds: float) -> Future[KeptCapture]:
        if self.refusal is not None:
            raise self.refusal
        self.asked.append(seconds)
        future: Future[KeptCapture] = Future()
        future.set_result(self.captures[0])
        return future


@dataclass
class FakeDaemon:
    """A `DaemonView` over fake drives."""

    drives: Mapping[str, FakeDrive]
    version: str = "1.2.3"
    started: float = T0
    wrong: tuple[str, ...] = ()
    stop: bool = False
    archive: Archive | None = None
    captures: Captures | None = None
    sinks: Sequence[SinkState] = ()

    def problems(self) -> Sequence[str]:
        return self.wrong

    def stopping(self) -> bool:
        return self.stop


def fake_daemon(*names: str, published: bool = True) -> FakeDaemon:
    """A daemon with these drives ("axis1" if none), each with one published snapshot."""
    drives = {name: FakeDrive(name) for name in names or ("axis1",)}
    if published:
        for drive in drives.values():
            drive.publish(make_snapshot(drive.name))
    return FakeDaemon(drives)


def live_snapshot(drive: str, started: float, now: float | None = None) -> Snapshot:
    """What a drive that started at `started` (epoch s) would publish now."""
    now = time.time() if now is None else now
    return replace(make_snapshot(drive, now - started), time=now)
