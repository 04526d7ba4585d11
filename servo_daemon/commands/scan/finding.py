"""One drive that may be there: opened with its driver, read for a while, and what it showed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.base import Driver
from drivers.registry import make_driver
from drivers.vesc.polling import PolledVesc
from servo_daemon.commands.scan.presets import Preset, preset_of
from servo_daemon.commands.shared.listening import heard
from servo_daemon.errors import DriverError
from servo_daemon.samples import SampleBlock
from servo_daemon.tracking.plan.signals import plan_signals

#: A drive that answers has answered by then, s.
_FIRST_ANSWER_S = 2.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """A driver and the options with which it may find its drive.

    Attributes:
        asks: it sends requests.
        trial: options with which it is looked at; what they stand for only its user knows.
        missing: option -> what is to be put there.
    """

    driver: str
    options: dict[str, Any]
    asks: bool = False
    trial: Mapping[str, Any] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Finding:
    """A drive that is there.

    Attributes:
        options: with what was found out, so that the daemon need not.
        channels: empty where it sends no samples (yet); `remark` then says why.
        determined, undetermined: parameters of the linear motor, and why the latter cannot be known.
        nominal: parameters as the drive itself has them.
        missing: option -> what is to be put there; the drive does not tell.
    """

    driver: str
    identity: str
    options: dict[str, Any]
    channels: tuple[str, ...] = ()
    sample_rate_hz: float | None = None
    remark: str | None = None
    determined: tuple[str, ...] = ()
    undetermined: dict[str, str] = field(default_factory=dict)
    nominal: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)

    @property
    def toml(self) -> str:
        """The drive's table of a configuration; what is missing is a comment in it."""
        lines = ["[[drive]]", 'name = "axis1"', f'driver = "{self.driver}"', "[drive.options]"]
        lines += [f"{key} = {json.dumps(value)}" for key, value in self.options.items()]
        lines += [f"# {key} =    # needed: {what}" for key, what in self.missing.items()]
        if self.nominal:
            lines += ["[drive.nominal]", *(f"{name} = {value:.6g}" for name, value in self.nominal.items())]
        return "\n".join(lines)


def look(candidate: Candidate, seconds: float) -> Finding | str | None:
    """What a candidate shows in so many seconds: a finding; None: no such drive; a text: why that is not known."""
    driver = make_driver(candidate.driver, "scan", candidate.options | dict(candidate.trial))
    blocks: list[SampleBlock] = []
    try:
        with driver:
            blocks += heard(driver, min(seconds, _FIRST_ANSWER_S) if candidate.asks else seconds)
            if candidate.asks and driver.counters.frames:
                blocks += heard(driver, max(0.0, seconds - _FIRST_ANSWER_S))
            info, remark, options = driver.info, driver.remark or driver.unread, candidate.options | _found_out(driver)
        answered = candidate.asks and driver.counters.frames > 0
        preset = preset_of(candidate.driver, options) if answered else Preset()
    except DriverError as error:
        return str(error)
    options |= preset.options
    remark = "; ".join(filter(None, (remark, preset.remark))) or None
    if not blocks:
        there = isinstance(driver, PolledVesc) and driver.firmware is not None
        found = Finding(candidate.driver, info.identity, options, remark=remark, nominal=preset.nominal)
        return found if there else None
    span_s = float(blocks[-1].time_s[-1] - blocks[0].time_s[0])
    rate_hz = (driver.counters.samples - 1) / span_s if span_s > 0.0 else None
    plan = plan_signals(blocks[-1].channels, (), preset.nominal)
    free, reasons = list(plan.free), dict(plan.reasons)
    if "L" in free and driver.meaning is not None and driver.meaning.voltage == "instant":
        free.remove("L")
        reasons["L"] = "its voltage is that of an instant: what it does between samples, which L needs, is not seen"
    return Finding(
        candidate.driver, info.identity, options, blocks[-1].channels, rate_hz, remark, tuple(free), reasons,
        preset.nominal, candidate.missing,
    )  # fmt: skip


def _found_out(driver: Driver) -> dict[str, Any]:
    """Options that a driver has found by itself."""
    if not isinstance(driver, PolledVesc) or driver.shaft.source == "auto":
        return {}
    found: dict[str, Any] = {"position": driver.shaft.source}
    return found | ({"encoder_inverted": True} if driver.shaft.inverted else {})
