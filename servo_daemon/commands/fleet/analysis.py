"""What the documents of many drives say together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from servo_daemon.fleet.prior import FEWEST, UNKNOWN, Pooled, pool
from servo_daemon.fleet.types import Group, types_of
from servo_daemon.plant.effects import parameter_table
from servo_daemon.samples import F64

#: Chance that any drive of a fleet that does not change is said to drift (Bonferroni over drives and parameters).
_FALSE_DRIFT = 0.01
#: A trend needs a residual: two captures always lie on a line.
_FEWEST_CAPTURES = 3
#: An effect that fewer drives have than this is a drive's own, not the type's.
_COMMON = 0.5

Document = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Drift:
    """A parameter that changes from a drive's first capture to its last, in the order of their names.

    `change` is a share of the value where `relative`, else in the parameter's unit; `z` its number of standard
    deviations.
    """

    parameter: str
    change: float
    std: float
    z: float
    relative: bool


@dataclass(frozen=True, slots=True)
class Fleet:
    """All drives with a result, in the order of `documents`.

    Attributes:
        names: parameters that enough drives determine to be pooled.
        logarithmic: shape (p,): pooled as logarithms.
        own, own_cov: coordinates of each drive's own values and their covariances, shape (n, p) and (n, p, p).
        types: numbers of the drives of each type, the largest first; none where they are of one.
        pooled: None where there are too few drives, or several types: a mean between them is no motor.
        drifts: of each drive.
        causes: how many drives have each effect, of those diagnosed.
        failed: documents without a result.
    """

    documents: tuple[Document, ...]
    names: tuple[str, ...]
    logarithmic: tuple[bool, ...]
    own: F64
    own_cov: F64
    types: tuple[Group, ...]
    pooled: Pooled | None
    drifts: tuple[tuple[Drift, ...], ...]
    causes: Mapping[str, int]
    failed: tuple[Document, ...]

    @property
    def diagnosed(self) -> bool:
        """Whether causes were looked for."""
        return any("diagnosis" in d for d in self.documents)

    def effects_of(self, k: int) -> tuple[str, ...]:
        """The effects that are named in drive k."""
        return effects_in(self.documents[k])

    def rare_effects(self, k: int) -> tuple[str, ...]:
        """Named in drive k and in fewer than half of all."""
        return tuple(e for e in self.effects_of(k) if self.causes[e] < _COMMON * len(self.documents))

    def deviations(self, k: int) -> list[tuple[str, float, float]]:
        """By how much drive k is off the fleet's mean: parameter, difference (a share where logarithmic), in standard
        deviations of what drives differ by and of its own value; the largest first."""
        if self.pooled is None:
            return []
        prior, rows = self.pooled.prior, []
        for j, name in enumerate(self.names):
            if self.own_cov[k, j, j] < UNKNOWN:
                d = float(self.own[k, j] - prior.mean[j])
                scale = float(np.sqrt(prior.between[j, j] + self.own_cov[k, j, j]))
                rows.append((name, float(np.expm1(d)) if self.logarithmic[j] else d, d / scale))
        return sorted(rows, key=lambda row: -abs(row[2]))


def effects_in(document: Document) -> tuple[str, ...]:
    """Names of the effects that a diagnosis found."""
    return tuple(e["name"] for e in document.get("diagnosis", {}).get("effects", ()))


def analyse(documents: Sequence[Document]) -> Fleet:
    """Pool what is determined, find what drifts and what is common."""
    documents = _without_repeated(documents)
    good = tuple(d for d in documents if "error" not in d)
    names = _pooled_names(good)
    logs = tuple(parameter_table()[n].transform == "log" for n in names)
    coordinates = [_coordinates(d["fit"], names, logs) for d in good]
    own = np.array([y for y, _ in coordinates]).reshape(len(good), len(names))
    cov = np.array([S for _, S in coordinates]).reshape(len(good), len(names), len(names))
    own = _filled(own, cov)
    types = types_of(own, cov, logs)
    return Fleet(
        good,
        names,
        logs,
        own,
        cov,
        types,
        pool(own, cov) if names and not types else None,
        _drifts(good),
        Counter(e for d in good for e in effects_in(d)),
        tuple(d for d in documents if "error" in d),
    )


def _without_repeated(documents: Sequence[Document]) -> list[Document]:
    """With an error for each drive whose captures are all those of another one: counted twice it would make the fleet
    surer than it is."""
    first: dict[tuple[str, ...], str] = {}
    out: list[Document] = []
    for d in documents:
        digests = tuple(sorted(d.get("digests", ())))
        same = first.setdefault(digests, d["drive"]) if digests else d["drive"]
        told = {key: d[key] for key in ("drive", "captures", "seconds")}
        out.append(d if same == d["drive"] else {**told, "error": f"the same capture as that of {same}: left out"})
    return out


def _known(row: Mapping[str, Any]) -> bool:
    """Whether a parameter's row holds an estimate of its own."""
    return row["status"] == "estimated" and row["value"] is not None and bool(row["std"])


def _pooled_names(documents: Sequence[Document]) -> tuple[str, ...]:
    counts: Counter[str] = Counter()
    for d in documents:
        counts.update(n for n, row in d["fit"]["parameters"].items() if n in parameter_table() and _known(row))
    return tuple(n for n, many in counts.items() if many >= FEWEST)


def _coordinates(fit: Document, names: Sequence[str], logs: Sequence[bool]) -> tuple[F64, F64]:
    """A drive's values and their covariance; NaN and `UNKNOWN` where it has none."""
    p = len(names)
    y, std = np.full(p, np.nan), np.full(p, np.sqrt(UNKNOWN))
    for k, (name, log) in enumerate(zip(names, logs, strict=True)):
        row = fit["parameters"].get(name)
        if row is not None and _known(row) and (not log or row["value"] > 0.0):
            y[k] = np.log(row["value"]) if log else row["value"]
            std[k] = row["std"] / row["value"] if log else row["std"]
    known = np.isfinite(y)
    # Where residuals are not white the standard deviations are wider than the likelihood, whose correlations these are.
    table = fit["correlation"] if fit.get("residual", {}).get("white") else {}
    correlation = np.eye(p)
    for a, name in enumerate(names):
        for b, other in enumerate(names):
            if a != b and known[a] and known[b]:
                correlation[a, b] = (table.get(name) or {}).get(other) or 0.0
    return y, correlation * np.outer(std, std)


def _filled(own: F64, cov: F64) -> F64:
    """Values with the others' median where a drive has none: with a variance of `UNKNOWN` any number will do."""
    if not own.size:
        return own
    missing = np.isnan(own)
    cov[np.isnan(own)[:, :, None] & np.isnan(own)[:, None, :] & np.eye(own.shape[1], dtype=bool)] = UNKNOWN
    return np.where(missing, np.nanmedian(own, axis=0), own)


def _drifts(documents: Sequence[Document]) -> tuple[tuple[Drift, ...], ...]:
    tests = sum(len(d["fit"]["parameters"]) for d in documents if len(d["each"]) >= _FEWEST_CAPTURES)
    least = float(norm.isf(0.5 * _FALSE_DRIFT / max(tests, 1)))
    return tuple(tuple(_drifts_of(d, least)) for d in documents)


def _drifts_of(document: Document, least: float) -> list[Drift]:
    found = []
    for name in document["fit"]["parameters"]:
        rows = [(k, f["parameters"][name]) for k, f in enumerate(document["each"]) if f and name in f["parameters"]]
        rows = [(k, row) for k, row in rows if _known(row)]
        if len(rows) < _FEWEST_CAPTURES or name not in parameter_table():
            continue
        log = parameter_table()[name].transform == "log"
        drift = _trend(name, rows, relative=log)
        if abs(drift.z) > least:
            found.append(drift)
    return found


def _trend(name: str, rows: Sequence[tuple[int, Mapping[str, Any]]], *, relative: bool) -> Drift:
    """Weighted least squares over the captures' order; what scatters beyond the standard deviations widens them."""
    at = np.array([k for k, _ in rows], float)
    value, std = (np.array([row[key] for _, row in rows]) for key in ("value", "std"))
    if relative:
        std, value = std / value, np.log(value)
    at -= at[0]
    A = np.column_stack([np.ones_like(at), at / at[-1]]) / std[:, None]
    cov = np.linalg.inv(A.T @ A)
    theta = cov @ A.T @ (value / std)
    left = value / std - A @ theta
    wide = np.sqrt(max(1.0, float(left @ left) / max(len(rows) - 2, 1)))
    error = float(wide * np.sqrt(cov[1, 1]))
    change = float(np.expm1(theta[1])) if relative else float(theta[1])
    return Drift(name, change, error, float(theta[1]) / error, relative)
