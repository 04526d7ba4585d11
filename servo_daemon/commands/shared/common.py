"""What several commands share: flags, the drive a config names, progress bars, one JSON document on stdout."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

from servo_daemon.config import DriveConfig, load_config
from servo_daemon.errors import BadInputError
from servo_daemon.published.snapshot import ParameterEstimate

if TYPE_CHECKING:
    from tqdm import tqdm

    from drivers.base import DriveInfo
    from servo_daemon.captures import Capture
    from servo_daemon.captures.capture.read_options import ReadOptions


D = TypeVar("D", bound=Mapping[str, Any])
#: Samples of a capture that are handed to the pipeline at once; the result does not depend on it.
BLOCK_SAMPLES = 8192
#: What a command's argument CAPTURE may be.
CAPTURE_HELP = "CSV, CSV.gz, Parquet, MAT, Excel, MDF, MCAP or a CAN log (BLF, ASC)"


def add_config(parser: argparse.ArgumentParser, *, required: bool = False, drive: bool = True) -> None:
    parser.add_argument("--config", type=Path, required=required, metavar="FILE", help="TOML configuration")
    if drive:
        parser.add_argument("--drive", metavar="NAME", help="which drive of the config (default: the first)")


def add_fix(parser: argparse.ArgumentParser, meaning: str) -> None:
    """`--fix`, whose texts go to `parse_fix` joined by commas."""
    parser.add_argument("--fix", action="append", default=[], metavar="P=v,…", help=meaning)


def parse_fix(text: str) -> dict[str, float]:
    """'R=3.57,K=0.046' as numbers within the parameters' bounds.

    Raises:
        BadInputError: not of that form, unknown parameter, given twice, impossible value.
    """
    from servo_daemon.plant.effects import parameter_table

    table, values = parameter_table(), dict[str, float]()
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, number = (s.strip() for s in part.partition("="))
        if not equals:
            raise BadInputError(f"--fix: {part!r} is not of the form R=3.57")
        if name not in table:
            what = "R, L, K, J, B and the effects' parameters are known"
            raise BadInputError(f"--fix: unknown parameter in {part!r}: there is no parameter {name!r}; {what}")
        if name in values:
            raise BadInputError(f"--fix: {name} is given twice")
        try:
            values[name] = table[name].read(number)
        except ValueError as error:
            raise BadInputError(f"--fix: {name} = {error}") from None
    return values


def keep_inputs(out: Path, *inputs: Path | None) -> None:
    """See that what is written takes the place of nothing that is read.

    Args:
        out: of `--out`.
        inputs: files the command reads; None: not given.

    Raises:
        BadInputError: it is one of them.
    """
    for path in inputs:
        if path is not None and out.exists() and path.exists() and out.samefile(path) and out.is_file():
            raise BadInputError(f"--out {out}: is {path} itself, which is read: choose another name")


def add_out(parser: argparse.ArgumentParser, meaning: str, *, metavar: str = "F", required: bool = False) -> None:
    """`--out`, and the `--force` that `may_overwrite` takes."""
    parser.add_argument("--out", type=Path, required=required, metavar=metavar, help=meaning)
    parser.add_argument("--force", action="store_true", help="overwrite what is there already")


def may_overwrite(force: bool, *outputs: Path) -> None:
    """See that no file is lost to `--out` unasked: on a terminal the user is asked. To be called before the work.

    Args:
        force: of `--force`.
        outputs: files that are going to be written.

    Raises:
        BadInputError: one of them is there, and nobody said that it may go.
    """
    there = [str(path) for path in outputs if path.is_file()]
    if force or not there:
        return
    exist = f"{' and '.join(there)} {'exists' if len(there) == 1 else 'exist'}"
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{exist}: overwrite? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
    raise BadInputError(f"{exist}: choose another --out, or --force to overwrite")


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print exactly one JSON document on stdout")


def add_signals(parser: argparse.ArgumentParser, *, rate: bool = True) -> None:
    """What a user tells of captures; without `--rate` where the command has another one of that name."""
    parser.set_defaults(capture_rate=None)
    if rate:
        parser.add_argument(
            "--rate",
            dest="capture_rate",
            type=float,
            metavar="HZ",
            help="the samples' rate, where the file has no time",
        )
    parser.add_argument(
        "--signals",
        type=Path,
        metavar="MAP.toml",
        help="which signal of the file is which column (docs/captures.md); for every capture given",
    )
    parser.add_argument(
        "--columns", metavar="NAME,…", help="names of a text table's columns, with units; '-' passes one over"
    )
    parser.add_argument("--counts-per-rev", type=float, metavar="N", help="of the encoder whose counts are in the file")
    parser.add_argument("--supply", metavar="V[/FULL]", help="volts of a duty cycle of 1, or of FULL (12/255)")
    parser.add_argument("--pole-pairs", type=float, metavar="N", help="where a file has the electrical speed only")
    parser.add_argument("--joint", metavar="NAME", help="which joint (drive) of an MCAP file that holds several")
    parser.add_argument(
        "--effort", choices=("current", "torque", "force"), help="what the effort of a ROS JointState is"
    )


def _read_options(arguments: argparse.Namespace) -> ReadOptions:
    from servo_daemon.captures.capture.read_options import ReadOptions, parse_supply

    names = (arguments.columns or "").split(",") if arguments.columns is not None else []
    supply_V, full_duty = (None, None) if arguments.supply is None else parse_supply(arguments.supply)
    return ReadOptions(
        tuple(name.strip() for name in names),
        arguments.capture_rate,
        arguments.counts_per_rev,
        supply_V,
        full_duty,
        arguments.pole_pairs,
        arguments.joint,
        arguments.effort,
    )


def read_captures(paths: Sequence[Path], arguments: argparse.Namespace) -> tuple[Capture, ...]:
    """The captures a command is given, through its `--signals`; their notes go to the user.

    Raises:
        BadInputError: a capture, the map, or a library for the kind of file; one line that names the place.
    """
    from servo_daemon.captures import load_signal_map, read_capture

    signal_map = None if arguments.signals is None else load_signal_map(arguments.signals)
    options = _read_options(arguments)
    captures = tuple(read_capture(path, signal_map, options) for path in paths)
    for capture in captures:
        for text in capture.notes:
            note(f"{capture.path}: {text}")
    return captures


def capture_info(capture: Capture) -> DriveInfo:
    """A capture as the pipeline knows a drive."""
    from drivers.base import DriveInfo

    return DriveInfo(
        identity="capture",
        sample_period_s=capture.sample_period_s,
        counts_per_rev=capture.counts_per_rev if capture.axis == "rotary" else None,
        channels=capture.channels,
    )


def offline_drive(arguments: argparse.Namespace) -> DriveConfig:
    """The drive whose name, nominal values, model, load and limits an offline command uses.

    Without a config nothing is nominal. The driver and its options are neither checked nor opened.

    Raises:
        ConfigError: the config is wrong, or has no such drive.
    """
    return load_config(arguments.config).drive_named(arguments.drive)


def print_json(document: Mapping[str, Any]) -> None:
    json.dump(document, sys.stdout, allow_nan=False, ensure_ascii=False)
    sys.stdout.write("\n")


def answer(arguments: argparse.Namespace, document: D, show: Callable[[D], None]) -> None:
    """Print the document: as one of JSON with `--json`, else as `show` does for a reader."""
    if arguments.json:
        print_json(document)
    else:
        show(document)


def note(text: str) -> None:
    """A remark for the user: on stderr, so that stdout stays a document."""
    print(text, file=sys.stderr)


def progress(total: float, unit: str, description: str) -> tqdm[Any]:
    """A progress bar on stderr, only where somebody watches."""
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, desc=description, disable=None, file=sys.stderr, leave=False, unit_scale=True)


def parameter_rows(parameters: tuple[ParameterEstimate, ...]) -> dict[str, dict[str, Any]]:
    """Parameters as in the REST contract."""
    keys = ("value", "std", "unit", "nominal", "status", "reason")
    return {p.name: {key: getattr(p, key) for key in keys} for p in parameters}


def has_terminal() -> bool:
    """Whether it runs in a terminal, whose end it should share: a service does not."""
    return any(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr))


def stop_signals() -> tuple[signal.Signals, ...]:
    """What asks a command that runs on to end in order: SIGTERM, Ctrl-C, and the terminal that is closed (unless
    `nohup` keeps that from it)."""
    hangup = () if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else (signal.SIGHUP,)
    return (signal.SIGTERM, signal.SIGINT, *hangup)


@contextmanager
def stop_requested() -> Iterator[Event]:
    """Set by `stop_signals`, so that work can end in order instead of anywhere."""
    event = Event()

    def stop(_signal: int, _frame: FrameType | None) -> None:
        event.set()

    previous = {number: signal.signal(number, stop) for number in stop_signals()}
    try:
        yield event
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
