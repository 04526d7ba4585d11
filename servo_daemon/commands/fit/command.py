"""`servo-daemon fit`: careful offline identification of one capture or several."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.effect_flag import add_effect

if TYPE_CHECKING:
    from servo_daemon.commands.fit.inputs import Inputs
    from servo_daemon.identification import Identification

HELP = "identify a motor from captures: values, standard deviations, what the data do not determine"
EXAMPLE = """  servo-daemon fit capture.csv
  servo-daemon fit day1.csv day2.csv --effect coulomb_friction --validate day3.csv --adapt 0.3
  servo-daemon fit axis.csv.gz --method idim --effect coulomb_friction --effect constant_load_torque --json
  servo-daemon fit no_current.csv --fix R=3.57,K=0.046 --out report/"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE", help=common.CAPTURE_HELP)
    add_model(parser)
    add_validation(parser)
    parser.add_argument(
        "--method", choices=("output-error", "idim"), default="output-error", help="default: output-error"
    )
    parser.add_argument(
        "--segment", type=float, metavar="S", help="free runs of this length, each with its own initial state"
    )
    parser.add_argument("--no-robust", action="store_true", help="give isolated wrong samples full weight")
    common.add_out(parser, "write fit.json and report.html there", metavar="DIR")
    common.add_signals(parser)
    common.add_config(parser)
    common.add_json(parser)


def add_model(parser: argparse.ArgumentParser) -> None:
    """The flags that say which model is fitted."""
    add_effect(parser, "an effect beside the config's model, with start values")
    common.add_fix(parser, "parameters held at a value, e.g. R=3.57,K=0.046; repeatable")


def add_validation(parser: argparse.ArgumentParser) -> None:
    """`--validate` and `--adapt`."""
    parser.add_argument(
        "--validate",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        metavar="C",
        help="captures that are only scored",
    )
    parser.add_argument(
        "--adapt",
        type=float,
        metavar="SHARE",
        help="let friction and offsets settle on this first share of each validation capture, score the rest (0.3)",
    )


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.fit.document import fit_document
    from servo_daemon.commands.fit.inputs import check_validation, gather
    from servo_daemon.commands.fit.notes import drift_note, result_notes
    from servo_daemon.commands.fit.text import print_fit
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.identification import IdentifyOptions, identify
    from servo_daemon.identification.output_error import FitOptions

    if arguments.out is not None:
        common.may_overwrite(arguments.force, *(arguments.out / name for name in ("fit.json", "report.html")))
        OutputFolder(arguments.out).check_writable()  # what cannot be written should not be computed first
    inputs = gather(arguments, arguments.captures, arguments.validate)
    _check_segment(arguments.segment, inputs)
    check_validation(inputs, arguments.adapt)
    for text in inputs.notes:
        common.note(text)
    if arguments.method == "idim":
        return _idim(arguments, inputs)
    options = FitOptions(
        nominal=inputs.nominal, fixed=inputs.fixed, robust=not arguments.no_robust, segment_s=arguments.segment
    )
    result = identify(
        inputs.captures, inputs.validation, IdentifyOptions(inputs.effects, inputs.baseline, options, arguments.adapt)
    )
    found = result_notes(result.fit, {**inputs.nominal, **inputs.fixed}, inputs.meaning, inputs.captures[0])
    if result.drift is not None:
        found.append(drift_note(result.drift, result.fit, linear=result.captures[0].axis == "linear"))
    for text in found:
        common.note(text)
    document = {**fit_document(result, inputs.winding, inputs.meaning), "notes": [*inputs.notes, *found]}
    if arguments.out is not None:
        _write(arguments, result, document)
    if arguments.json:
        common.print_json(document)
    else:
        print_fit(document)
    return 0


def _check_segment(segment_s: float | None, inputs: Inputs) -> None:
    """Each free run has an initial state of its own, which some samples must tell.

    Raises:
        BadInputError: there are too few in a run of this length, s.
    """
    from servo_daemon.errors import BadInputError
    from servo_daemon.identification.output_error.problem.setup import FEWEST_SAMPLES

    if segment_s is None:
        return
    if not segment_s > 0.0:
        raise BadInputError(f"--segment must be greater than zero, not {segment_s:g}")
    for capture in inputs.captures:
        if segment_s < (shortest := (FEWEST_SAMPLES - 1) * capture.sample_period_s):
            least = f"{FEWEST_SAMPLES} samples, here {shortest:.3g} s"
            raise BadInputError(f"--segment {segment_s:g}: {capture.path}: a free run needs at least {least}")


def _idim(arguments: argparse.Namespace, inputs: Inputs) -> int:
    from servo_daemon.commands.fit.idim import idim_document
    from servo_daemon.commands.fit.text import print_fit
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.errors import BadInputError

    if arguments.adapt is not None or arguments.segment is not None:
        raise BadInputError("--adapt and --segment belong to --method output-error")
    document = idim_document(inputs)
    for text in document["notes"][len(inputs.notes) :]:
        common.note(text)
    if arguments.out is not None:
        OutputFolder(arguments.out).write_json("fit.json", document)
    if arguments.json:
        common.print_json(document)
    else:
        print_fit(document)
    return 0


def _write(arguments: argparse.Namespace, result: Identification, document: dict[str, Any]) -> None:
    """`fit.json` and `report.html` in the folder, which is made."""
    from servo_daemon.commands.fit.report import fit_report
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.report import make_provenance

    folder = OutputFolder(arguments.out)
    provenance = make_provenance(sys.argv[1:], [c.path for c in result.captures])
    folder.write_json("fit.json", document)
    folder.write_report("report.html", fit_report(result, document, provenance))
    common.note(f"{folder.path}/report.html")
