"""`servo-daemon export-history`: the history of a running daemon as a file."""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from servo_daemon.commands.shared import common, daemon_http
from servo_daemon.config_texts import UNIT_S
from servo_daemon.errors import BadInputError
from servo_daemon.extras import require_pyarrow
from servo_daemon.files import AtomicFile

HELP = "the history of a running daemon as CSV or Parquet"
EXAMPLE = """  servo-daemon export-history --drive axis1 --window 1y --out axis1.csv
  servo-daemon export-history --parameter R,K --level "1 min" --window 30d --out axis1.parquet"""

#: Rows that one request asks for: the daemon gives 20,000 at most, and neither side is to hold much more at once.
_ROWS: Final = 10_000
_PERIODS_S: Final = {"rows": 0.1, "1 s": 1.0, "1 min": 60.0, "1 h": 3600.0}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("url", nargs="?", default=daemon_http.URL, metavar="URL", help=f"default: {daemon_http.URL}")
    parser.add_argument("--drive", metavar="NAME", help="default: the first")
    parser.add_argument("--parameter", metavar="P,…", help="parameters and state channels (default: all parameters)")
    parser.add_argument("--window", default="1y", metavar="T", help="how far back: 30min, 7d, 1y (default)")
    parser.add_argument("--level", choices=tuple(_PERIODS_S), help="default: what gives at most 20,000 rows")
    common.add_out(parser, ".csv, .csv.gz or .parquet", required=True)
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out
    parquet = out.suffix == ".parquet"
    if not parquet and not out.name.endswith((".csv", ".csv.gz")):
        raise BadInputError(f"{out}: the name must end in .csv, .csv.gz or .parquet")
    common.may_overwrite(arguments.force, out)
    url, drive = arguments.url, arguments.drive
    drives = [d["name"] for d in daemon_http.document(url, "/drives")["drives"]]
    drive = drives[0] if drive is None else drive
    path = f"/drives/{quote(drive, safe='')}"
    names = arguments.parameter or ",".join(daemon_http.document(url, path + "/estimates")["parameters"])
    questions = list(_questions(arguments, names))
    with AtomicFile(out) as file:
        rows = (_write_parquet if parquet else _write_csv)(file, url, path + "/history", questions)
    if arguments.json:
        common.print_json({"drive": drive, "parameters": names.split(","), "rows": rows, "out": str(out)})
    else:
        print(f"{out}: {rows} rows of {names} of {drive}", file=sys.stderr)
    return 0


def _questions(arguments: argparse.Namespace, names: str) -> Iterator[dict[str, str | int]]:
    """Requests that follow each other in time: one for the level that suits, several for one that was chosen."""
    if arguments.level is None:
        yield {"parameter": names, "window": arguments.window, "points": 2 * _ROWS}
        return
    end = time.time()
    step = _ROWS * _PERIODS_S[arguments.level]
    start = (end - _seconds(arguments.window)) // step * step  # begins of buckets: none is in two requests
    while start < end:
        last = min(end, start + step - 0.5 * _PERIODS_S[arguments.level])
        span = {"start": f"{start:.3f}", "end": f"{last:.3f}"}
        yield {"parameter": names, **span, "level": arguments.level, "points": 2 * _ROWS}
        start += step


def _seconds(window: str) -> float:
    unit = window.lstrip("0123456789. ")
    try:
        return float(window.removesuffix(unit)) * UNIT_S[unit]
    except (KeyError, ValueError):
        raise BadInputError(f"--window {window!r}: a number with its unit, such as 30min or 1y") from None


def _write_csv(file: AtomicFile, url: str, path: str, questions: list[dict[str, str | int]]) -> int:
    rows, header = 0, b""
    for params in questions:
        first, _, rest = daemon_http.get(url, path, params, "text/csv").partition(b"\n")
        if not rest:
            continue
        if not header:
            file.write(first + b"\n")
        elif first != header:
            raise BadInputError(f"the columns change within the span; ask for fewer parameters: {first.decode()}")
        header = first
        file.write(rest)
        rows += rest.count(b"\n")
    return rows


def _write_parquet(file: AtomicFile, url: str, path: str, questions: list[dict[str, str | int]]) -> int:
    _, parquet = require_pyarrow()
    rows = 0
    writer: Any = None
    for params in questions:
        body = daemon_http.get(url, path, params, "application/vnd.apache.parquet")
        table = parquet.read_table(io.BytesIO(body))
        if writer is None and table.num_rows:
            writer = parquet.ParquetWriter(file.file, table.schema, compression="zstd")
        if writer is not None and table.num_rows:
            writer.write_table(table)
        rows += table.num_rows
    if writer is not None:
        writer.close()
    return rows
