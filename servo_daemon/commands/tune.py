"""`servo-daemon tune`: controller gains for the motor as it is, and what the gains in use are worth."""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands import common
from servo_daemon.config import DriveConfig
from servo_daemon.errors import BadInputError, TuningError
from servo_daemon.plant.effects import parameter_table
from servo_daemon.plant.parameters import LINEAR
from servo_daemon.service.snapshot import Covariance, Estimate, ParameterEstimate

if TYPE_CHECKING:
    from servo_daemon.captures import Capture
    from servo_daemon.tuning.knowledge import LoopSetup, MotorKnowledge

HELP = "controller gains for the motor as it is: PI speed loop, PID position loop, LQR, with their margins"
EXAMPLE = """  servo-daemon tune capture.csv --config servo-daemon.toml --bandwidth-hz 5
  servo-daemon tune --fix R=1.13,L=0.33e-3,K=60.3e-3,J=4e-5,B=3e-5 --rate-hz 2000 --settling-s 0.1 --tolerance 10%"""

#: Samples handed to the pipeline at once; the result does not depend on it.
_BLOCK_SAMPLES = 8192
#: Taken for the loop's rate where nobody says it, and told.
_ASSUMED_RATE_HZ = 1000.0
_TOLERANCE = re.compile(r"^(?:(?P<name>\w+)\s*=\s*)?(?P<percent>[0-9.]+(?:[eE][-+]?\d+)?)\s*%$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "capture", type=Path, nargs="?", metavar="CAPTURE", help="the motor today; without: the config's nominal values"
    )
    common.add_signals(parser)
    common.add_config(parser)
    asked = parser.add_mutually_exclusive_group()
    asked.add_argument("--bandwidth-hz", type=float, metavar="F", help="-3 dB bandwidth that each loop is to have")
    asked.add_argument("--settling-s", type=float, metavar="T", help="time until a small step stays within 2 %%")
    parser.add_argument(
        "--fix", action="append", default=[], metavar="P=v,…", help="values that are known, e.g. R=3.57,K=0.046 (SI)"
    )
    parser.add_argument(
        "--tolerance",
        default="",
        metavar="10%",
        help="worst case over nominal values ± this (or R=10%%,J=30%%); with a capture its covariance counts",
    )
    parser.add_argument("--rate-hz", type=float, metavar="F", help="samples a second of the controller")
    parser.add_argument("--delay-samples", type=float, metavar="N", help="from encoder to voltage (default: 1)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="tuning.json, controller.toml, bode.csv and step responses go there"
    )
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands import tune_output
    from servo_daemon.service.controller import loop_facts
    from servo_daemon.tuning.document import document
    from servo_daemon.tuning.knowledge import Ask
    from servo_daemon.tuning.report import tune

    drive = common.offline_drive(arguments)
    fixed, tolerance = parse_fix(",".join(arguments.fix)), parse_tolerance(arguments.tolerance)
    drive = drive.model_copy(update={"nominal": {**drive.nominal, **fixed}})
    capture = None
    if arguments.capture is not None:
        from servo_daemon.captures.plausible import check_time_unit, plausibility_notes

        (capture,) = common.read_captures([arguments.capture], arguments)
        check_time_unit(capture)
        for text in plausibility_notes(capture):
            common.note(f"{capture.path}: {text}")
    motor = _motor(drive, capture, fixed)
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


def estimate_capture(capture: Capture, drive: DriveConfig) -> Estimate:
    """The motor at the end of a capture: the daemon's own pipeline over it.

    Raises:
        BadInputError: the capture is too short to say anything.
    """
    from drivers.base import DriveInfo
    from servo_daemon.service.pipeline import Pipeline

    info = DriveInfo(
        identity="capture",
        sample_period_s=capture.sample_period_s,
        counts_per_rev=capture.counts_per_rev if capture.axis == "rotary" else None,
        channels=capture.channels,
    )
    pipeline = Pipeline(drive, info)
    with common.progress(capture.duration_s, "s", "estimating") as bar:
        for block in capture.blocks(_BLOCK_SAMPLES):
            pipeline.process(block, rows=False)
            bar.update(float(block.time_s[-1] - block.time_s[0]))
    estimate = pipeline.finish() or pipeline.current()
    if estimate is None:
        raise BadInputError(f"{capture.path}: too short to estimate anything from")
    return estimate


def fitted(capture: Capture, drive: DriveConfig, fixed: dict[str, float]) -> tuple[list[ParameterEstimate], Covariance]:
    """The motor as the mean over a capture: output error.

    Raises:
        BadInputError: the capture cannot be used.
    """
    from servo_daemon.estimators.output_error import FitOptions, Recording, fit_output_error

    nominal = {name: value for name, value in drive.nominal.items() if name != "J_m"}
    options = FitOptions(nominal=nominal, fixed=fixed)
    fit = fit_output_error([Recording(str(capture.path), capture.block())], drive.model, options)
    parameters = [
        ParameterEstimate(
            name,
            p.value,
            p.std,
            p.unit,
            nominal.get(name),
            "tracking" if p.std is not None else "estimating",
            "not determined by this capture" if p.status == "undetermined" else None,
        )
        for name, p in fit.parameters.items()
    ]
    known = [k for k, name in enumerate(fit.after.names) if fit.parameters[name].std is not None]
    names = tuple(fit.after.names[k] for k in known)
    rows = fit.after.covariance[known][:, known].tolist()
    return parameters, Covariance(names, tuple(tuple(row) for row in rows))


def _motor(drive: DriveConfig, capture: Capture | None, fixed: dict[str, float]) -> MotorKnowledge:
    """From the capture, else from nominal and fixed values.

    Raises:
        TuningError: R, L, K, J or B is missing; the text says where it may come from.
    """
    from servo_daemon.service.knowledge import motor_knowledge
    from servo_daemon.service.publish import published_parameters

    try:
        if capture is not None:
            e = estimate_capture(capture, drive)
            try:
                return motor_knowledge(e.parameters, e.covariance, e.model, e.state, "capture", fixed)
            except TuningError:  # too short for the daemon's filter, perhaps not for a fit
                parameters, covariance = fitted(capture, drive, fixed)
                return motor_knowledge(parameters, covariance, drive.model, {}, "capture", fixed)
        parameters = [
            ParameterEstimate(p.name, drive.nominal.get(p.name), None, p.unit, drive.nominal.get(p.name), "fixed")
            for p in published_parameters(drive)
        ]
        return motor_knowledge(parameters, None, drive.model, {}, "nominal", fixed)
    except TuningError as error:
        where = "--fix P=v or [drive.nominal] of --config give it"
        if capture is None:
            raise TuningError(f"{error}; a CAPTURE, {where}") from error
        raise TuningError(f"{capture.path}: {error}; {where}, or a capture with more motion") from error


def _setup(drive: DriveConfig, capture: Capture | None, arguments: argparse.Namespace) -> LoopSetup:
    """Timing: flag, then configuration, then the capture, then an assumption that is told."""
    from servo_daemon.service.controller import loop_facts

    for name in ("rate_hz", "delay_samples"):
        value, flag = getattr(arguments, name), f"--{name.replace('_', '-')}"
        if value is not None and not (0 <= value < 1e6 and (value > 0 or name == "delay_samples")):
            raise BadInputError(f"{flag} must be a positive number, not {value:g}")
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


def parse_fix(text: str) -> dict[str, float]:
    """'R=3.57,K=0.046' as numbers.

    Raises:
        BadInputError: not of that form, an unknown parameter, an impossible value.
    """
    table = parameter_table()
    values: dict[str, float] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, _, number = (piece.strip() for piece in part.partition("="))
        if name not in table:
            raise BadInputError(f"--fix: unknown parameter in {part!r}: known are {', '.join(table)}")
        if name in values:
            raise BadInputError(f"--fix: {name} is given twice")
        try:
            value = float(number)
        except ValueError:
            raise BadInputError(f"--fix: {part!r} is not of the form R=3.57") from None
        p = table[name]
        if not p.lower <= value <= p.upper:
            raise BadInputError(f"--fix: {name} = {number} {p.unit} is outside {p.lower:g} .. {p.upper:g}")
        values[name] = value
    return values


def parse_tolerance(text: str) -> dict[str, float]:
    """'10%', or 'R=10%,J=30%', as shares by name of R, L, K, J, B.

    Raises:
        BadInputError: not of that form, an unknown parameter, not between 0 and 100 %.
    """
    names = tuple(p.name for p in LINEAR)
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
