"""`servo-daemon compare`: the paper's three methods side by side."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servo_daemon.commands.fit.command import add_model
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.numbers import positive
from servo_daemon.learning import QUICK_MOTORS

if TYPE_CHECKING:
    from servo_daemon.config import DriveConfig
    from servo_daemon.identification.paper.compare import Comparison
    from servo_daemon.identification.paper.learned import ModelFor
    from servo_daemon.identification.paper.paper import PaperRedone
    from servo_daemon.learning.examples.drawing import TrainingSpec
    from servo_daemon.learning.model.model import LearnedModel

HELP = "the paper's three methods side by side, on a capture or on the paper's own numbers"
EXAMPLE = """  servo-daemon compare capture.csv --assumed-R 0.5
  servo-daemon compare capture.csv --config servo-daemon.toml --out report/
  servo-daemon compare --paper"""

#: Ω, what the paper assumes in its method 1.
PAPER_R = 1.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", type=Path, nargs="?", metavar="CAPTURE", help=common.CAPTURE_HELP)
    parser.add_argument("--paper", action="store_true", help="the paper's own numbers redone; needs no capture")
    parser.add_argument(
        "--assumed-R",
        type=positive,
        metavar="OHM",
        help=f"R for method 1, which cannot find it (the config's nominal R, else the paper's {PAPER_R})",
    )
    parser.add_argument(
        "--motors",
        type=int,
        default=QUICK_MOTORS,
        metavar="N",
        help="simulated motors that method 3 is trained on, unless a model of as many is kept from before "
        f"({QUICK_MOTORS}: some seconds; 0: leave method 3 out)",
    )
    add_model(parser)
    common.add_out(parser, "write compare.json and report.html there", metavar="DIR")
    common.add_signals(parser)
    common.add_config(parser)
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.compare.document import capture_document, paper_document
    from servo_daemon.commands.compare.text import print_compare
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.errors import BadInputError
    from servo_daemon.identification.paper.paper import redo

    if arguments.capture is None and not arguments.paper:
        raise BadInputError("a CAPTURE is needed, or --paper for the paper's own numbers")
    if arguments.out is not None:
        common.may_overwrite(arguments.force, *(arguments.out / name for name in ("compare.json", "report.html")))
        OutputFolder(arguments.out).check_writable()  # what cannot be written should not be computed first
    document: dict[str, Any] = {}
    paper = redo() if arguments.paper else None
    if paper is not None:
        document |= paper_document(paper)
    comparison = None if arguments.capture is None else _compare(arguments)
    if comparison is not None:
        document |= capture_document(comparison)
    if arguments.out is not None:
        _write(arguments, document, comparison, paper)
    common.answer(arguments, document, print_compare)
    return 0


def _compare(arguments: argparse.Namespace) -> Comparison:
    from servo_daemon.commands.fit.inputs import gather
    from servo_daemon.errors import BadInputError
    from servo_daemon.identification.output_error import FitOptions
    from servo_daemon.identification.paper.compare import compare_methods

    if arguments.motors < 0:
        raise BadInputError(f"--motors must not be negative, not {arguments.motors}")
    inputs = gather(arguments, [arguments.capture])
    for text in inputs.notes:
        common.note(text)
    R = arguments.assumed_R or inputs.fixed.get("R") or inputs.nominal.get("R") or PAPER_R
    return compare_methods(
        inputs.captures[0],
        assumed_R=R,
        effects=inputs.effects,
        options=FitOptions(nominal=inputs.nominal, fixed=inputs.fixed),
        model_for=_model_for(arguments.motors, _own_spec(arguments, inputs.drive)) if arguments.motors else None,
    )


def _own_spec(arguments: argparse.Namespace, drive: DriveConfig) -> TrainingSpec | None:
    """What `servo-daemon train` would train for the drive of the config; None without a config or a whole datasheet."""
    from servo_daemon.commands.train import drive_spec
    from servo_daemon.errors import ConfigError

    try:
        return None if arguments.config is None else drive_spec(drive)
    except ConfigError:
        return None


def _model_for(motors: int, own: TrainingSpec | None) -> ModelFor:
    """A kept model, or one trained now, with a progress bar."""
    from servo_daemon.commands.train import train_with_bar
    from servo_daemon.learning.model.cache import obtain_model
    from servo_daemon.learning.training.run import Job

    def find(spec: TrainingSpec) -> tuple[LearnedModel, str]:
        model, trained = obtain_model(spec, motors, lambda: train_with_bar(spec, Job(motors)), own)
        took = model.facts["simulation_s"] + model.facts["seconds"]
        now = f"trained now, in {took:.0f} s, and kept" if trained else "trained before"
        return model, f"{now}: {model.facts['motors_drawn']} simulated motors, {len(model.kept)} features"

    return find


def _write(
    arguments: argparse.Namespace,
    document: dict[str, Any],
    comparison: Comparison | None,
    paper: PaperRedone | None,
) -> None:
    """`compare.json` and `report.html` in the folder, which is made."""
    from servo_daemon.commands.compare.report import compare_report
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.report import make_provenance

    folder = OutputFolder(arguments.out)
    captures = [] if comparison is None else [comparison.capture.path]
    folder.write_json("compare.json", document)
    report = compare_report(document, comparison, paper, make_provenance(sys.argv[1:], captures))
    folder.write_report("report.html", report)
    common.note(f"{folder.path}/report.html")
