"""Writing captures: a stream of blocks into CSV, gzipped CSV, Parquet or MCAP, chosen by the name's ending."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np

from servo_daemon.captures.capture.layout import make_layout
from servo_daemon.captures.capture.model import LINEAR_COLUMNS, Axis, capture_error
from servo_daemon.captures.kinds import Kind, kind_of, require_library
from servo_daemon.errors import CaptureError, ServoDaemonError
from servo_daemon.files import AtomicFile
from servo_daemon.samples import F64, Quality, SampleBlock

#: Samples that say "this is no measurement": a capture has no empty cells, so the whole sample is left out.
_INVALID = Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID

_LINEAR_NAMES = {field: name for name, field in LINEAR_COLUMNS.items()}
_KEY = re.compile(r"[\w.-]+")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]+")

#: Rows formatted at a time: bounds the memory of a long block's text (about 100 bytes a row).
_ROWS_AT_ONCE = 65536


class _Sink(Protocol):
    """Where checked columns go; made once the first block has told which columns there are."""

    def write(self, columns: Sequence[F64]) -> None: ...

    def finish(self) -> None: ...

    def abandon(self) -> None: ...


class CaptureWriter:
    """A capture written block by block; the file gets its name on `close`, so nobody ever sees half of it.

    As a context manager it closes, and so keeps, what was recorded, whatever exception ends the block. Python raises
    a signal's exception (KeyboardInterrupt, SIGTERM turned into SystemExit) between any two steps of the main thread,
    which would tear a row or a gzip stream in two: a thread of the writer's own does the writing. If writing itself
    fails (disk full), the file does not get its name, and the error says where the partial CSV is. Without a single
    sample no file appears.

    Args:
        path: ends in `.csv`, `.csv.gz`, `.parquet` or `.mcap`.
        metadata: written as `# key: value`; a value of several lines repeats its key.
        axis: "linear" names the columns force_N, position_m, velocity_m_s.
        kind: where the name has no such ending; None: it says it.

    Attributes:
        samples: samples written so far.
        samples_dropped: samples left out because they were not finite or flagged as no measurement.

    Raises:
        BadInputError: the ending or the metadata are wrong, the file cannot be created, or a library is missing.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        metadata: Mapping[str, str] | None = None,
        axis: Axis = "rotary",
        kind: Kind | None = None,
    ) -> None:
        self.path = Path(path)
        self.axis = axis
        self.samples = 0
        self.samples_dropped = 0
        self._metadata = _clean_metadata(self.path, metadata or {}, axis)
        self._kind = kind_of(self.path, kind)
        require_library(self.path, self._kind)
        self._keep_partial = self._kind == "csv"  # the others nobody can read without their footers
        self._output = AtomicFile(self.path)
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="capture-writer")
        self._sink: _Sink | None = None
        self._channels: tuple[str, ...] = ()
        self._last_time_s = -math.inf
        self._closed = False

    def write(self, block: SampleBlock) -> None:
        """Append a block.

        Raises:
            CaptureError: the channels are no usable set or differ from the first block's; or time does not increase
                against what was written (the device restarted): the samples before that are written.
            ServoDaemonError: the disk refuses.
        """
        if self._closed:
            raise ValueError(f"{self.path}: write after close")
        if not self._channels:
            self._check_columns(block.channels)
            self._channels = block.channels
        elif block.channels != self._channels:
            raise capture_error(self.path, f"channels changed from {self._channels} to {block.channels}")
        columns = self._good_columns(block)
        time_s = columns[0]
        before = np.concatenate(([self._last_time_s], time_s[:-1]))
        back = np.flatnonzero(time_s <= before)
        stop = int(back[0]) if back.size else len(time_s)
        if stop:
            self._worker.submit(self._append, [column[:stop] for column in columns]).result()
        if stop < len(time_s):
            message = f"time went from {before[stop]!s} s to {time_s[stop]!s} s after {self.samples} samples"
            raise capture_error(self.path, f"{message}: the device restarted, a capture cannot go on")

    def close(self) -> None:
        """Give the file its name; without samples, leave nothing. Idempotent.

        Raises:
            ServoDaemonError: the disk refuses.
        """
        if not self._closed:
            self._closed = True
            finished = self._worker.submit(self._finish)
            self._worker.shutdown(wait=False)
            finished.result()

    def discard(self) -> None:
        """Close without leaving anything."""
        if not self._closed:
            self._closed = True
            discarded = self._worker.submit(self._abandon)
            self._worker.shutdown(wait=False)
            discarded.result()

    def _names(self, channels: Sequence[str]) -> list[str]:
        names = ["time_s", *channels]
        return [_LINEAR_NAMES.get(name, name) for name in names] if self.axis == "linear" else names

    def _check_columns(self, channels: Sequence[str]) -> None:
        make_layout(self.path, self._names(channels), self._metadata)

    def _good_columns(self, block: SampleBlock) -> list[F64]:
        """Time and channels without the samples that are no measurements."""
        columns = [block.time_s, *(getattr(block, name) for name in self._channels)]
        good = (block.quality & _INVALID) == 0
        for column in columns:
            good &= np.isfinite(column)
        if good.all():
            return columns
        self.samples_dropped += int(len(block) - np.count_nonzero(good))
        return [column[good] for column in columns]

    def _append(self, columns: Sequence[F64]) -> None:
        """In the worker: write and count, one not without the other."""
        try:
            if self._sink is None:
                self._sink = self._make_sink()
            self._sink.write(columns)
        except (OSError, ServoDaemonError) as error:
            raise self._failure(error) from error
        self.samples += len(columns[0])
        self._last_time_s = float(columns[0][-1])

    def _make_sink(self) -> _Sink:
        names = self._names(self._channels)
        if self._kind == "mcap":
            from servo_daemon.captures.formats.mcap.writing import McapSink

            return McapSink(self._output.file, names, self._metadata)
        if self._kind == "parquet":
            from servo_daemon.captures.formats.parquet import ParquetSink

            return ParquetSink(self._output.file, names, self._metadata)
        return _CsvSink(self._output, names, self._metadata)

    def _finish(self) -> None:
        """In the worker, after every `_append`."""
        try:
            if self._sink is not None and self.samples:
                self._sink.finish()
                self._output.commit()
        except (OSError, ServoDaemonError) as error:
            raise self._failure(error) from error
        finally:
            self._output.discard()

    def _abandon(self, *, keep_partial: bool = False) -> None:
        if self._sink is not None:
            self._sink.abandon()
        self._output.discard(keep_partial=keep_partial)

    def _failure(self, error: OSError | ServoDaemonError) -> ServoDaemonError:
        self._closed = True
        self._worker.shutdown(wait=False)
        keep = self._keep_partial and self.samples > 0 and self._output.partial != self.path
        self._abandon(keep_partial=keep)
        if isinstance(error, OSError):
            error = self._output.failure(error)
        kept = f"; what was written until then is in {self._output.partial}" if keep else ""
        return ServoDaemonError(f"{error}{kept}")

    def __enter__(self) -> CaptureWriter:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()


class _CsvSink:
    def __init__(self, output: AtomicFile, names: Sequence[str], metadata: Mapping[str, str]) -> None:
        self._output = output
        lines = [f"# {key}: {line}" for key, value in metadata.items() for line in value.split("\n")]
        output.write("".join(f"{line}\n" for line in [*lines, ",".join(names)]).encode())

    def write(self, columns: Sequence[F64]) -> None:
        for text in _format_rows(columns):
            self._output.write(text)

    def finish(self) -> None:
        """Nothing to do: every row is written as it comes."""

    def abandon(self) -> None:
        """Nothing to release."""


def _format_rows(columns: Sequence[F64]) -> Iterator[bytes]:
    """CSV rows in the shortest decimals that read back as the same double (Python's repr; `%.17g` is longer and no
    faster). One formatting call a row is the quickest known way without a compiled formatter: almost all of it is
    repr itself."""
    row = (",".join(["%r"] * len(columns)) + "\n").__mod__
    for start in range(0, len(columns[0]), _ROWS_AT_ONCE):
        parts = [column[start : start + _ROWS_AT_ONCE].tolist() for column in columns]
        yield "".join(map(row, zip(*parts, strict=True))).encode()


def write_capture(
    path: Path | str, block: SampleBlock, *, metadata: Mapping[str, str] | None = None, axis: Axis = "rotary"
) -> None:
    """All of a block as one capture; nothing is left if it cannot be written completely.

    Raises:
        CaptureError: a value is not finite or flagged invalid, or the channels are no usable set.
        BadInputError, ServoDaemonError: as `CaptureWriter`.
    """
    writer = CaptureWriter(path, metadata=metadata, axis=axis)
    writer._keep_partial = False
    try:
        writer.write(block)
        if writer.samples_dropped:
            raise capture_error(writer.path, f"{writer.samples_dropped} samples are no measurements (NaN or flagged)")
        writer.close()
    except BaseException:
        writer.discard()
        raise


def _clean_metadata(path: Path, metadata: Mapping[str, str], axis: Axis) -> dict[str, str]:
    """Keys checked, values without control characters and blanks at the ends of their lines."""
    cleaned = {}
    for key, value in metadata.items():
        if not _KEY.fullmatch(key):
            raise CaptureError(f"{path}: metadata key {key!r}: only letters, digits, '_', '-' and '.'")
        lines = re.split(r"\r\n|\r|\n", str(value))
        cleaned[key] = "\n".join(_CONTROL.sub(" ", line).strip() for line in lines)
    return {"axis": "linear", **cleaned} if axis == "linear" else cleaned
