"""`fit --method idim`: inverse-dynamic least squares, in the document of `fit`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.commands.fit.document import score_row
from servo_daemon.commands.fit.inputs import Inputs
from servo_daemon.identification.inverse_dynamics.estimate import Estimate
from servo_daemon.identification.inverse_dynamics.fit import InverseDynamics, identify_inverse_dynamics
from servo_daemon.identification.output_error.problem.score import score
from servo_daemon.identification.output_error.problem.setup import choose_signals
from servo_daemon.kalman.gaussian import coordinates_of
from servo_daemon.plant.build import build_plant

#: Neighbouring filtered rows of noise are not correlated by more.
_WHITE = 0.2
_EFFORT = {"N·m": "torque_Nm", "N": "force_N", "A": "current_A", "V": "voltage_V"}


def idim_document(inputs: Inputs) -> dict[str, Any]:
    """Identify and put it as `fit_document` does; `std_white` is the deviation the literature gives."""
    began = time.perf_counter()
    axis = inputs.captures[0].axis
    result = identify_inverse_dynamics([c.block() for c in inputs.captures], inputs.effects, inputs.fixed, axis=axis)
    seconds = time.perf_counter() - began
    rows = _parameters(result, inputs.fixed)
    residuals = {_EFFORT[r.unit]: r for r in result.residuals.values()}
    return {
        "method": "idim",
        "captures": [str(c.path) for c in inputs.captures],
        "model": list(inputs.effects),
        "parameters": rows,
        "offsets": [],
        "correlation": _correlation(result),
        "null_directions": [
            {"components": dict(d), "exact": True, "text": _null_text(d)} for d in result.null_directions
        ],
        "combinations": [],
        "iterations": [],
        "converged": True,
        "start": "none needed",
        "filters": {name: _filter_row(f) for name, f in result.filters.items()},
        "residual": {
            "rmse": {name: float(np.sqrt(np.mean(r.residual**2))) for name, r in residuals.items()},
            "white": all(abs(r.autocorrelation) < _WHITE for r in residuals.values()),
            "relative_error": {name: r.relative_error for name, r in residuals.items()},
        },
        "validation": [_validation(c, rows, inputs.effects) for c in inputs.validation],
        "notes": [*inputs.notes, *result.notes],
        "seconds": seconds,
    }


def _parameters(result: InverseDynamics, fixed: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    def row(e: Estimate, status: str) -> dict[str, Any]:
        known = status == "estimated"
        return {
            "value": e.value if known else None,
            "std": e.std if known else None,
            "std_white": e.std_white if known else None,
            "unit": e.unit,
            "at_bound": False,
            "status": status,
        }

    rows = {name: row(e, "fixed" if name in fixed else "estimated") for name, e in result.parameters.items()}
    for name, value in fixed.items():
        if name in rows:
            rows[name]["value"] = value
    return rows | {name: row(e, "undetermined") for name, e in result.undetermined.items()}


def _correlation(result: InverseDynamics) -> dict[str, dict[str, float]]:
    names = result.correlation_names
    return {a: {b: float(result.correlation[i, j]) for j, b in enumerate(names)} for i, a in enumerate(names)}


def _null_text(components: Mapping[str, float]) -> str:
    terms = ", ".join(f"{name} {share:+.2g}" for name, share in components.items())
    return f"{terms}: changing them together leaves no trace in these data"


def _filter_row(f: Any) -> dict[str, Any]:
    return {
        "dynamics_Hz": f.dynamics_Hz,
        "cutoff_Hz": f.cutoff_Hz,
        "decimation": f.decimation,
        "rows_per_s": f.rate_Hz / f.decimation,
    }


def _validation(capture: Capture, rows: Mapping[str, Mapping[str, Any]], effects: tuple[str, ...]) -> dict[str, Any]:
    """Free runs of the identified model; null where a parameter of it is not known."""
    drive, _ = choose_signals(capture.channels)
    plant = build_plant(effects, drive)
    values = {name: row["value"] for name, row in rows.items()}
    out: dict[str, Any] = {"capture": str(capture.path), "baseline": None, "extended": None, "adapted": None}
    if any(values.get(p.name) is None for p in plant.parameters):
        return out
    q = coordinates_of(plant.parameters, values)
    scores = score_row(score(capture.block(), plant, q), linear=capture.axis == "linear")
    return out | {"extended" if effects else "baseline": scores}
