"""A fleet's results as Parquet: `parameters.parquet`, `drives.parquet`, and `fleet.parquet`, its prior."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.commands.fleet.analysis import Fleet
from servo_daemon.fleet.prior_file import PriorRow, write_prior
from servo_daemon.fleet.tables import write_table
from servo_daemon.plant.effects import parameter_table


def write_tables(folder: Path, fleet: Fleet) -> None:
    """All three; a table without rows is not there: one of an earlier question would be taken for this one's.

    Raises:
        BadInputError: pyarrow is not installed, or a file cannot be written.
    """
    for name in ("parameters", "drives", "fleet"):
        (folder / f"{name}.parquet").unlink(missing_ok=True)
    for name, rows in (("parameters", parameter_rows(fleet)), ("drives", drive_rows(fleet))):
        if rows:
            write_table(folder / f"{name}.parquet", rows)
    if prior := prior_rows(fleet):
        write_prior(folder / "fleet.parquet", prior)


def parameter_rows(fleet: Fleet) -> list[dict[str, Any]]:
    """A row a drive and parameter: its own value, and that with the other drives beside it."""
    rows = []
    for k, document in enumerate(fleet.documents):
        off = {name: (difference, z) for name, difference, z in fleet.deviations(k)}
        drifts = {d.parameter: d for d in fleet.drifts[k]}
        for name, p in document["fit"]["parameters"].items():
            value, std = pooled_value(fleet, k, name)
            drift = drifts.get(name)
            rows.append(
                {
                    "drive": document["drive"],
                    "parameter": name,
                    "unit": p["unit"],
                    "value": p["value"],
                    "std": p["std"],
                    "status": p["status"],
                    "pooled_value": value,
                    "pooled_std": std,
                    "off_mean_z": off[name][1] if name in off else None,
                    "drift": None if drift is None else drift.change,
                    "drift_z": None if drift is None else drift.z,
                }
            )
    return rows


def pooled_value(fleet: Fleet, k: int, name: str) -> tuple[float | None, float | None]:
    """Value and standard deviation of a parameter of drive k, from its captures and the other drives."""
    if fleet.pooled is None or name not in fleet.names:
        return None, None
    j = fleet.names.index(name)
    mean, std = float(fleet.pooled.mean[k, j]), float(np.sqrt(fleet.pooled.cov[k, j, j]))
    if not fleet.logarithmic[j]:
        return mean, std
    return float(np.exp(mean)), float(np.exp(mean) * std)


def drive_rows(fleet: Fleet) -> list[dict[str, Any]]:
    """A row a drive, those without a result too."""
    rows = []
    for k, document in enumerate(fleet.documents):
        rows.append(
            _drive_row(document)
            | {
                "stranger": None if fleet.pooled is None else bool(fleet.pooled.stranger[k]),
                "drifts": ", ".join(d.parameter for d in fleet.drifts[k]),
                "verdict": document["diagnosis"]["verdict"] if "diagnosis" in document else None,
                "effects": ", ".join(fleet.effects_of(k)),
            }
        )
    empty = {"stranger": None, "drifts": "", "verdict": None, "effects": ""}
    return rows + [_drive_row(document) | empty for document in fleet.failed]


def _drive_row(document: Any) -> dict[str, Any]:
    return {
        "drive": document["drive"],
        "captures": len(document["captures"]),
        "seconds": document["seconds"],
        "error": document.get("error"),
    }


def prior_rows(fleet: Fleet) -> list[PriorRow]:
    """What a drive of this type is before anything is measured."""
    if fleet.pooled is None:
        return []
    prior, rows = fleet.pooled.prior, []
    for j, name in enumerate(fleet.names):
        log = fleet.logarithmic[j]
        value = float(np.exp(prior.mean[j]) if log else prior.mean[j])
        std = float(np.sqrt(prior.mean_cov[j, j])) * (value if log else 1.0)
        spread = float(np.sqrt(prior.between[j, j]))
        rows.append(PriorRow(name, parameter_table()[name].unit, value, std, spread, log, prior.n))
    return rows
