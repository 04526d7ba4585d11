"""Arrays as JSON: base64 of float32 around an offset, the gaps as a list. Nothing in it is NaN, in text or in bits."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from servo_daemon.numerics import runs_of
from servo_daemon.samples import F64

#: Largest error of rounding, as a part of the smallest distance between two x.
_ROUNDING = 0.01


def encode(values: F64, *, ordered: bool = False) -> dict[str, Any]:
    """One array, shape (n,), as the page's `decode` reads it.

    `{"data": base64, "offset": float, "gaps": [start, stop, start, stop, …]}`: little-endian float32 of `values -
    offset`, 0 where there is a gap, which is everything that is not finite. float32 resolves 6e-8 of half the
    range; `ordered` values (an x axis) that this would blur are float64, marked by `"wide": true`.
    """
    known = np.isfinite(values)
    finite = values[known]
    offset = float(0.5 * finite.min() + 0.5 * finite.max()) if finite.size else 0.0
    if np.all((finite == np.round(finite)) & (np.abs(finite) < 2**24)):
        offset = 0.0  # whole numbers (iterations, indices) stay whole
    if np.any(np.abs(finite) > 0.5 * np.finfo(np.float64).max):
        offset = 0.0  # at the edge of all numbers a rounded sum may be none
    shifted = np.where(known, np.where(known, values, 0.0) - offset, 0.0)
    wide = ordered and values.size > 1 and _blurred(shifted)
    if not wide and np.any(np.abs(shifted) > np.finfo(np.float32).max):
        wide = True
    document: dict[str, Any] = {
        "data": base64.b64encode(shifted.astype("<f8" if wide else "<f4").tobytes()).decode("ascii"),
        "offset": offset,
    }
    if wide:
        document["wide"] = True
    if not known.all():
        document["gaps"] = [edge for run in runs_of(~known) for edge in run]
    return document


def _blurred(values: F64) -> bool:
    error = float(np.max(np.abs(values - values.astype(np.float32))))
    return error > _ROUNDING * float(np.min(np.diff(values)))
