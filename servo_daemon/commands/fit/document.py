"""The JSON document of `fit`, from which its text and its report are made as well."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servo_daemon.commands.shared.units import shown_column, shown_unit
from servo_daemon.identification import Identification, Validation
from servo_daemon.identification.output_error import FittedParameter, OutputErrorFit
from servo_daemon.identification.output_error.discrepancy.lag_like import equivalents
from servo_daemon.identification.output_error.discrepancy.misfit import unexplained
from servo_daemon.identification.output_error.precision.combinations import Combination
from servo_daemon.identification.output_error.precision.information import NullDirection
from servo_daemon.identification.output_error.problem.score import Score
from servo_daemon.identification.winding import Winding, equivalents_of, joined_correlation, joined_parameters
from servo_daemon.signal_meaning import SignalMeaning


def fit_document(result: Identification, winding: Winding | None, meaning: SignalMeaning | None) -> dict[str, Any]:
    """Everything `fit` says, in plain types; no NaN.

    Args:
        winding: what the voltage says where it is a measurement, and the fit is of the motion alone.
        meaning: of the signals before they were converted to a DC motor's.
    """
    fit, linear = result.fit, result.captures[0].axis == "linear"
    parameters = joined_parameters(fit.parameters, winding)
    return {
        "method": "output-error",
        "captures": [str(c.path) for c in result.captures],
        "model": list(fit.problem.plant.effects),
        "input": fit.problem.plant.drive,
        "measured": [shown_column(c, linear=linear) for c in fit.problem.channels],
        "signals": (meaning or SignalMeaning()).document,
        "parameters": {name: parameter_row(p, linear=linear) for name, p in parameters.items()},
        "equivalents": equivalents_of(parameters, meaning or SignalMeaning()),
        "offsets": [{name: parameter_row(p, linear=linear) for name, p in o.items()} for o in fit.offsets],
        "correlation": joined_correlation(fit.correlation, fit.parameters, winding),
        "equivalent": {name: list(effects) for name, effects in equivalents(fit.problem).items()},
        "unexplained": [shown_column(c, linear=linear) for c in unexplained(fit)],
        "null_directions": [null_row(d) for d in fit.null_directions],
        "combinations": [combination_row(c, linear=linear) for c in fit.combinations],
        "before": {"null_directions": [null_row(d) for d in fit.before.null]},
        "iterations": iteration_rows(fit),
        "converged": fit.solution.converged,
        "start": fit.start,
        "residual": residual_row(fit, linear=linear),
        "validation": [validation_row(v) for v in result.validation],
        "seconds": fit.seconds,
    }


def parameter_row(p: FittedParameter, *, linear: bool) -> dict[str, Any]:
    """A fitted parameter as the JSON document has it."""
    row = {
        "value": p.value,
        "std": p.std,
        "unit": shown_unit(p.unit, linear=linear),
        "at_bound": p.at_bound,
        "status": p.status,
    }
    return row | {"bound": p.bound} if p.at_bound else row


def combination_row(c: Combination, *, linear: bool) -> dict[str, Any]:
    """What is determined of parameters that are not."""
    return {"expression": c.expression, "value": c.value, "std": c.std, "unit": shown_unit(c.unit, linear=linear)}


def null_row(direction: NullDirection) -> dict[str, Any]:
    """A null direction with a sentence."""
    return {
        "components": direction.components,
        "exact": direction.exact,
        "text": null_text(direction),
    }


def null_text(direction: NullDirection) -> str:
    """'R × s^1, K × s^-0.6: …' in words."""
    why = "leaves no trace in these data" if direction.exact else "leaves a trace too faint to settle it"
    if len(direction.components) == 1:
        return f"{next(iter(direction.components))}: changing it {why}"
    moves = ", ".join(f"{name} × s^{share:.2g}" for name, share in direction.components.items())
    return f"{moves}: changing them together so {why}"


def iteration_rows(fit: OutputErrorFit) -> list[dict[str, Any]]:
    """The paper's Table 1, with the parameters on the way."""
    names = fit.problem.parameter_of_column[: fit.problem.n_shared]
    logs = fit.problem.logarithmic
    rows = []
    for i in fit.solution.iterations:
        values = np.where(logs, np.exp(np.where(logs, i.unknowns, 0.0)), i.unknowns)
        rows.append(
            {
                "iteration": i.number,
                "function_count": i.evaluations,
                "cost": fit.cost(i),
                "parameters": {name: float(v) for name, v in zip(names, values, strict=False)},
            }
        )
    return rows


def residual_row(fit: OutputErrorFit, *, linear: bool) -> dict[str, Any]:
    """RMS by channel, whiteness, and what it was judged by."""
    tests = {shown_column(name, linear=linear): test for name, test in fit.residual.items()}
    return {
        "rmse": {name: t.rmse for name, t in tests.items()},
        "white": bool(fit.white),
        "noise_model": _noise_row(fit, linear=linear),
        "channels": {
            name: {
                "white": bool(t.white),
                "autocorrelation": t.autocorrelation,
                "input_correlation": t.input_correlation,
                "outliers": t.outliers,
            }
            for name, t in tests.items()
        },
    }


def _noise_row(fit: OutputErrorFit, *, linear: bool) -> dict[str, Any] | None:
    """Noise that enters the motor, where the estimate is the likelihood's under it: `white` then judges innovations."""
    if fit.noise is None or fit.innovation is None:
        return None
    return {
        "voltage_noise_V": fit.noise.input_std,
        "sensor_noise": {shown_column(n, linear=linear): v for n, v in fit.noise.sensor_std.items()},
        "innovation_autocorrelation": {
            shown_column(n, linear=linear): t.autocorrelation for n, t in fit.innovation.items()
        },
    }


def validation_row(v: Validation) -> dict[str, Any]:
    """A validation as in diagnosis.json."""
    linear = v.capture.axis == "linear"
    return {
        "capture": str(v.capture.path),
        "baseline": score_row(v.baseline, linear=linear),
        "extended": None if v.extended is None else score_row(v.extended, linear=linear),
        "adapted": None if v.adapted is None else {**score_row(v.adapted, linear=linear), "settled": dict(v.settled)},
    }


def score_row(s: Score, *, linear: bool) -> dict[str, Any]:
    """RMS errors of the free run and of the short ones, and the free run's bands."""

    def named(values: Mapping[str, Any]) -> dict[str, Any]:
        return {shown_column(name, linear=linear): value for name, value in values.items()}

    bands = {
        name: {"half_width": i.half_width, "inside": i.inside, "expected_rmse": list(i.expected)}
        for name, i in s.intervals.items()
    }
    return {"rmse": named(s.rmse), "rmse_1s": named(s.rmse_1s), "band95": named(bands)}
