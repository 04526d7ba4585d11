"""`servo-daemon export`: the identified motor, or its estimator, for other tools."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands.shared import common
from servo_daemon.config import load_config
from servo_daemon.errors import BadInputError
from servo_daemon.export.targets import NAMES

if TYPE_CHECKING:
    from servo_daemon.export.model import Export, ExportedModel

HELP = "the identified motor as a model for simulators, or its estimator in C for the drive's own processor"
EXAMPLE = """  servo-daemon export report/diagnosis.json --to mujoco --out motor.xml
  servo-daemon export fit.json --to python --out twin.py
  servo-daemon export --config servo-daemon.toml --drive axis1 --to c --out estimator.c
  servo-daemon export http://127.0.0.1:8077 --drive axis1 --to json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        nargs="?",
        metavar="SOURCE",
        help="fit.json, diagnosis.json or the address of a running daemon; without: the nominal values of --config",
    )
    parser.add_argument("--to", required=True, choices=NAMES, help="the tool that is to load it")
    common.add_config(parser)
    common.add_fix(parser, "values that are known, e.g. R=3.57,K=0.046 (SI); repeatable")
    parser.add_argument("--gear-ratio", type=float, metavar="N", help="turns of the motor for one of the output")
    parser.add_argument("--rate-hz", type=float, metavar="F", help="samples a second of the drive (--to c, --to fmu)")
    common.add_out(parser, "the file (default: stdout)", metavar="FILE")


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.export.targets import target

    chosen = target(arguments.to)
    out: Path | None = arguments.out
    if out is not None:
        common.may_overwrite(arguments.force, out)
        common.keep_inputs(out, arguments.config, *([Path(arguments.source)] if arguments.source else []))
    model = read(arguments)
    export = chosen.write(model)
    for name, why in model.missing.items():
        common.note(f"{name} is not known ({why}): it is not in the file")
    for text in export.notes:
        common.note(text)
    _put(out, export, arguments.force)
    return 0


def read(arguments: argparse.Namespace) -> ExportedModel:
    """The model that the command line names.

    Raises:
        BadInputError: it names none, or one that cannot be read.
    """
    from servo_daemon.commands.export import source

    given: str | None = arguments.source
    config = load_config(arguments.config) if arguments.config is not None else None
    if given is None and config is None:
        raise BadInputError("nothing to export: name a fit.json, a diagnosis.json or a daemon's address, or --config")
    if given is None:
        assert config is not None
        model = source.from_config(config.drive_named(arguments.drive), arguments.config)
    elif given.startswith(("http://", "https://")):
        model = source.from_daemon(given, arguments.drive, config)
    elif arguments.drive is not None and config is None:
        raise BadInputError(
            f"--drive {arguments.drive}: {given} is of one drive; it chooses among those of --config or of a daemon"
        )
    else:
        model = source.from_document(Path(given), arguments.drive, config)
    model = source.with_fixed(model, common.parse_fix(",".join(arguments.fix)))
    if (ratio := arguments.gear_ratio) is not None:
        try:
            model = replace(model, meaning=replace(model.meaning, gear_ratio=ratio), gear_known=True)
        except BadInputError as error:
            raise BadInputError(f"--gear-ratio: {error}") from None
    if (rate := arguments.rate_hz) is not None:
        if not 1.0 <= rate <= 1e6:
            raise BadInputError(f"--rate-hz must lie between 1 and 1e6, not {rate:g}")
        model = replace(model, sample_period_s=1.0 / rate)
    return model


def _put(out: Path | None, export: Export, force: bool) -> None:
    """The file and what belongs to it.

    Raises:
        BadInputError: several files or a binary one to stdout, or a file cannot be written.
    """
    from servo_daemon.files import AtomicFile

    if out is None:
        if export.beside or b"\0" in export.content:
            raise BadInputError("this target is more than a text: say --out FILE")
        sys.stdout.write(export.content.decode())
        return
    others = {out.with_name(name): content for name, content in export.beside.items()}
    if out in others:
        raise BadInputError(f"--out {out}: is the name of a file that goes with it: choose another")
    common.may_overwrite(force, *others)
    for path, content in {**others, out: export.content}.items():
        with AtomicFile(path) as file:
            file.write(content)
        common.note(str(path))
