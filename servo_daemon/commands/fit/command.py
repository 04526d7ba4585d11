"""`servo-daemon fit`: careful offline identification of one capture or several."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.effect_flag import add_effect
from servo_daemon.commands.shared.numbers import positive

if TYPE_CHECKING:
    from servo_daemon.commands.fit.fitting import Fitted

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
        "--segment", type=positive, metavar="S", help="free runs of this length, each with its own initial state"
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
    from servo_daemon.commands.fit.fitting import fitted
    from servo_daemon.commands.fit.text import print_fit
    from servo_daemon.commands.shared.output_folder import OutputFolder

    if arguments.out is not None:
        common.may_overwrite(arguments.force, *(arguments.out / name for name in ("fit.json", "report.html")))
        OutputFolder(arguments.out).check_writable()  # what cannot be written should not be computed first
    made = fitted(arguments)
    if arguments.out is not None:
        _write(arguments, made)
    common.answer(arguments, made.document, print_fit)
    return 0


def _write(arguments: argparse.Namespace, made: Fitted) -> None:
    """`fit.json` and, of a fit by output error, `report.html` in the folder, which is made."""
    from servo_daemon.commands.fit.report import fit_report
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.report import make_provenance

    folder = OutputFolder(arguments.out)
    folder.write_json("fit.json", made.document)
    if made.result is not None:
        provenance = make_provenance(sys.argv[1:], [c.path for c in made.result.captures])
        folder.write_report("report.html", fit_report(made.result, made.document, provenance))
        common.note(f"{folder.path}/report.html")
