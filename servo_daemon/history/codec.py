"""Buckets as bytes. `pack` is for what is kept: each series is rounded to what it tells, coded as differences and
compressed by itself, so that one can be read without the others. `dump` is for blocks that still grow: quick, and
nothing is rounded.

Rounding: a parameter's mean, low and high to a 16th of the smallest standard deviation in the block or less (that adds
0.02 % to its variance), a state channel's to a 1024th of its largest value. Low is rounded down and high up. Spread and
std keep 6 significant bits (1.6 %). Single rows of state channels are exact.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import milliseconds
from servo_daemon.published.buckets import STATUSES, Buckets
from servo_daemon.samples import F64

#: First byte: how the rest is written.
_PLAIN, _PACKED = b"P", b"C"
_STEPS_PER_STD: Final = 16.0
_STEPS_PER_RANGE: Final = 1024.0
#: zlib's level. On a day of minutes 9 saves 1 % over 6 and takes twice as long.
_LEVEL: Final = 6
#: Whole numbers of steps are kept in 32 bits; where a mean needs more it is kept as it is.
_MOST_STEPS: Final = 2.0**30
_FLOATS: Final = ("mean", "low", "high", "spread", "std")
#: Kind, length of the header, checksum of all that follows.
_HEAD = struct.Struct("<cII")


class BlockError(ValueError):
    """Bytes that are no block: damaged, or of a newer version."""


def dump(rows: Buckets) -> bytes:
    """Buckets or single rows as they are: 68 or 17 bytes a row and series."""
    header = json.dumps([len(rows), rows.period_s, rows.names, rows.units, rows.is_parameter], ensure_ascii=False)
    if rows.period_s == 0:
        parts = [rows.time_s, rows.mean, rows.std, _code(rows)]
    else:
        parts = [rows.time_s, *(getattr(rows, name) for name in _FLOATS), rows.count, rows.status]
    body = b"".join(np.ascontiguousarray(a).tobytes() for a in parts)
    return _framed(_PLAIN, header.encode(), body)


def _framed(kind: bytes, header: bytes, body: bytes) -> bytes:
    return _HEAD.pack(kind, len(header), zlib.crc32(body, zlib.crc32(header))) + header + body


def _code(rows: Buckets) -> NDArray[np.int8]:
    """Of single rows: the status's place in STATUS_BY_CODE."""
    codes: NDArray[np.int8] = (rows.status * np.arange(1, len(STATUSES) + 1)).sum(axis=2).astype(np.int8)
    return codes


def pack(rows: Buckets) -> bytes:
    """Buckets, or single rows, small."""
    raw = rows.period_s == 0
    # As where the API writes times: a row's does not change by being packed.
    ticks = milliseconds(rows.time_s) if raw else np.rint(rows.time_s / rows.period_s)
    bodies = [_squeeze(_differences(ticks.astype(np.int64)))]
    series: list[dict[str, Any]] = []
    for k, name in enumerate(rows.names):
        head, body = _pack_series(rows, k, raw)
        series.append({"name": name, "unit": rows.units[k], "size": len(body), **head})
        bodies.append(body)
    header = {"n": len(rows), "period_s": rows.period_s, "time": len(bodies[0]), "series": series}
    text = json.dumps(header, ensure_ascii=False).encode()
    return _framed(_PACKED, zlib.compress(text, _LEVEL), b"".join(bodies))


def unpack(data: bytes, names: Sequence[str] | None = None) -> Buckets:
    """The buckets.

    Args:
        names: the series that are wanted; None: all.

    Raises:
        BlockError: the bytes are damaged.
    """
    try:
        kind, size, checksum = _HEAD.unpack_from(data)
        header, body = data[_HEAD.size : _HEAD.size + size], memoryview(data)[_HEAD.size + size :]
        if zlib.crc32(body, zlib.crc32(header)) != checksum:
            raise BlockError("its checksum is wrong")
        if kind == _PLAIN:
            return _load(json.loads(header), body, names)
        if kind != _PACKED:
            raise BlockError(f"of unknown kind {kind!r}")
        return _unpack(json.loads(zlib.decompress(header)), body, names)
    except (struct.error, zlib.error, ValueError, KeyError, TypeError, IndexError) as error:
        raise BlockError(f"damaged: {error}") from error


def _load(header: list[Any], body: memoryview, wanted: Sequence[str] | None) -> Buckets:
    n, period_s, names, units, kinds = header
    shape, at = (n, len(names)), 0
    chosen = [k for k, name in enumerate(names) if wanted is None or name in wanted]
    names, units, kinds = ([column[k] for k in chosen] for column in (names, units, kinds))

    def take(dtype: type[np.generic], *more: int) -> NDArray[Any]:
        nonlocal at
        part = np.frombuffer(body, dtype, math.prod((*shape, *more)), at).reshape(*shape, *more)
        at += part.nbytes
        return part[:, chosen]

    time_s = np.frombuffer(body, np.float64, n)
    at = time_s.nbytes
    if period_s == 0:
        return Buckets.of_rows(time_s, names, units, kinds, take(np.float64), take(np.float64), take(np.int8))
    mean, low, high, spread, std = (take(np.float64) for _ in _FLOATS)
    count, status = take(np.int32), take(np.int32, len(STATUSES))
    return Buckets(
        period_s, time_s, tuple(names), tuple(units), tuple(kinds), count, mean, low, high, spread, std, status
    )


def _unpack(header: dict[str, Any], body: memoryview, names: Sequence[str] | None) -> Buckets:
    n, offset, period_s = int(header["n"]), int(header["time"]), float(header["period_s"])
    ticks = _sums(_expand(body[:offset], np.dtype(np.int64), (n,))).astype(float)
    wanted: list[dict[str, Any]] = []
    columns: list[tuple[NDArray[Any], ...]] = []
    for s in header["series"]:
        if names is None or s["name"] in names:
            wanted.append(s)
            columns.append(_unpack_series(s, body[offset : offset + s["size"]], n, period_s == 0))
        offset += s["size"]
    if wanted:
        count, mean, low, high, spread, std, status = (np.stack(c, axis=1) for c in zip(*columns, strict=True))
    else:  # the times alone: the drive ran, and had no such series
        mean = low = high = spread = std = np.empty((n, 0))
        count, status = np.empty((n, 0), np.int32), np.empty((n, 0, len(STATUSES)), np.int32)
    return Buckets(
        period_s,
        ticks / 1000.0 if period_s == 0 else ticks * period_s,
        tuple(s["name"] for s in wanted),
        tuple(s["unit"] for s in wanted),
        tuple(bool(s["parameter"]) for s in wanted),
        count,
        mean,
        low,
        high,
        spread,
        std,
        status,
    )


# -- one series ----------------------------------------------------------------------------------------------------


def _pack_series(rows: Buckets, k: int, raw: bool) -> tuple[dict[str, Any], bytes]:
    mean, low, high, count = rows.mean[:, k], rows.low[:, k], rows.high[:, k], rows.count[:, k]
    present = np.flatnonzero(rows.status[:, k].any(axis=0))
    step = None if raw and not rows.is_parameter[k] else _step(rows, k)
    head = {"parameter": rows.is_parameter[k], "step": step, "status": present.tolist()}
    known = np.isfinite(mean)
    parts: list[NDArray[Any]] = [_differences(count), np.packbits(known)]
    if step is None:
        shown = (mean,) if raw else (mean, low, high)
        parts += [_differences(np.ascontiguousarray(a).view(np.int64)) for a in shown]
    else:
        steps = _whole(np.where(known, mean / step, 0.0))
        parts.append(_differences(steps))
        if not raw:
            middle = steps.astype(float)
            parts.append(_differences(_whole(np.ceil(np.where(known, middle - low / step, 0.0) - 1e-9))))
            parts.append(_differences(_whole(np.ceil(np.where(known, high / step - middle, 0.0) - 1e-9))))
    if not raw:
        parts.append(_differences(_short(rows.spread[:, k])))
    if rows.is_parameter[k]:
        parts.append(_differences(_short(rows.std[:, k])))
        parts += [_differences(rows.status[:, k, s]) for s in present]
    return head, zlib.compress(b"".join(_shuffled(p) for p in parts), _LEVEL)


def _unpack_series(head: dict[str, Any], body: memoryview, n: int, raw: bool) -> tuple[NDArray[Any], ...]:
    data = zlib.decompress(body)
    at = 0

    def take(dtype: type[np.generic], length: int = n) -> NDArray[Any]:
        nonlocal at
        size = np.dtype(dtype).itemsize * length
        part = _unshuffled(data[at : at + size], np.dtype(dtype), length)
        at += size
        return part

    count = _sums(take(np.int32))
    known = np.unpackbits(take(np.uint8, (n + 7) // 8), count=n).astype(bool)
    step = head["step"]
    if step is None:
        mean = _sums(take(np.int64)).view(np.float64)
        low, high = (mean, mean) if raw else (_sums(take(np.int64)).view(float), _sums(take(np.int64)).view(float))
    else:
        steps = _sums(take(np.int32)).astype(float)
        mean = np.where(known, steps * step, np.nan)
        low = high = mean
        if not raw:
            low = np.where(known, (steps - _sums(take(np.int32))) * step, np.nan)
            high = np.where(known, (steps + _sums(take(np.int32))) * step, np.nan)
    counted = count > 0
    spread = np.where(counted, 0.0, np.nan) if raw else _long(_sums(take(np.uint16)))
    std = np.full(n, np.nan)
    status = np.zeros((n, len(STATUSES)), np.int32)
    if head["parameter"]:
        std = _long(_sums(take(np.uint16)))
        for s in head["status"]:
            status[:, s] = _sums(take(np.int32))
    return count, mean, np.where(counted, low, np.nan), np.where(counted, high, np.nan), spread, std, status


def _step(rows: Buckets, k: int) -> float | None:
    """The power of two to which a series' values are rounded; None: not at all."""
    shown = rows.mean[:, k]
    largest = float(np.max(np.abs(shown[np.isfinite(shown)]), initial=0.0))
    if rows.is_parameter[k]:
        std = rows.std[:, k]
        scale = float(np.min(std[std > 0], initial=np.inf)) / _STEPS_PER_STD
    else:
        ends = np.abs(np.concatenate([rows.low[:, k], rows.high[:, k]]))
        largest = max(largest, float(np.max(ends[np.isfinite(ends)], initial=0.0)))
        scale = largest / _STEPS_PER_RANGE
    if not 0.0 < scale < np.inf:
        return None
    step = float(2.0 ** np.floor(np.log2(scale)))
    reach = largest + float(np.nanmax(np.where(rows.count[:, k] > 0, rows.high[:, k] - rows.low[:, k], 0.0), initial=0))
    return step if step > 0 and reach / step < _MOST_STEPS else None


# -- numbers -------------------------------------------------------------------------------------------------------


def _whole(values: F64) -> NDArray[np.int32]:
    return np.rint(values).astype(np.int32)


#: Bits of a 32-bit float that `_short` leaves away.
_CUT: Final = 18


def _short(values: F64) -> NDArray[np.uint16]:
    """The upper bits of a 32-bit float that is not negative: exponent and 5 of the mantissa's bits, rounded."""
    known = np.isfinite(values)
    bits = np.where(known, values, np.nan).astype(np.float32).view(np.uint32)
    return np.where(known, (bits + np.uint32(1 << (_CUT - 1))) >> _CUT, 0x7FC00000 >> _CUT).astype(np.uint16)


def _long(upper: NDArray[np.uint16]) -> F64:
    return (upper.astype(np.uint32) << _CUT).view(np.float32).astype(float)


def _differences(values: NDArray[Any]) -> NDArray[Any]:
    """First value, then differences, modulo the type's range: `_sums` gives exactly the same values."""
    values = np.ascontiguousarray(values)
    out = values.copy()
    out[1:] -= values[:-1]
    return out


def _sums(differences: NDArray[Any]) -> NDArray[Any]:
    return np.cumsum(differences, dtype=differences.dtype)


def _shuffled(values: NDArray[Any]) -> bytes:
    """All lowest bytes first, then the next: bytes that are alike stand together, which zlib needs."""
    return values.view(np.uint8).reshape(len(values), -1).T.tobytes()


def _unshuffled(data: bytes, dtype: np.dtype[Any], n: int) -> NDArray[Any]:
    columns = np.frombuffer(data, np.uint8, n * dtype.itemsize).reshape(dtype.itemsize, n)
    return np.ascontiguousarray(columns.T).reshape(-1).view(dtype)


def _squeeze(values: NDArray[Any]) -> bytes:
    return zlib.compress(_shuffled(values), _LEVEL)


def _expand(body: memoryview, dtype: np.dtype[Any], shape: tuple[int]) -> NDArray[Any]:
    return _unshuffled(zlib.decompress(body), dtype, shape[0])
