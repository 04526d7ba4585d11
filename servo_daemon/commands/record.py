"""`servo-daemon record`: a capture from a live driver."""

from __future__ import annotations

import argparse
import time
from threading import Event
from typing import TYPE_CHECKING, Any

from drivers.base import Driver
from servo_daemon.captures.kinds import KINDS, kind_of
from servo_daemon.commands.shared import common
from servo_daemon.errors import BadInputError, DriverError, DriverUnavailableError, EndOfStreamError
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning, as_texts

if TYPE_CHECKING:
    from tqdm import tqdm

    from servo_daemon.captures import CaptureWriter
    from servo_daemon.config import DriveConfig

HELP = "record a capture from a live driver"
EXAMPLE = "  servo-daemon record --config servo-daemon.toml --drive axis1 --seconds 60 --out bench.csv.gz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_config(parser, required=True)
    parser.add_argument(
        "--seconds", type=float, required=True, metavar="N", help="of device time, or of the clock if that is slower"
    )
    common.add_out(parser, ".csv, .csv.gz, .parquet or .mcap", required=True)
    parser.add_argument("--format", choices=KINDS, help="where the name has no such ending")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from drivers.registry import make_driver
    from servo_daemon.captures import CaptureWriter

    if not 0 < arguments.seconds < float("inf"):
        raise BadInputError(f"--seconds must be greater than 0, not {arguments.seconds:g}")
    drive = common.offline_drive(arguments)
    common.keep_inputs(arguments.out, arguments.config)
    common.may_overwrite(arguments.force, arguments.out)
    kind_of(arguments.out, arguments.format)
    driver = make_driver(drive.driver, drive.name, drive.options)
    problem: DriverError | None = None
    with common.stop_requested() as stop, driver:
        first = _next_block(driver, stop)
        if first is None:
            raise DriverError(f"drive {drive.name}: stopped before the first sample: nothing is recorded")
        with (
            CaptureWriter(arguments.out, metadata=_metadata(drive, driver), kind=arguments.format) as writer,
            common.progress(arguments.seconds, "s", "record") as bar,
        ):
            try:
                _copy(driver, first, writer, arguments.seconds, stop, bar)
            except EndOfStreamError as end:
                common.note(f"record: {end}")
            except DriverError as error:  # what was recorded until then is kept
                problem = error
    summary = f"{arguments.out}: {writer.samples:,} samples, {driver.counters.samples_lost} lost"
    if problem is not None:
        raise DriverError(f"{problem} ({summary})") from problem
    if arguments.json:
        common.print_json(
            {"capture": str(arguments.out), "samples": writer.samples, "samples_lost": driver.counters.samples_lost}
        )
    else:
        common.note(summary)
    return 0


def _metadata(drive: DriveConfig, driver: Driver) -> dict[str, str]:
    """Where the capture comes from and what its signals mean; of a driver that has brought samples, since only then
    it knows its device."""
    from servo_daemon import __version__

    metadata = {"generator": f"servo-daemon {__version__} record", "drive": drive.name, "driver": drive.driver}
    metadata |= {k: f"{v:g}" for k, v in drive.load.model_dump().items() if v is not None}
    metadata["identity"] = driver.info.identity
    meaning = drive.signals.meaning(driver.meaning)
    if meaning != SignalMeaning():
        metadata |= as_texts(meaning)
    if driver.info.counts_per_rev:
        metadata.setdefault("counts_per_rev", f"{driver.info.counts_per_rev:g}")
    return metadata


#: Device time that has not passed when so much of the clock has, s, is slower than any oscillator: in another unit.
_CLOCK_FACTOR, _CLOCK_SLACK_S = 1.1, 1.0


def _copy(
    driver: Driver, first: SampleBlock, writer: CaptureWriter, seconds: float, stop: Event, bar: tqdm[Any]
) -> None:
    """From `first` on until `seconds` of device time have passed, or as much of the clock.

    Raises:
        DriverError: of the driver; what was written until then stays.
    """
    block: SampleBlock | None = first
    start = float(first.time_s[0])
    deadline = time.monotonic() + _CLOCK_FACTOR * seconds + _CLOCK_SLACK_S
    while block is not None:
        inside = int((block.time_s - start < seconds).sum())
        if inside:
            writer.write(block.slice(0, inside))
        passed = float(block.time_s[-1]) - start
        bar.update(passed - bar.n)
        if inside < len(block):
            return
        if not driver.can_wait and time.monotonic() > deadline:
            common.note(f"record: ended by the clock: device time went on by {passed:.3g} s only")
            return
        block = _next_block(driver, stop)
    common.note("record: stopped early; what was recorded is kept")


#: A drive that says nothing for this long ends the recording, s.
_SILENCE_S = 10.0


def _next_block(driver: Driver, stop: Event) -> SampleBlock | None:
    """The next samples; None when told to stop.

    Raises:
        DriverUnavailableError: none within `_SILENCE_S`.
    """
    deadline = time.monotonic() + _SILENCE_S
    while time.monotonic() < deadline:
        if stop.is_set():
            return None
        block = driver.read(0.2)
        if block is not None:
            return block
    raise DriverUnavailableError(f"drive {driver.name}: no samples for {_SILENCE_S:g} s")
