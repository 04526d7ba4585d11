"""`servo-daemon tune`: controller gains for the motor as it is, and what the gains in use are worth."""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands.shared import common
from servo_daemon.config import DriveConfig
from servo_daemon.errors import BadInputError
from servo_daemon.parameters import MOTOR_NAMES

if TYPE_CHECKING:
    from servo_daemon.captures import Capture
    from servo_daemon.tuning.knowledge import LoopSetup

HELP = "controller gains for the motor as it is: PI speed loop, PID position loop, LQR, with their margins"
EXAMPLE = """  servo-daemon tune capture.csv --config servo-daemon.toml --bandwidth-hz 5
  servo-daemon tune --fix R=1.13,L=0.33e-3,K=60.3e-3,J=4e-5,B=3e-5 --rate-hz 2000 --settling-s 0.1 --tolerance 10%"""

#: Taken for the loop's rate where nobody says it, and told.
_ASSUMED_RATE_HZ = 1000.0
_TOLERANCE = re.compile(r"^(?:(?P<name>\w+)\s*=\s*)?(?P<percent>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*%$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "capture", type=Path, nargs="?", metavar="CAPTURE", help="the motor today; without: the config's nominal values"
    )
    common.add_signals(parser)
    common.add_config(parser)
    asked = parser.add_mutually_exclusive_group()
    asked.add_argument("--bandwidth-hz", type=float, metavar="F", help="-3 dB bandwidth that each loop is to have")
    asked.add_argument("--settling-s", type=float, metavar="T", help="time until a small step stays within 2 %%")
    common.add_fix(parser, "values that are known, e.g. R=3.57,K=0.046 (SI); repeatable")
    parser.add_argument(
        "--tolerance",
        default="",
        metavar="10%",
        help="worst case over nominal values ± this (or R=10%%,J=30%%); with a capture its covariance counts",
    )
    parser.add_argument("--rate-hz", type=float, metavar="F", help="samples a second of the controller")
    parser.add_argument("--delay-samples", type=float, metavar="N", help="from encoder to voltage (default: 1)")
    common.add_out(parser, "tuning.json, controller.toml, bode.csv and step responses go there", metavar="DIR")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.tune import output as tune_output
    from servo_daemon.commands.tune.motor import known_motor
    from servo_daemon.pipeline.controller import loop_facts
    from servo_daemon.tuning.document import document
    from servo_daemon.tuning.knowledge import Ask
    from servo_daemon.tuning.report import tune

    if arguments.out is not None:
        common.may_overwrite(arguments.force, arguments.out / "tuning.json", arguments.out / "controller.toml")
    drive = common.offline_drive(arguments)
    fixed, tolerance = common.parse_fix(",".join(arguments.fix)), parse_tolerance(arguments.tolerance)
    drive = drive.model_copy(update={"nominal": {**drive.nominal, **fixed}})
    capture = None
    if arguments.capture is not None:
        from servo_daemon.captures.columns.plausible import check_time_unit, plausibility_notes
        from servo_daemon.commands.fit.inputs import check_length

        (capture,) = common.read_captures([arguments.capture], arguments)
        check_length(capture)
        check_time_unit(capture)
        for text in plausibility_notes(capture):
            common.note(f"{capture.path}: {text}")
    motor = known_motor(drive, capture, fixed)
    setup = _setup(drive, capture, arguments)
    facts = loop_facts(drive)
    asked = Ask(arguments.bandwidth_hz, arguments.settling_s)
    tuning = tune(motor, setup, facts.ask if asked == Ask() else asked, facts.log_nominal, tolerance)
    report = {
        "drive": drive.name,
        "capture": None if capture is None else str(capture.path),
        **document(tuning),
    }
    if arguments.out is not None:
        tune_output.write(arguments.out, tuning, report)
    if arguments.json:
        common.print_json(report)
    else:
        print(tune_output.text(tuning))
    return 0


def _setup(drive: DriveConfig, capture: Capture | None, arguments: argparse.Namespace) -> LoopSetup:
    """Timing: flag, then configuration, then the capture, then an assumption that is told."""
    from servo_daemon.pipeline.controller import loop_facts

    for name in ("rate_hz", "delay_samples"):
        value, flag = getattr(arguments, name), f"--{name.replace('_', '-')}"
        if value is not None and not (0 <= value < 1e6 and (value > 0 or name == "delay_samples")):
            what = "a positive number" if name == "rate_hz" else "a number and not negative"
            raise BadInputError(f"{flag} must be {what}, not {value:g}")
    counts = None if capture is None else capture.counts_per_rev
    facts = loop_facts(drive, counts)
    if arguments.delay_samples is not None:
        if arguments.delay_samples > 20:
            raise BadInputError(f"--delay-samples must be at most 20, not {arguments.delay_samples:g}")
        facts = replace(facts, delay_samples=arguments.delay_samples)
    if arguments.rate_hz is not None:
        return replace(replace(facts, rate_hz=arguments.rate_hz).setup(None), rate_source="given")
    if facts.rate_hz is None and capture is None:
        common.note(f"the loop's rate is not given (--rate-hz, [drive.controller]): {_ASSUMED_RATE_HZ:g} Hz is assumed")
        return replace(facts.setup(_ASSUMED_RATE_HZ), rate_source="assumed")
    return facts.setup(None if capture is None else 1.0 / capture.sample_period_s)


def parse_tolerance(text: str) -> dict[str, float]:
    """'10%', or 'R=10%,J=30%', as shares by name of R, L, K, J, B.

    Raises:
        BadInputError: not of that form, an unknown parameter, not between 0 and 100 %.
    """
    names = MOTOR_NAMES
    values: dict[str, float] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        match = _TOLERANCE.match(part)
        if match is None:
            raise BadInputError(f"--tolerance: {part!r} is not of the form 10% or R=10%")
        share = float(match["percent"]) / 100.0
        if not 0.0 < share < 1.0:
            raise BadInputError(f"--tolerance: {part!r} is not between 0 and 100 %")
        if match["name"] is not None and match["name"] not in names:
            raise BadInputError(f"--tolerance: unknown parameter in {part!r}: known are {', '.join(names)}")
        values |= dict.fromkeys(names if match["name"] is None else (match["name"],), share)
    return values
