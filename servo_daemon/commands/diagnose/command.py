"""`servo-daemon diagnose`: what the simulation gets wrong, by name, with what it gains to put it right."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands.fit.command import add_model, add_validation
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.numbers import positive

if TYPE_CHECKING:
    from servo_daemon.commands.diagnose.diagnosing import Diagnosed

HELP = "find what the simulation of a motor lacks, name it, and measure on unseen data what it gains to add it"
EXAMPLE = """  servo-daemon diagnose capture.csv --out report/
  servo-daemon diagnose day1.csv day2.csv --config servo-daemon.toml --drive axis1 --out report/
  servo-daemon diagnose axis.csv.gz --effect coulomb_friction --validate other_day.csv.gz --adapt 0.3 --json
  servo-daemon diagnose no_current.csv --fix R=3.57,K=0.046 --out report/"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE", help=common.CAPTURE_HELP)
    add_model(parser)
    add_validation(parser)
    common.add_out(parser, "write diagnosis.json and report.html there", metavar="DIR")
    parser.add_argument(
        "--progress-json", action="store_true", help="progress as lines of JSON on stderr instead of a bar"
    )
    parser.add_argument(
        "--budget",
        type=positive,
        metavar="SECONDS",
        help="of processor time: then nothing more is tried, and the best so far is the answer",
    )
    parser.add_argument(
        "--journal",
        type=Path,
        metavar="FILE",
        help="keep what has been fitted there: the same command with the same captures goes on from it",
    )
    common.add_signals(parser)
    common.add_config(parser)
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.diagnose.diagnosing import diagnosed
    from servo_daemon.commands.diagnose.text import print_diagnosis
    from servo_daemon.commands.shared.output_folder import OutputFolder

    if arguments.out is not None:
        goes_on = arguments.journal is not None and arguments.journal.is_file()  # the same command once more
        common.may_overwrite(
            arguments.force or goes_on, *(arguments.out / name for name in ("diagnosis.json", "report.html"))
        )
        OutputFolder(arguments.out).check_writable()  # a minute's work should not end there
    made = diagnosed(arguments)
    if arguments.out is not None:
        _write(arguments, made)
    common.answer(arguments, made.document, print_diagnosis)
    return 0


def _write(arguments: argparse.Namespace, made: Diagnosed) -> None:
    """`diagnosis.json` and `report.html` in the folder."""
    from servo_daemon.commands.diagnose.report import diagnosis_report
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.report import make_provenance

    folder = OutputFolder(arguments.out)
    provenance = make_provenance(sys.argv[1:], [c.path for c in made.diagnosis.captures])
    report = diagnosis_report(made.diagnosis, made.evidence, made.document, provenance)
    folder.write_json("diagnosis.json", made.document)
    folder.write_report("report.html", report)
    common.note(f"{folder.path}/report.html")
