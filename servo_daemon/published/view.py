"""What the API may see of the running daemon. The daemon implements these; the API knows nothing else.

Everything here is read by the API's event loop while the pipeline threads run: each method returns at once, takes no
lock for longer than a copy of a few columns, and hands out immutable records.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Protocol

from servo_daemon.parameters import Parameter
from servo_daemon.published.archive import Archive, Captures
from servo_daemon.published.diagnosis_state import DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.knowledge import LoopFacts
from servo_daemon.published.sinks import SinkState
from servo_daemon.published.snapshot import AlarmLimit, Event, ParameterEstimate, Snapshot
from servo_daemon.published.trends import DriveTrends
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: Value (a choice by its name) and 1 σ (None: not known) of parameters, in their units.
StartValues = Mapping[str, tuple[float | str, float | None]]


@dataclass(frozen=True, slots=True)
class ModelChange:
    """A model that a drive has now.

    Attributes:
        model: the effects.
        time: of the first estimate with it, UTC, seconds since the epoch; None: there have been no samples yet.
    """

    model: tuple[str, ...]
    time: float | None


class DriveView(Protocol):
    """One drive as the API sees it."""

    @property
    def name(self) -> str:
        """The drive's name in the configuration; part of the URL."""

    @property
    def driver(self) -> str:
        """The kind of driver: "simulated", "serial", "can", "replay", ..."""

    @property
    def model(self) -> tuple[str, ...]:
        """Names of the effects on top of the linear motor as they are now."""

    @property
    def meaning(self) -> SignalMeaning:
        """What its signals mean."""

    @property
    def initial_parameters(self) -> Sequence[ParameterEstimate]:
        """What is published before the first samples; see `initial_parameters` below."""

    @property
    def history(self) -> HistoryRing:
        """The last minutes of what was published."""

    @property
    def loop(self) -> LoopFacts:
        """What configuration and driver say of the control loop around it."""

    @property
    def limits(self) -> Sequence[AlarmLimit]:
        """Those of `[drive.limits]` whose alarms can ring with the model as it is now."""

    @property
    def trends(self) -> DriveTrends:
        """How its parameters age, as it was found last."""

    def snapshot(self) -> Snapshot:
        """The last published snapshot: the same object until the next one is published (answers are encoded once per
        object), a new one whenever anything in it changed, the connection included."""

    def newest(self) -> Snapshot:
        """The same for a client that may wait for the next one: one that asks ten times a second or more finds it
        fresher."""

    def events(self) -> Sequence[Event]:
        """The last events, oldest first, a bounded number; a copy or immutable."""

    def samples(self) -> Sequence[SampleBlock]:
        """The last samples as the estimators saw them (`[drive.estimation] ring_s`), tick by tick, oldest first."""

    def request_reset(self) -> None:
        """Ask the pipeline to forget what it learned and start from nominal; returns before it is done."""

    def request_model(self, effects: Sequence[str], start: StartValues) -> Future[ModelChange]:
        """Ask the pipeline to go over to another model while the drive runs, keeping what is known of the parameters
        that both models have; returns before it is done.

        Args:
            start: where parameters are to begin.

        Returns:
            done when the first estimate of the new model is published; with a ServoDaemonError if it came to nothing.

        Raises:
            ModelError: no drive can have this model.
            BusyError: another change is under way.
            RefusedError: the configuration does not allow it.
        """

    @property
    def diagnosis(self) -> DiagnosisView:
        """The last diagnosis, and whether one can be begun, or what it found adopted, now."""

    def request_diagnosis(self) -> None:
        """Begin a diagnosis of the last samples, in a process of its own; returns at once.

        Raises:
            BusyError: one is running, or there are too few samples yet.
            RefusedError: the configuration does not allow it.
        """


class DaemonView(Protocol):
    """The daemon as the API sees it."""

    @property
    def version(self) -> str:
        """Version of the program."""

    @property
    def started(self) -> float:
        """When it started: UTC, seconds since the epoch."""

    @property
    def drives(self) -> Mapping[str, DriveView]:
        """Drives by name, in the order of the configuration; a reload of that exchanges the whole mapping."""

    @property
    def archive(self) -> Archive | None:
        """What was published, for years; None: only the last minutes are kept."""

    @property
    def captures(self) -> Captures | None:
        """Kept recordings; None: none are kept."""

    @property
    def sinks(self) -> Sequence[SinkState]:
        """The broker and the webhooks that are sent to, in the order of the configuration."""

    def problems(self) -> Sequence[str]:
        """What is wrong with the daemon itself, in words (a pipeline that does not turn, a state directory that
        cannot be written); empty when healthy. A drive that is switched off is no problem of the daemon."""

    def stopping(self) -> bool:
        """True as soon as the daemon has been told to stop: open streams then end by themselves."""


def initial_parameters(parameters: Iterable[Parameter], nominal: Mapping[str, float]) -> tuple[ParameterEstimate, ...]:
    """What is published of a model's parameters before the first samples: the nominal value where one is given, no
    standard deviation, status "estimating"."""
    return tuple(
        ParameterEstimate(
            name=p.name,
            value=nominal.get(p.name),
            std=None,
            unit=p.unit,
            nominal=nominal.get(p.name),
            status="estimating",
            reason="no samples yet",
        )
        for p in parameters
    )
