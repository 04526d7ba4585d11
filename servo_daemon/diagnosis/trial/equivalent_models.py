"""Equivalent models: two sets of values of one structure that the data hardly distinguish.

A voltage that follows by a first-order lag and a winding that follows by L/R are two lags in a row: but for the
back-EMF, which passes the winding alone, it is the same in which order. A fit ends in either, and the standard
deviations there know nothing of the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error import OutputErrorFit

#: Models whose residuals differ by no more than this share are one to the data: simulation, noise that is not quite
#: white and what else is missing make as much (chosen; not tried).
_ALIKE = 0.01
#: Where both are white their deviances tell: a difference of 3 σ, squared.
BY_CHANCE = 9.0


def equivalent_lags(values: Mapping[str, float]) -> dict[str, float] | None:
    """The values with drive's lag and winding's time constant exchanged; None where there is no lag."""
    if not {"t_lag", "R", "L"} <= values.keys() or min(values["t_lag"], values["R"], values["L"]) <= 0.0:
        return None
    return {**values, "t_lag": values["L"] / values["R"], "L": values["R"] * values["t_lag"]}


def told_from_equivalent(
    fit: OutputErrorFit, again: Callable[[Mapping[str, float]], OutputErrorFit | None]
) -> OutputErrorFit:
    """A fit or its equivalent, whichever is better; where they are alike, with what lies between them in the standard
    deviations.

    Args:
        again: the same fit begun from other values; None where it fails.
    """
    start = equivalent_lags(fit.values)
    other = None if start is None else again(start)
    if other is None:
        return fit
    if (fit.deviance is None) != (other.deviance is None):
        return other if fit.deviance is None else fit  # that for which noise of voltage and sensors was found
    if fit.deviance is not None and other.deviance is not None:
        difference, alike = other.deviance - fit.deviance, BY_CHANCE
    else:
        difference, alike = _error(other) - _error(fit), _ALIKE
    better, worse = (other, fit) if difference < 0.0 else (fit, other)
    return _with_distance(better, worse) if abs(difference) < alike else better


def _error(fit: OutputErrorFit) -> float:
    """Logarithm of the residuals' size, mean over the channels."""
    return float(np.mean([math.log(max(r.rmse, 1e-300)) for r in fit.residual.values()]))


def _with_distance(fit: OutputErrorFit, other: OutputErrorFit) -> OutputErrorFit:
    parameters = {}
    for name, p in fit.parameters.items():
        q = other.parameters[name]
        if p.value is None or q.value is None or p.std is None:
            parameters[name] = p
        else:
            parameters[name] = replace(p, std=math.hypot(p.std, p.value - q.value))
    return replace(fit, parameters=parameters)
