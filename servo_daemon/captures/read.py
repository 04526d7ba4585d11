"""Reading captures: what kind of file it is, and who reads it."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path
from typing import BinaryIO

from servo_daemon.captures.capture.bounded import MAX_BYTES, MAX_LINE
from servo_daemon.captures.capture.model import Capture, capture_error
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.foreign import Recording
from servo_daemon.captures.columns.recording import assemble
from servo_daemon.captures.columns.signal_map import SignalMap, load_signal_map
from servo_daemon.captures.detect import is_asc, is_mat
from servo_daemon.captures.formats.mcap import MAGIC
from servo_daemon.captures.text.encoding import open_text
from servo_daemon.captures.text.preamble import read_preamble
from servo_daemon.captures.text.table import TableRecording, with_columns
from servo_daemon.errors import CaptureError

#: Bytes that tell what kind of file it is: MAT's mark is the last in its header of 128.
_HEAD = 128


def read_capture(
    path: Path | str, signal_map: SignalMap | Path | str | None = None, options: ReadOptions | None = None
) -> Capture:
    """A capture from a file; its content decides what kind of file it is, not its name.

    CSV, gzipped CSV and Parquet are the project's own (docs/captures.md). Text tables of any dialect, JSON lines, MAT
    files, Excel workbooks, MDF, MCAP and CAN logs (BLF, ASC) are read as well. Signals are understood by the names
    and units people give them; the signal map says it where they cannot be. `notes` tell what was understood and done.

    Channels may be missing: time_s with a
    motion (position or speed) and an effort (voltage, current, torque or force), or with voltage and current alone
    (their dynamics still hold R, L, B/J and K²/J), is usable.

    Args:
        path: the file; a pipe is fine.
        signal_map: which signal of the file is which column: a map or its TOML file. None: signals are named as in the
            contract, or as people name them.
        options: what the user tells beside a map.

    Raises:
        CaptureError: the file cannot be read or used; one line that names file, line (or row, sample) and column.
        ConfigError: the map is wrong.
        BadInputError: the library for this kind of file is not installed; the text names the extra.
    """
    path = Path(path)
    if isinstance(signal_map, Path | str):
        signal_map = load_signal_map(signal_map)
    try:
        with _open(path) as raw:
            head = raw.read(_HEAD)
            raw.seek(0)
            return _read_kind(path, raw, head, signal_map, options or ReadOptions())
    except CaptureError:
        raise
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise capture_error(path, f"the gzip file is cut off or damaged: {error}") from error
    except OSError as error:
        raise capture_error(path, f"cannot be read: {error.strerror or error}") from error


def _read_kind(path: Path, raw: BinaryIO, head: bytes, signal_map: SignalMap | None, options: ReadOptions) -> Capture:
    """What each kind of file is read by. The readers are imported here: each brings a library with it."""
    if head.startswith(b"PAR1"):
        from servo_daemon.captures.formats.parquet import read_parquet

        return read_parquet(path, raw, signal_map, options)
    if head.startswith(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"):
        raise capture_error(path, "an Excel file of the old kind (.xls): save it as .xlsx")
    if head.startswith((b"MDF     ", b"UnFinMF ")):
        from servo_daemon.captures.formats.mdf import read_mdf

        return read_mdf(path, raw, signal_map, options)
    if head.startswith(b"LOGG"):
        from servo_daemon.captures.formats.can_log import read_blf
        from servo_daemon.captures.formats.can_samples import decode_log

        return decode_log(read_blf(path, raw), signal_map)
    recording = _recording(path, raw, head, signal_map, options)
    if recording is not None:
        return assemble(recording, signal_map, options)
    return _read_text(path, raw, signal_map, options, packed=head.startswith(b"\x1f\x8b"))


def _recording(
    path: Path, raw: BinaryIO, head: bytes, signal_map: SignalMap | None, options: ReadOptions
) -> Recording | None:
    """The signals of a file that stays open meanwhile; None: it is none of these kinds."""
    if head.startswith(b"PK\x03\x04"):
        from servo_daemon.captures.formats.excel import read_excel

        return read_excel(path, raw, signal_map)
    if head.startswith(MAGIC):
        from servo_daemon.captures.formats.mcap.reading import read_mcap

        return read_mcap(path, raw, options if signal_map is None else None)
    if is_mat(head):
        from servo_daemon.captures.formats.mat import read_mat

        return read_mat(path, raw)
    return None


def _open(path: Path) -> BinaryIO:
    """The file, always seekable: a pipe is read into memory, because a bad file is read twice."""
    raw = path.open("rb")
    if raw.seekable():
        return raw
    with raw:
        data = raw.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise capture_error(path, f"more than {MAX_BYTES >> 20} MB through a pipe: cut the capture up")
    return io.BytesIO(data)


def _read_text(
    path: Path, raw: BinaryIO, signal_map: SignalMap | None, options: ReadOptions, *, packed: bool
) -> Capture:
    text, encoding = open_text(path, raw, packed=packed)
    with text:
        first = text.readline(MAX_LINE).lstrip()
        text.seek(0)
        if is_asc(first):
            from servo_daemon.captures.formats.can_log import read_asc
            from servo_daemon.captures.formats.can_samples import decode_log

            return decode_log(read_asc(path, text), signal_map)
        if first.startswith("[{") or first.strip() == "[":
            raise capture_error(path, "a JSON list: one object a line is expected (jq -c '.[]' makes it so)", line=1)
        if first.startswith("{"):
            from servo_daemon.captures.formats.json_lines import read_json_lines

            return assemble(read_json_lines(path, text), signal_map, options)
        preamble = read_preamble(path, text)
        table = TableRecording(path, text, with_columns(path, preamble, options), encoding)
        if signal_map is None and table.is_ours and options == ReadOptions():
            return table.as_it_is()
        return assemble(table, signal_map, options)
