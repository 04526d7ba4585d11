"""`servo-daemon check`: validates a config, opens each driver, says what it sees."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

from drivers.base import Driver
from servo_daemon.commands import common
from servo_daemon.config import DriveConfig, load_config
from servo_daemon.errors import BadInputError, DriverConfigError, DriverError, EndOfStreamError
from servo_daemon.estimators.signals import plan_signals

HELP = "validate a config, open each driver and say what it sees"
EXAMPLE = "  servo-daemon check --config /etc/servo-daemon.toml"

#: How long a drive is listened to, s: description frames come once a second.
_LISTEN_S = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    parser.add_argument("--listen", type=float, default=_LISTEN_S, metavar="S", help="how long to listen to each drive")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Exit code 1 if a drive cannot be opened or says nothing; 2 if the configuration is wrong."""
    from drivers.registry import make_driver

    if not 0.0 < arguments.listen < math.inf:
        raise BadInputError(f"--listen must be greater than zero, not {arguments.listen:g}")
    config = load_config(arguments.config)
    drives = [(d, make_driver(d.driver, d.name, d.options)) for d in config.drive]  # all options, before any device
    reports = [_look(drive, driver, arguments.listen) for drive, driver in drives]
    if arguments.json:
        common.print_json({"config": str(arguments.config), "drives": reports})
    else:
        for report in reports:
            print(_text(report))
    return 0 if all(r["samples"] for r in reports) else 1


def _look(drive: DriveConfig, driver: Driver, listen_s: float) -> dict[str, Any]:
    """What one drive shows within `listen_s`.

    Raises:
        DriverConfigError: its options cannot work with this device.
    """
    problem: str | None = None
    first = last = None
    try:
        with driver:
            deadline = time.monotonic() + listen_s
            while time.monotonic() < deadline:
                block = driver.read(0.1)
                if block is not None:
                    first, last = first or block, block
    except DriverConfigError:
        raise
    except EndOfStreamError:
        pass
    except DriverError as error:
        problem = str(error)
    counters = driver.counters
    if problem is None and last is None:
        problem = f"open, but no samples in {listen_s:g} s ({counters.framing_errors} framing errors)"
    channels = last.channels if last is not None else driver.info.channels
    plan = plan_signals(channels, drive.model, drive.nominal) if last is not None else None
    span = 0.0 if first is None or last is None else float(last.time_s[-1] - first.time_s[0])
    return {
        "name": drive.name,
        "driver": drive.driver,
        "problem": problem,
        "identity": driver.info.identity,
        "channels": list(channels),
        "counts_per_rev": driver.info.counts_per_rev,
        "samples": counters.samples,
        "samples_lost": counters.samples_lost,
        "crc_errors": counters.crc_errors,
        "framing_errors": counters.framing_errors,
        "sample_rate_hz": None if span <= 0 else (counters.samples - 1) / span,
        "estimated": [] if plan is None else list(plan.free),
        "not_estimated": {} if plan is None else dict(plan.reasons),
    }


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
    return "\n".join(lines)
