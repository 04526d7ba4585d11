"""One drive that may be there: opened with its driver, read for a while, and what it showed."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

from drivers.base import Driver
from drivers.registry import make_driver
from drivers.vesc.polling import PolledVesc
from servo_daemon.commands.shared.listening import heard
from servo_daemon.errors import DriverError
from servo_daemon.tracking.plan.signals import plan_signals


@dataclass(frozen=True, slots=True)
class Candidate:
    """A driver and the options with which it may find its drive.

    Attributes:
        asks: it sends requests.
    """

    driver: str
    options: dict[str, Any]
    asks: bool = False


@dataclass(frozen=True, slots=True)
class Finding:
    """A drive that is there.

    Attributes:
        options: with what was found out, so that the daemon need not.
        channels: empty where it sends no samples (yet); `remark` then says why.
        determined, undetermined: parameters of the linear motor, and why the latter cannot be known.
    """

    driver: str
    identity: str
    options: dict[str, Any]
    channels: tuple[str, ...] = ()
    sample_rate_hz: float | None = None
    remark: str | None = None
    determined: tuple[str, ...] = ()
    undetermined: dict[str, str] = field(default_factory=dict)

    @property
    def toml(self) -> str:
        """The drive's table of a configuration."""
        lines = ["[[drive]]", 'name = "axis1"', f'driver = "{self.driver}"', "[drive.options]"]
        return "\n".join([*lines, *(f"{key} = {json.dumps(value)}" for key, value in self.options.items())])


def look(candidate: Candidate, seconds: float) -> Finding | str | None:
    """What a candidate shows in so many seconds: a finding; None: no such drive; a text: why that is not known."""
    driver = make_driver(candidate.driver, "scan", candidate.options)
    first = last = None
    try:
        with driver:
            for block in heard(driver, seconds):
                first, last = first or block, block
            info, remark, options = driver.info, driver.remark, candidate.options | _found_out(driver)
    except DriverError as error:
        return str(error)
    if first is None or last is None:
        there = isinstance(driver, PolledVesc) and driver.firmware is not None
        return Finding(candidate.driver, info.identity, options, remark=remark) if there else None
    span_s = float(last.time_s[-1] - first.time_s[0])
    rate_hz = (driver.counters.samples - 1) / span_s if span_s > 0.0 else None
    plan = plan_signals(last.channels, (), {})
    return Finding(
        candidate.driver, info.identity, options, last.channels, rate_hz, remark, tuple(plan.free), dict(plan.reasons)
    )


def _found_out(driver: Driver) -> dict[str, Any]:
    """Options that a driver has found by itself."""
    if not isinstance(driver, PolledVesc) or driver.shaft.source == "auto":
        return {}
    found: dict[str, Any] = {"position": driver.shaft.source}
    return found | ({"encoder_inverted": True} if driver.shaft.inverted else {})
