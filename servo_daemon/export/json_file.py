"""`--to json`: everything that the other targets are made of."""

from __future__ import annotations

import json
from dataclasses import asdict

from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import common_notes
from servo_daemon.plant.effects import effects_by_name

#: Raised when a key changes its meaning.
SCHEMA = 1


def write(model: ExportedModel) -> Export:
    """Every parameter of the model, null where it is not known."""
    v, i = model.meaning.factors
    notes = common_notes(model)
    document = {
        "schema": SCHEMA,
        "name": model.name,
        "source": model.source,
        "input": model.drive,
        "axis": "linear" if model.linear else "rotary",
        "model": list(model.effects),
        "parameters": {
            **{name: asdict(value) for name, value in model.values.items()},
            **{name: {"value": None, "std": None, "origin": why} for name, why in model.missing.items()},
        },
        "effects": {
            name: {"cause": e.cause, "equation": e.equation, "parameters": [p.name for p in e.parameters]}
            for name in model.effects
            for e in (effects_by_name()[name],)
        },
        "convention": {
            "convention": model.meaning.convention,
            "publish": model.meaning.publish if model.meaning.convention == "dq" else None,
            "pole_pairs": model.meaning.pole_pairs,
            "voltage_factor": v,
            "current_factor": i,
            "equivalents": model.meaning.equivalents(),
        },
        "gear_ratio": model.gear if model.gear_known else None,
        "limits": dict(model.limits),
        "notes": notes,
    }
    return Export((json.dumps(document, ensure_ascii=False, allow_nan=False, indent=1) + "\n").encode(), tuple(notes))


TARGET = Target("json", ".json", write)
