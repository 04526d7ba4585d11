"""The JSON document of `diagnose`, from which its text and its report are made as well."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from servo_daemon.commands.diagnose.evidence import Evidence
from servo_daemon.commands.diagnose.missing import means_over_speed
from servo_daemon.commands.diagnose.toml import toml_lines
from servo_daemon.commands.fit.document import (
    combination_row,
    null_row,
    parameter_row,
    score_row,
    validation_row,
)
from servo_daemon.commands.fit.inputs import Inputs
from servo_daemon.commands.fit.notes import result_notes
from servo_daemon.commands.shared.units import shown_column, shown_unit
from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.screening.dependence import Dependence
from servo_daemon.diagnosis.verdict.result import CandidateScore, Diagnosis, HeldOut, NamedEffect, OwnModel, Spread
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.winding import joined_parameters
from servo_daemon.plant.effects import effects_by_name, parameter_table

#: Raised when a key changes its meaning.
SCHEMA = 1

#: What `depends_on` calls the finer words of the detailed list: speed, angle, current, time.
_COARSE = {"direction": "speed", "travel": "angle", "load": "current", "step": "time", "moments": "time"}


def diagnosis_document(d: Diagnosis, inputs: Inputs, evidence: Evidence) -> dict[str, Any]:
    """Everything `diagnose` says, in plain types; what is not a finite number is null."""
    linear = d.captures[0].axis == "linear"
    final = d.final
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "verdict": d.verdict,
        "judged_by": d.judged_by,
        "measured_on": d.measured_on,
        "deviance_gain": d.deviance_gain,
        "effects": [_effect_row(e, d, inputs, linear=linear) for e in d.effects],
        "baseline": _model_row(d.baseline, d.baseline_score, inputs, linear=linear),
        "extended": None if d.extended is None else _model_row(d.extended, d.extended_score, inputs, linear=linear),
        "noise_floor": d.noise_floor,
        "gain": _gain_row(d),
        "validation": [validation_row(v) for v in d.validation],
        "candidates": [_candidate_row(c) for c in d.candidates],
        "remaining": _remaining_row(d, linear=linear),
        "captures": [str(c.path) for c in d.captures],
        "drive": inputs.drive.name,
        "input": final.problem.plant.drive,
        "measured": [shown_column(c, linear=linear) for c in final.problem.channels],
        "signals": inputs.meaning.document,
        "missing": _missing_rows(d, evidence, linear=linear),
        "differences": [_difference_row(s, linear=linear) for s in d.differences],
        "own_models": [_own_row(m, linear=linear) for m in d.own_models],
        "free_runs": _free_run_rows(d, evidence, linear=linear),
        "null_directions": [null_row(n) for n in final.null_directions],
        "combinations": [combination_row(c, linear=linear) for c in final.combinations],
        "toml": toml_lines(final, d.effects) if d.effects else None,
        "notes": [*inputs.notes, *result_notes(final, inputs.nominal, inputs.meaning, inputs.captures[0])],
        "seconds": d.seconds,
        "unfinished": None if d.unfinished is None else asdict(d.unfinished),
    }
    return {key: plain(value) for key, value in document.items()}


def plain(value: Any) -> Any:
    """JSON's own types: NumPy's numbers as Python's, tuples as lists, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | Sequence) and not isinstance(value, str):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _effect_row(named: NamedEffect, d: Diagnosis, inputs: Inputs, *, linear: bool) -> dict[str, Any]:
    effect = effects_by_name()[named.name]
    rows = _parameter_rows(d.final, inputs, linear=linear)
    return {
        "name": named.name,
        "cause": effect.cause,
        "equation": effect.equation,
        "parameters": {p.name: rows[p.name] for p in effect.parameters if p.name in rows},
        "gain": named.gain,
        "equivalent": [[name] for name in named.equivalent],
    }


def _parameter_rows(fit: OutputErrorFit, inputs: Inputs, *, linear: bool) -> dict[str, dict[str, Any]]:
    """As in fit's document; counts and choices that the search has found are `searched`, not `fixed`. What the data do
    not determine has its nominal value or none, never the one that the search ran with."""
    table, rows = parameter_table(), {}
    for name, p in joined_parameters(fit.parameters, inputs.winding).items():
        row = parameter_row(p, linear=linear)
        if p.status == "fixed" and table[name].held == "always" and name not in inputs.fixed:
            row |= {"status": "searched", "value": None if p.value is None else float(f"{p.value:.12g}")}
        if p.status == "undetermined" and not p.at_bound:
            row["value"] = inputs.nominal.get(name)
        if table[name].choices and row["value"] is not None:
            row["choice"] = table[name].choices[round(row["value"])]
        rows[name] = row
    return rows


def _model_row(fit: OutputErrorFit, score: HeldOut | None, inputs: Inputs, *, linear: bool) -> dict[str, Any]:
    return {
        "model": list(fit.problem.plant.effects),
        "parameters": _parameter_rows(fit, inputs, linear=linear),
        "heldout_rmse": {} if score is None else {shown_column(n, linear=linear): v for n, v in score.rmse.items()},
        "heldout_nrmse": None if score is None else score.nrmse,
    }


def _gain_row(d: Diagnosis) -> dict[str, Any] | None:
    if d.verdict != "found":
        return None
    ci95 = None if d.ci95 is None else list(d.ci95)
    return {"error_removed": d.error_removed, "ci95": ci95, "measured_on": d.measured_on}


def _candidate_row(c: CandidateScore) -> dict[str, Any]:
    return {
        "name": c.name,
        "beside": list(c.beside),
        "heldout_nrmse": c.nrmse,
        "delta_bic": c.delta_bic,
        "taken": c.taken,
    }


def _remaining_row(d: Diagnosis, *, linear: bool) -> dict[str, Any]:
    words = [_COARSE.get(x.on, x.on) for x in d.depends_on]
    return {
        "white": bool(d.white),
        "depends_on": list(dict.fromkeys(words)),
        "dependences": [_dependence_row(x, linear=linear) for x in d.depends_on],
    }


def _dependence_row(x: Dependence, *, linear: bool) -> dict[str, Any]:
    """`share` of the missing signal's mean square, `size` its RMS, `relative` that over what the motor works with."""
    return {
        "series": _series_name(x.series, linear=linear),
        "on": x.on,
        "share": x.share,
        "size": x.size,
        "unit": _series_unit(x.series, linear=linear),
        "relative": x.relative,
        "detail": dict(x.detail),
    }


def _missing_rows(d: Diagnosis, evidence: Evidence, *, linear: bool) -> dict[str, Any]:
    """RMS of the unmodelled torque and voltage over the longest capture, of both models smoothed alike, and what either
    model's motor works with. `over_speed`: the means that the report draws, before with the extended model's motor."""
    rows, left = {}, evidence.left
    for series, before in d.before.series.items():
        after = None if left is None else left.series.get(series)
        rows[_series_name(series, linear=linear)] = {
            "unit": _series_unit(series, linear=linear),
            "working_rms": d.before.size.get(series),
            "before_rms": float(np.sqrt(np.mean(before**2))),
            "after_working_rms": None if left is None else left.size.get(series),
            "after_rms": None if after is None else float(np.sqrt(np.mean(after**2))),
            "std": float(np.median(d.before.std[series])),
            "over_speed": {
                "unit": "m/s" if linear else "rad/s",
                "before": _curve(evidence.asked or d.before, series),
                "after": None if left is None else _curve(left, series),
            },
        }
    return rows


def _curve(m: Missing, series: str) -> dict[str, Any] | None:
    means = means_over_speed(m, series) if series in m.series else None
    if means is None:
        return None
    return {"speed": means.x.tolist(), "value": [float(y) if math.isfinite(y) else None for y in means.y]}


def _series_name(series: str, *, linear: bool) -> str:
    return "force" if linear and series == "torque" else series


def _series_unit(series: str, *, linear: bool) -> str:
    return shown_unit({"torque": "N·m", "voltage": "V"}[series], linear=linear)


def _free_run_rows(d: Diagnosis, evidence: Evidence, *, linear: bool) -> list[dict[str, Any]]:
    return [
        {
            "capture": str(c.path),
            "baseline": score_row(before, linear=linear),
            "extended": None if after is None else score_row(after, linear=linear),
            "adapted": None,
        }
        for c, (before, after) in zip(d.captures, evidence.free_runs, strict=True)
    ]


def _own_row(m: OwnModel, *, linear: bool) -> dict[str, Any]:
    def named(rmse: Mapping[str, float]) -> dict[str, float]:
        return {shown_column(name, linear=linear): value for name, value in rmse.items()}

    return {"capture": m.capture, "shared_rmse": named(m.shared_rmse), "own_rmse": named(m.own_rmse)}


def _difference_row(s: Spread, *, linear: bool) -> dict[str, Any]:
    unit = shown_unit(parameter_table()[s.name].unit, linear=linear)
    return {"name": s.name, "unit": unit, "values": list(s.values), "stds": list(s.stds)}
