"""Spans of time as tables: CSV and Parquet."""

from __future__ import annotations

import io
from collections.abc import Collection, Sequence
from typing import Any, Final, Literal

import numpy as np

from servo_daemon.api.past.documents import column, dominant
from servo_daemon.api.problems import ProblemError
from servo_daemon.api.times import iso_utc_list
from servo_daemon.errors import BadInputError
from servo_daemon.extras import require_pyarrow
from servo_daemon.numerics import milliseconds
from servo_daemon.published.archive import Span

Kind = Literal["json", "csv", "parquet"]
CSV: Final = "text/csv"
PARQUET: Final = "application/vnd.apache.parquet"
_KINDS: Final[dict[str, Kind]] = {
    CSV: "csv",
    PARQUET: "parquet",
    "application/x-parquet": "parquet",
    "application/json": "json",
    "application/*": "json",
    "*/*": "json",
}


def wanted(accept: str) -> Kind:
    """What an Accept header wants most of what there is; JSON where it wants nothing of it (RFC 9110, 12.5.1)."""
    best: tuple[float, Kind] = (0.0, "json")
    for part in accept.split(","):
        media, *parameters = (p.strip().lower() for p in part.split(";"))
        weight = 1.0
        for parameter in parameters:
            name, _, text = parameter.partition("=")
            if name.strip() == "q":
                try:
                    weight = float(text)
                except ValueError:
                    weight = 0.0
        if media in _KINDS and weight > best[0]:
            best = weight, _KINDS[media]
    return best[1]


def check_available(kind: Kind) -> None:
    """Raises: ProblemError: 406, Parquet without pyarrow."""
    if kind == "parquet":
        try:
            require_pyarrow(instead="ask for text/csv")
        except BadInputError as error:
            raise ProblemError(
                406, "no_parquet", f"The daemon cannot: {error}.", available=["application/json", CSV]
            ) from None


def encode(span: Span, names: Sequence[str], parameters: Collection[str], kind: Kind) -> tuple[bytes, str]:
    """The table as bytes, and their media type.

    Columns: `time`, then for each series P `P`, and of a parameter `P_std`, `P_status`; of buckets also `P_min`,
    `P_max`, `P_spread`, `P_count`. The same for every span of a level, whatever was there in it.

    Args:
        parameters: of `names`, those that are parameters where the span does not say it.
    """
    columns = _table(span, names, parameters)
    if kind == "parquet":
        return _parquet(span, columns), PARQUET
    lines = [",".join(["time", *columns])]
    texts = [[_text(value) for value in values] for values in columns.values()]
    lines += [",".join(row) for row in zip(iso_utc_list(span.buckets.time_s), *texts, strict=True)]
    return ("\n".join(lines) + "\n").encode(), f"{CSV}; charset=utf-8"


def _table(span: Span, names: Sequence[str], parameters: Collection[str]) -> dict[str, list[Any]]:
    b = span.buckets
    columns: dict[str, list[Any]] = {}
    nothing = [None] * len(b)
    for name in names:
        k = b.names.index(name) if name in b.names else None
        is_parameter = name in parameters if k is None else b.is_parameter[k]
        columns[name] = nothing if k is None else column(b.mean[:, k])
        if is_parameter:
            columns[f"{name}_std"] = nothing if k is None else column(b.std[:, k])
        if b.period_s or span.level != "rows":
            for key, values in (("min", b.low), ("max", b.high), ("spread", b.spread)):
                columns[f"{name}_{key}"] = nothing if k is None else column(values[:, k])
            columns[f"{name}_count"] = nothing if k is None else b.count[:, k].tolist()
        if is_parameter:
            columns[f"{name}_status"] = nothing if k is None else list(dominant(b, k))
    return columns


def _text(value: object) -> str:
    """A float as its shortest text that reads back as the same number."""
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def _parquet(span: Span, columns: dict[str, list[Any]]) -> bytes:
    arrow, parquet = require_pyarrow()
    shown_ms = milliseconds(span.buckets.time_s).astype("int64").tolist()
    arrays = [_arrow_array(arrow, arrow.timestamp("ms", tz="UTC"), shown_ms)]
    for name, values in columns.items():
        texts, whole = name.endswith("_status"), name.endswith("_count")
        kind = arrow.string() if texts else arrow.int64() if whole else arrow.float64()
        arrays.append(_arrow_array(arrow, kind, values))
    out = io.BytesIO()
    parquet.write_table(arrow.Table.from_arrays(arrays, names=["time", *columns]), out, compression="zstd")
    return out.getvalue()


def _arrow_array(arrow: Any, kind: Any, values: Sequence[Any]) -> Any:
    """Values of an Arrow type, None where there is none. Without `pyarrow.array`, which imports pandas, where that is
    installed, to ask whether it is one of its series: 40 MB and a second in the daemon."""
    valid = np.packbits(np.array([value is not None for value in values], bool), bitorder="little")
    if kind == arrow.string():
        texts = [(value or "").encode() for value in values]
        ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)  # of each text among the bytes of all
        parts = [ends, b"".join(texts)]
    else:
        dtype = np.float64 if kind == arrow.float64() else np.int64
        parts = [np.array([0 if value is None else value for value in values], dtype)]
    return arrow.Array.from_buffers(kind, len(values), [arrow.py_buffer(part) for part in (valid, *parts)])
