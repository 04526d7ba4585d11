"""`fleet.json`, and the same in a few lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from servo_daemon.commands.fleet.analysis import Fleet
from servo_daemon.commands.fleet.report import (
    counted_drives,
    drift_text,
    drifting,
    repeated,
    stranger_text,
    strangers,
    type_text,
    unread,
    untold,
)
from servo_daemon.commands.fleet.tables import prior_rows

#: Raised when a key changes its meaning.
SCHEMA = 1


def fleet_document(fleet: Fleet, asked: str) -> dict[str, Any]:
    """Everything about the fleet in plain types; each drive's own results are in `results/` and the Parquet files.

    Args:
        asked: the work and its flags.
    """
    return {
        "schema": SCHEMA,
        "asked": asked,
        "drives": len(fleet.documents),
        "failed": [{"drive": d["drive"], "error": d["error"]} for d in fleet.failed],
        "types": [
            {"text": type_text(fleet, group.tolist()), "drives": [fleet.documents[k]["drive"] for k in group]}
            for group in fleet.types
        ],
        "untold": untold(fleet),
        "unread": unread(fleet),
        "repeated": repeated(fleet),
        "common": [asdict(row) for row in prior_rows(fleet)],
        "causes": dict(sorted(fleet.causes.items(), key=lambda c: -c[1])) if fleet.diagnosed else None,
        "strangers": [
            {
                "drive": fleet.documents[k]["drive"],
                "text": stranger_text(fleet, k),
                "off": [{"parameter": n, "difference": d, "z": z} for n, d, z in fleet.deviations(k)],
                "effects": list(fleet.rare_effects(k)),
            }
            for k in strangers(fleet)
        ],
        "drifting": [
            {"drive": fleet.documents[k]["drive"], "text": drift_text(fleet, k, drift), **asdict(drift)}
            for k, drift in drifting(fleet)
        ],
        "seconds": float(np.sum([d["seconds"] for d in (*fleet.documents, *fleet.failed)])),
    }


def print_fleet(document: Mapping[str, Any]) -> None:
    """Print the summary on stdout."""
    print(f"{counted_drives(document['drives'])}, {len(document['failed'])} without a result")
    for row in document["common"]:
        spread = f"{row['spread']:.1%}" if row["logarithmic"] else f"{row['spread']:.3g} {row['unit']}"
        print(f"  {row['parameter']:4s} {row['value']:.5g} {row['unit']}, drives differ by {spread} (1 σ)")
    for row in document["types"]:
        print(f"  a type of its own: {row['text']}")
    if document["types"]:
        print("  a mean between types is no motor: run fleet on the captures of each")
    elif not document["common"]:
        print("  too few drives with values to tell what they have in common")
    for name, n in (document["causes"] or {}).items():
        print(f"  {name} in {n} of {document['drives']} drives")
    for title in ("strangers", "drifting"):
        for row in document[title]:
            print(f"  {'not like the others' if title == 'strangers' else 'drifts'}: {row['text']}")
    for text in document["untold"]:
        print(f"  with care: {text}")
    for text in (*document["unread"], *document["repeated"]):
        print(f"  left out: {text}")
    for row in document["failed"]:
        print(f"  no result: {row['drive']}: {row['error']}")
    if "model" in document:
        print(f"  {document['model']['model']}: learned from {document['model']['motors']} simulated motors")
