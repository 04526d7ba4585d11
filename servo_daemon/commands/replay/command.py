"""`servo-daemon replay`: the daemon's own pipeline over a capture, as fast as it goes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servo_daemon.commands.shared import common
from servo_daemon.numerics import sample_period
from servo_daemon.parameters import spaced
from servo_daemon.published.snapshot import ParameterEstimate

if TYPE_CHECKING:
    from servo_daemon.captures import Capture
    from servo_daemon.commands.replay.estimates_csv import EstimatesWriter
    from servo_daemon.config import DriveConfig
    from servo_daemon.learning.model.model import LearnedModel
    from servo_daemon.pipeline.pipeline import Pipeline
    from servo_daemon.published.snapshot import Estimate

HELP = "run the daemon's own pipeline over a capture, as fast as it goes"
EXAMPLE = """  servo-daemon replay capture.csv.gz --out estimates.csv
  servo-daemon replay capture.csv --out estimates.csv --config servo-daemon.toml --drive axis1
  servo-daemon replay measurement.mf4 --signals map.toml --out estimates.csv"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help=common.CAPTURE_HELP)
    common.add_signals(parser)
    common.add_out(parser, "estimates at 10 Hz of capture time", metavar="EST.csv", required=True)
    parser.add_argument(
        "--block",
        type=int,
        default=common.BLOCK_SAMPLES,
        metavar="N",
        help="samples at once (the result is the same)",
    )
    parser.add_argument(
        "--learned", type=Path, metavar="F", help="refresh with this RF+GRNN model (`train --out F`): columns grnn_*"
    )
    common.add_config(parser)
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.replay.estimates_csv import EstimatesWriter, is_estimates
    from servo_daemon.errors import BadInputError
    from servo_daemon.pipeline.pipeline import Pipeline
    from servo_daemon.pipeline.publish import published_names

    if arguments.block < 1:
        raise BadInputError(f"--block must be at least 1, not {arguments.block}")
    common.keep_inputs(arguments.out, arguments.capture, arguments.config, arguments.learned, arguments.signals)
    common.may_overwrite(arguments.force or is_estimates(arguments.out), arguments.out)
    drive = common.offline_drive(arguments)
    (capture,) = common.read_captures([arguments.capture], arguments)
    meaning = capture.meaning(drive.signals.meaning())
    pipeline = Pipeline(drive, common.capture_info(capture), meaning=meaning)
    names = published_names(drive)
    estimators: tuple[str, ...] = ("ekf", "rls")
    if arguments.learned is not None:
        pipeline.use_learned(_learned(arguments.learned, drive, capture))
        estimators = (*estimators, "grnn")
    with EstimatesWriter(arguments.out, names, estimators=estimators) as writer:
        rows, last = _replayed(capture, arguments.block, pipeline, writer)
    common.answer(arguments, _document(arguments.out, capture, rows, last), _print_table)
    return 0


def _replayed(capture: Capture, samples: int, pipeline: Pipeline, writer: EstimatesWriter) -> tuple[int, Estimate]:
    """Write what the pipeline makes of the capture. Returns the number of rows, and the last.

    Args:
        samples: that the pipeline gets at once.
    """
    last: Estimate | None = None
    rows = 0
    with common.progress(capture.duration_s, "s", "replay") as bar:
        for block in capture.blocks(samples):
            estimates = pipeline.process(block)
            for last in estimates:
                writer.write(last)
            rows += len(estimates)
            bar.update(float(block.time_s[-1] - block.time_s[0]))
        final = pipeline.finish()
        if final is not None:
            writer.write(final)
            last, rows = final, rows + 1
    assert last is not None  # a capture has at least two samples
    return rows, last


def _document(out: Path, capture: Capture, rows: int, last: Estimate) -> dict[str, Any]:
    """Where the estimates are, and the last of them."""
    return {
        "capture": str(capture.path),
        "out": str(out),
        "equivalents": {
            choice: {name: {"value": value, "std": std} for name, (value, std) in row.items()}
            for choice, row in last.equivalents.items()
        },
        "rows": rows,
        "samples": last.samples,
        "time_s": last.time_s,
        "model": list(last.model),
        "parameters": _rows(last.parameters, linear=capture.axis == "linear"),
        "health": dict(last.health),
    }


def _learned(path: Path, drive: DriveConfig, capture: Capture) -> LearnedModel:
    """Refused unless it was trained for a drive like this one."""

    from servo_daemon.learning.examples.drive import trainable
    from servo_daemon.learning.model.model_file import DriveIdentity, load_model

    block = capture.block()
    rate_hz = 1.0 / sample_period(block.time_s)
    return load_model(path, DriveIdentity(drive.model, drive.nominal, trainable(block.channels), rate_hz))


def _rows(parameters: tuple[ParameterEstimate, ...], *, linear: bool) -> dict[str, dict[str, Any]]:
    from servo_daemon.commands.shared.units import shown_unit

    rows = common.parameter_rows(parameters)
    for row in rows.values():
        row["unit"] = shown_unit(row["unit"], linear=linear)
    return rows


def _print_table(document: dict[str, Any]) -> None:
    common.note(f"{document['out']}: {document['rows']} rows; after {document['samples']:,} samples:")
    for name, p in document["parameters"].items():
        value = "—" if p["value"] is None else f"{p['value']:.6g}"
        std = "" if p["std"] is None else f" ± {p['std']:.2g}"
        reason = f"  ({p['reason']})" if p["reason"] else ""
        common.note(f"  {name:>6} = {value}{std}{spaced(p['unit'])}  {p['status']}{reason}")
