"""`servo-daemon fleet`: thousands of captures of many drives, on all cores or on a Dask cluster."""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.effect_flag import add_effect

if TYPE_CHECKING:
    from servo_daemon.commands.fleet.analysis import Fleet
    from servo_daemon.fleet.units import Unit

HELP = (
    "fit or diagnose the captures of many drives, and tell what they have in common and which are not like the others"
)
EXAMPLE = """  servo-daemon fleet fit captures/ --out fleet/
  servo-daemon fleet diagnose s3://bench/2026/ --out fleet/ --dask tcp://cluster:8786
  servo-daemon fleet train captures/ --out fleet/ --effect coulomb_friction"""
WHAT = {
    "fit": "each drive's parameters, with and without the other drives beside them",
    "diagnose": "the same with what each drive's simulation lacks",
    "train": "as fit, then the learned model (RF, GRNN) of this type of drive, from motors drawn around the fleet's",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=tuple(WHAT), help="; ".join(f"{name}: {text}" for name, text in WHAT.items()))
    parser.add_argument(
        "places",
        nargs="+",
        metavar="PLACE",
        help="captures, folders (each sub-folder a drive, else each capture one) or URLs that fsspec opens",
    )
    common.add_out(parser, "results; what is there already is not computed again", metavar="DIR", required=True)
    parser.add_argument("--drive-from", metavar="REGEX", help="its first group, found in a path, is the drive's name")
    parser.add_argument("--dask", metavar="ADDRESS", help="a Dask scheduler, e.g. tcp://host:8786 (else: this machine)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes on this machine (one a core)")
    add_effect(parser, "an effect beside the config's model")
    common.add_fix(parser, "parameters held at a value, e.g. K=0.046; repeatable")
    parser.add_argument("--budget", type=float, metavar="SECONDS", help="of processor time for each diagnosis")
    parser.add_argument("--motors", type=int, default=None, metavar="N", help="train: how many to simulate")
    common.add_signals(parser)
    common.add_config(parser)
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.fleet.analysis import analyse
    from servo_daemon.commands.fleet.document import fleet_document, print_fleet
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.errors import BadInputError
    from servo_daemon.fleet.units import find_units

    if arguments.workers is not None and arguments.workers < 1:
        raise BadInputError(f"--workers must be at least 1, not {arguments.workers}")
    OutputFolder(arguments.out).check_writable()
    asked = _asked(arguments)
    _check_folder(arguments, asked)
    units = find_units(arguments.places, arguments.drive_from)
    fleet = analyse(_documents(arguments, units, asked))
    document = fleet_document(fleet, asked)
    _write(arguments, fleet, document)
    if arguments.what == "train":
        if fleet.types:
            raise BadInputError(f"these captures are of {len(fleet.types)} types of motor: train on those of one")
        document["model"] = _train(arguments)
    common.answer(arguments, document, print_fleet)
    return 0 if fleet.documents else 1


def _asked(arguments: argparse.Namespace) -> str:
    """What is computed of each drive: results of another question are others."""
    from servo_daemon import __version__

    work = "diagnose" if arguments.what == "diagnose" else "fit"
    told = [path.read_bytes() for path in (arguments.config, arguments.signals) if path is not None and path.is_file()]
    content = [hashlib.sha256(b"\n".join(told)).hexdigest()[:12]] if told else []  # of the files that the flags name
    return shlex.join([work, __version__, *_flags(arguments), *content])


def _check_folder(arguments: argparse.Namespace, asked: str) -> None:
    """The same question goes on; results of another one are not lost unasked.

    Raises:
        BadInputError: such results are there.
    """
    path = arguments.out / "fleet.json"
    try:
        before = json.loads(path.read_text(encoding="utf-8")).get("asked")
    except (OSError, ValueError, AttributeError, RecursionError):
        before = None
    if before != asked:
        common.may_overwrite(arguments.force, path)


def _flags(arguments: argparse.Namespace) -> tuple[str, ...]:
    """What `fit` or `diagnose` is told on the workers."""
    flags: list[str] = []
    for effect in arguments.effect:
        flags += ["--effect", effect]
    for fix in arguments.fix:
        flags += ["--fix", fix]
    pairs = {
        "--config": arguments.config and arguments.config.resolve(),
        "--drive": arguments.drive,
        "--signals": arguments.signals and arguments.signals.resolve(),
        "--columns": arguments.columns,
        "--counts-per-rev": arguments.counts_per_rev,
        "--supply": arguments.supply,
        "--pole-pairs": arguments.pole_pairs,
        "--rate": arguments.capture_rate,
        "--budget": arguments.budget if arguments.what == "diagnose" else None,
    }
    for flag, value in pairs.items():
        if value is not None:
            flags += [flag, str(value)]
    return tuple(flags)


def _documents(arguments: argparse.Namespace, units: Sequence[Unit], asked: str) -> list[dict[str, Any]]:
    """Of all units, in their order; what was computed before is taken from the folder."""
    from servo_daemon.commands.fleet.work import diagnose_unit, fit_unit
    from servo_daemon.fleet.cluster import cluster, results
    from servo_daemon.fleet.kept import KeptResults

    work = diagnose_unit if arguments.what == "diagnose" else fit_unit
    kept = KeptResults(arguments.out / "results", asked)
    found = {unit: document for unit in units if (document := kept.get(unit)) is not None}
    left = [unit for unit in units if unit not in found]
    with common.progress(len(units), "drive", arguments.what) as bar:
        bar.update(len(found))
        try:
            if left:
                with cluster(arguments.dask, arguments.workers) as client:
                    for unit, document in results(client, left, work, _flags(arguments)):
                        whole = {"drive": unit.name, "captures": list(unit.captures), "seconds": 0.0, **document}
                        kept.put(unit, whole)
                        found[unit] = whole
                        bar.update(1)
        except KeyboardInterrupt:
            common.note(f"{len(found)} of {len(units)} drives are done: the same command goes on from there")
            raise
    return [found[unit] for unit in units]


def _write(arguments: argparse.Namespace, fleet: Fleet, document: dict[str, Any]) -> None:
    from servo_daemon.commands.fleet.report import fleet_report
    from servo_daemon.commands.fleet.tables import write_tables
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.report import make_provenance

    folder = OutputFolder(arguments.out)
    folder.write_json("fleet.json", document)
    write_tables(folder.path, fleet)
    folder.write_report("report.html", fleet_report(fleet, make_provenance(sys.argv[1:])))
    common.note(f"{folder.path}/report.html")


def _train(arguments: argparse.Namespace) -> dict[str, Any]:
    """The learned model of this type of drive, in `model.zip` beside the report.

    Raises:
        BadInputError: the fleet does not determine R, L, K, J and B.
    """
    from servo_daemon.commands.train import drive_spec, model_document, train_with_bar
    from servo_daemon.fleet.prior import FEWEST
    from servo_daemon.fleet.prior_file import nominal_of, read_prior, spread_of
    from servo_daemon.learning import DEFAULT_MOTORS
    from servo_daemon.learning.model.model_file import save_model
    from servo_daemon.learning.training.run import Job

    path = arguments.out / "fleet.parquet"
    prior = read_prior(path) if path.is_file() else ()
    if not prior:
        common.note(f"fewer than {FEWEST} drives tell what the type is: the nominal values of --config are taken")
    drive = common.offline_drive(arguments)
    drive = drive.model_copy(update={"nominal": {**drive.nominal, **nominal_of(prior)}})
    model = train_with_bar(drive_spec(drive, spread=spread_of(prior)), Job(arguments.motors or DEFAULT_MOTORS))
    out = arguments.out / "model.zip"
    save_model(model, out)
    return model_document(model, out)
