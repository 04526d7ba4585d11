"""What the API may see of the running daemon. The service implements these; the API knows nothing else.

Everything here is read by the API's event loop while the pipeline threads run: each method returns at once, takes no
lock for longer than a copy of a few columns, and hands out immutable records.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from servo_daemon.plant.parameters import Parameter
from servo_daemon.service.history import HistoryRing
from servo_daemon.service.knowledge import LoopFacts
from servo_daemon.service.snapshot import Event, ParameterEstimate, Snapshot


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
    def initial_parameters(self) -> Sequence[ParameterEstimate]:
        """What is published before the first samples; see `initial_parameters` below."""

    @property
    def history(self) -> HistoryRing:
        """The last minutes of what was published."""

    @property
    def loop(self) -> LoopFacts:
        """What configuration and driver say of the control loop around it."""

    def snapshot(self) -> Snapshot:
        """The last published snapshot: the same object until the next one is published (answers are encoded once per
        object), a new one whenever anything in it changed, the connection included."""

    def events(self) -> Sequence[Event]:
        """The last events, oldest first, a bounded number; a copy or immutable."""

    def request_reset(self) -> None:
        """Ask the pipeline to forget what it learned and start from nominal; returns before it is done."""


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
        """Drives by name, in the order of the configuration; fixed while the daemon runs."""

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
