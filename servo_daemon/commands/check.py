"""`servo-daemon check`: validates a config, opens each driver, says what it sees."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.base import Driver
from servo_daemon.captures.columns.plausible import plausibility_notes
from servo_daemon.captures.driver import ReplayDriver
from servo_daemon.captures.meaning import as_meant, without_unusable
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.listening import heard
from servo_daemon.commands.shared.numbers import positive
from servo_daemon.config import DriveConfig, load_config
from servo_daemon.errors import CaptureError, DriverConfigError, DriverError, EndOfStreamError
from servo_daemon.parameters import WINDING_NAMES
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning, told
from servo_daemon.tracking.plan.signals import SignalPlan, plan_signals

HELP = "validate a config, open each driver and say what it sees"
EXAMPLE = "  servo-daemon check --config /etc/servo-daemon/servo-daemon.toml"

#: How long a drive is listened to, s: description frames come once a second.
_LISTEN_S = 3.0
#: What was held back somewhere, or is sent while a device starts, has arrived by then, s.
_SETTLED_S = 0.3
#: Less of the clock, s, tells nothing of how fast device time passes: what comes at once was held back.
_CLOCK_S = 0.5
#: Device time that passes so many times faster or more slowly than the clock is in another unit.
_CLOCK_FACTOR = 1.5
#: Drives whose time is their own business: a file, a simulation.
_NO_CLOCK = ("replay", "simulated")
#: What is taken for granted of a gear. No signal of a drive tells it.
_GEAR = (
    "gear_ratio {0:g}: turn by hand what the encoder is on, and the motor must turn {0:g} times "
    "(K goes with it, J and B with its square)"
)
#: Lines that cannot be read are remarked upon from this share of the samples on: those at the start are usual.
_UNREAD = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    parser.add_argument(
        "--listen", type=positive, default=_LISTEN_S, metavar="S", help="how long to listen to each drive"
    )
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Exit code 1 if a drive cannot be opened or says nothing; 2 if the configuration is wrong."""
    from drivers.registry import make_driver
    from servo_daemon.sinks import sinks_of

    config = load_config(arguments.config)
    drives = [(d, make_driver(d.driver, d.name, d.options)) for d in config.drive]  # all options, before any device
    for sink in sinks_of(config, (), None):  # extras and files; nothing is sent
        sink.stop(0.0)
    reports = [_look(drive, driver, arguments.listen) for drive, driver in drives]
    if arguments.json:
        common.print_json({"config": str(arguments.config), "drives": reports})
    else:
        for report in reports:
            print(_text(report))
    return 0 if all(r["samples"] for r in reports) else 1


@dataclass(frozen=True, slots=True)
class _Heard:
    """What a driver brought and said while it was listened to.

    Attributes:
        first, last: blocks; None: none came.
        settled: the last block of those that may have been held back.
        remark, unread: the driver's own words.
        problem: why there is nothing, or no more.
    """

    first: SampleBlock | None
    settled: SampleBlock | None
    last: SampleBlock | None
    remark: str | None
    unread: str | None
    problem: str | None

    @property
    def span_s(self) -> float:
        """Device time from the first sample to the last."""
        return 0.0 if self.first is None or self.last is None else float(self.last.time_s[-1] - self.first.time_s[0])


def _look(drive: DriveConfig, driver: Driver, listen_s: float) -> dict[str, Any]:
    """What one drive shows within `listen_s`.

    Raises:
        DriverConfigError: its options cannot work with this device.
    """
    came = _listen(driver, listen_s)
    counters = driver.counters
    channels = came.last.channels if came.last is not None else driver.info.channels
    meaning = drive.signals.meaning(driver.meaning)
    plan = _plan(channels, drive, meaning) if came.last is not None else None
    rate_hz = None if came.span_s <= 0 else (counters.samples - 1) / came.span_s
    return {
        "name": drive.name,
        "driver": drive.driver,
        "problem": came.problem,
        "identity": driver.info.identity,
        "channels": list(channels),
        "counts_per_rev": driver.info.counts_per_rev,
        "samples": counters.samples,
        "samples_lost": counters.samples_lost,
        "crc_errors": counters.crc_errors,
        "framing_errors": counters.framing_errors,
        "assumes": _assumptions(driver, drive, channels)
        + ([] if meaning == SignalMeaning() else [told(meaning, channels)]),
        "remarks": _remarks(driver, came) + _of_capture(driver, drive),
        "sample_rate_hz": rate_hz,
        "estimated": [] if plan is None else list(plan.free),
        "not_estimated": {} if plan is None else dict(plan.reasons),
    }


def _listen(driver: Driver, seconds: float) -> _Heard:
    """Open a driver and take what comes within so many seconds.

    Raises:
        DriverConfigError: its options cannot work with this device.
    """
    first = settled = last = remark = unread = problem = None
    silence = ""
    try:
        with driver:
            for block in heard(driver, seconds):
                first, last = first or block, block
                if block.host_time_s - first.host_time_s < _SETTLED_S:
                    settled = block
            remark, unread, silence = driver.remark, driver.unread, driver.silence
    except DriverConfigError:
        raise
    except EndOfStreamError:
        pass
    except DriverError as error:
        problem = str(error)
    if problem is None and last is None:
        problem = f"open, but no samples in {seconds:g} s ({driver.counters.framing_errors} framing errors)"
        problem += f"; {silence}" if silence else ""
    return _Heard(first, settled, last, remark, unread, problem)


def _plan(channels: tuple[str, ...], drive: DriveConfig, meaning: SignalMeaning) -> SignalPlan:
    """What will be estimated: where the filter follows the current R, L and K by the winding's balance, the rest as
    driven by it."""
    if not (meaning.follows_current and {"voltage_V", "current_A"} <= {*channels}):
        return plan_signals(channels, drive.model, drive.nominal)
    driven = tuple(c for c in channels if c != "voltage_V")
    plan = plan_signals(driven, drive.model, {"K": 1.0, **drive.nominal})
    if plan.plant is None:
        return plan
    own = WINDING_NAMES
    reasons = {name: why for name, why in plan.reasons.items() if name not in own}
    return replace(plan, free=(*own, *plan.free), reasons=reasons)


def _assumptions(driver: Driver, drive: DriveConfig, channels: tuple[str, ...]) -> list[str]:
    """What is taken for granted of the drive, with what the user can do to see whether it is so."""
    counts, gear = driver.info.counts_per_rev, drive.signals.gear_ratio
    turned = [] if gear in (None, 1.0) else [_GEAR.format(gear)]
    if not counts or "position_rad" not in channels:
        return turned
    turn = "turn the shaft once by hand and expect 6.28 rad"
    nominal = f"; nominal K = {drive.nominal['K']:g} and J, B are of the same shaft" if "K" in drive.nominal else ""
    return [f"{counts:,.10g} counts a turn: {turn}{nominal}", *turned]


def _remarks(driver: Driver, came: _Heard) -> list[str]:
    """What is odd though samples come."""
    found = [] if came.remark is None else [came.remark]
    first, last = came.settled, came.last
    if first is not None and last is not None and driver.kind not in _NO_CLOCK:
        clock_s, device_s = last.host_time_s - first.host_time_s, float(last.time_s[-1] - first.time_s[-1])
        if clock_s >= _CLOCK_S and not 1 / _CLOCK_FACTOR < device_s / clock_s < _CLOCK_FACTOR:
            found.append(_clock_remark(device_s / clock_s))
    counters = driver.counters
    if driver.learnt is not None:
        found.append(driver.learnt)
    if came.unread is not None and counters.framing_errors > _UNREAD * max(counters.samples, 1):
        found.append(f"{counters.framing_errors} lines could not be read: {came.unread}")
    return found


def _of_capture(driver: Driver, drive: DriveConfig) -> list[str]:
    """What `fit` says of a capture that is played: its numbers against the names of its columns."""
    if not isinstance(driver, ReplayDriver) or driver.capture is None:
        return []
    capture, found = as_meant(driver.capture, drive.signals.meaning(), limit_V=drive.limits.voltage_V)
    texts = [one.text for one in found]
    try:
        return [*texts, *plausibility_notes(without_unusable(capture, found))]
    except CaptureError:  # nothing is left of it, for a reason that is among these
        return texts


def _clock_remark(ratio: float) -> str:
    """What is said where device time passes `ratio` times as fast as the clock."""
    how, factor = ("fast", ratio) if ratio > 1.0 else ("slowly", 1.0 / max(ratio, 1e-9))
    unit = " (are its milliseconds called microseconds? t_ms is their name)" if how == "slowly" and factor > 300 else ""
    shown = f"{factor:,.0f}" if factor >= 10.0 else f"{factor:.2g}"
    return f"device time runs {shown} times too {how} against the clock{unit}: every estimate would be wrong"


def _text(report: dict[str, Any]) -> str:
    if report["problem"] is not None:
        return f"{report['name']} ({report['driver']}): {report['problem']}"
    rate = f", {report['sample_rate_hz']:.1f} samples a second" if report["sample_rate_hz"] else ""
    lines = [
        f"{report['name']} ({report['driver']}): {report['identity']}{rate}, {report['samples_lost']} lost",
        f"  signals: {', '.join(report['channels'])}",
        f"  estimated: {', '.join(report['estimated']) or 'nothing'}",
    ]
    lines += [f"  {name}: {why}" for name, why in report["not_estimated"].items()]
    lines += [f"  assumes {text}" for text in report["assumes"]]
    lines += [f"  WARNING: {text}" for text in report["remarks"]]
    return "\n".join(lines)
