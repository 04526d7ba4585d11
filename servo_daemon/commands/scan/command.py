"""`servo-daemon scan`: which drives are there, what they send, what that determines, and the TOML for them."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

from servo_daemon.commands.scan.bus import bus_options, on_bus
from servo_daemon.commands.scan.finding import Candidate, Finding, look
from servo_daemon.commands.scan.places import on_port
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.numbers import positive
from servo_daemon.errors import DriverConfigError, DriverError

HELP = "which drives are there, what they send, and the TOML for them"
EXAMPLE = """  servo-daemon scan                            # listens to every serial port of this machine
  servo-daemon scan --port /dev/ttyACM0 --ask  # also asks: reads only, of every make in turn
  servo-daemon scan --can socketcan:can0"""

#: How long each drive is looked at, and on a CAN bus at least, s: drivers listen 1.5 s before they decide what they
#: hear and how often it comes, and as long again twice where that is not clear.
_SECONDS, _LEAST_ON_CAN_S = 4.0, 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", action="append", default=[], metavar="P", help="serial port; repeatable")
    parser.add_argument("--can", action="append", default=[], metavar="INTERFACE:CHANNEL", help="CAN bus; repeatable")
    parser.add_argument("--bitrate", type=int, default=None, metavar="B", help="of the CAN bus, where it is set here")
    parser.add_argument(
        "--ask",
        action="store_true",
        help="also send requests (reads only): to serial ports, and to CANopen nodes that are heard",
    )
    parser.add_argument("--seconds", type=positive, default=_SECONDS, metavar="S", help="for each look (default: 4)")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Exit code 1 if no drive is found; 2 where a bus or a flag is wrong."""
    from drivers.serial.port import port_names

    buses = [bus_options(text, arguments.bitrate) for text in arguments.can]
    ports = arguments.port or ([] if buses else port_names())
    findings, remarks = [], []
    for port in ports:
        found, said = _first(on_port(port, arguments.ask, arguments.seconds), arguments.seconds)
        findings += found
        remarks += said or ([] if found else [_nothing_on(port, arguments.ask)])
    for options in buses:
        found, said = _on_bus(options, arguments.seconds, arguments.ask)
        findings += found
        remarks += said
    if arguments.json:
        common.print_json({"drives": [_document(f) for f in findings], "remarks": remarks})
    else:
        _print(findings, remarks or ([] if findings else ["there are no serial ports here; --can names a bus"]))
    return 0 if findings else 1


def _first(kinds: Iterator[list[Candidate | Finding]], seconds: float) -> tuple[list[Finding], list[str]]:
    """A port has one kind of drive: the first that is there. If it cannot be opened, it cannot be for the next."""
    try:
        for candidates in kinds:
            found, said = _looked_at(candidates, seconds)
            if found or said:
                return found, said
    except (DriverError, OSError) as error:
        return [], [str(error)]
    return [], []


def _looked_at(candidates: Sequence[Candidate | Finding | str], seconds: float) -> tuple[list[Finding], list[str]]:
    """What is there of these, and why of some it is not known."""
    results = [look(c, seconds) if isinstance(c, Candidate) else c for c in candidates]
    return [r for r in results if isinstance(r, Finding)], [r for r in results if isinstance(r, str)]


def _on_bus(options: dict[str, Any], seconds: float, ask: bool) -> tuple[list[Finding], list[str]]:
    where = f"{options['interface']}:{options['channel']}"
    try:
        found, said = _looked_at(on_bus(options, seconds, ask), max(seconds, _LEAST_ON_CAN_S))
    except DriverConfigError:
        raise
    except DriverError as error:
        return [], [str(error)]
    if not found and not said:
        said.append(f"{where}: no drive that is known here sends anything (are its cyclic messages switched on?)")
    return found, said


def _nothing_on(port: str, asked: bool) -> str:
    return f"{port}: nothing that is known here" + (" speaks or answers" if asked else " speaks; --ask asks as well")


def _document(finding: Finding) -> dict[str, Any]:
    return dataclasses.asdict(finding) | {"toml": finding.toml}


def _print(findings: list[Finding], remarks: list[str]) -> None:
    for finding in findings:
        rate = f", {finding.sample_rate_hz:.0f} samples a second" if finding.sample_rate_hz else ""
        print(f"# {finding.driver}: {finding.identity}{rate}")
        print(f"# sends: {', '.join(finding.channels) or 'no samples yet'}")
        if finding.channels:
            print(f"# determined: {', '.join(finding.determined) or 'nothing'}")
        for name, why in finding.undetermined.items():
            print(f"# {name}: {why}")
        if finding.remark is not None:
            print(f"# {finding.remark}")
        print(finding.toml + "\n")
    for remark in remarks:
        common.note(remark)
