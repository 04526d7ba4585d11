"""Whether the data determine an effect that is to be named."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.precision.information import log_std
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects import effects_by_name

#: A value is known with a standard deviation below this share of it, a phase below this much, rad (decision 85).
_KNOWN, _KNOWN_PHASE_RAD = 0.5, 0.5
#: Log ratios that are zero within their covariance: chance makes their squared distance larger once in 20 times (the
#: usual level of a χ² test).
_CHANCE = 0.95


def is_determined(name: str, fit: OutputErrorFit) -> bool:
    """Whether every parameter of an effect has a value that is known, by itself or as a multiple of the motor's.

    Args:
        fit: with the effect, as it is published.
    """
    free = [p for p in effects_by_name()[name].parameters if p.held != "always" and p.name in fit.problem.free]
    return all(_known(p, fit) for p in free)


def is_its_simpler(name: str, fit: OutputErrorFit) -> bool:
    """Whether an effect's values are those of the one that it contains, as far as they are known: nothing speaks for
    its name then.

    Args:
        fit: with the effect, as it is published.
    """
    info = fit.after
    alike = effects_by_name()[name].alike
    pairs = [(a, b) for a, b in alike.items() if {a, b} <= set(info.names)]
    if not pairs or len(pairs) < len(alike):
        return False
    gradient = np.array([[float(n == a) - float(n == b) for n in info.names] for a, b in pairs])
    apart = np.array([np.log(fit.values[a] / fit.values[b]) for a, b in pairs])
    root = gradient @ info.root
    return float(apart @ np.linalg.pinv(root @ root.T) @ apart) < float(chi2.ppf(_CHANCE, len(pairs)))


def _known(p: Parameter, fit: OutputErrorFit) -> bool:
    """Itself, or as a multiple of the motor's where its unit is open or hardly known."""
    found, value = fit.parameters[p.name], None if p.transform == "log" else fit.values.get(p.name)
    if (p.transform == "log" or (p.unit == "N·m" and value)) and log_std(fit.after, p.name, value) < _KNOWN:
        return True
    if found.status != "estimated" or found.value is None or not found.std:
        return False
    return found.std < (_KNOWN_PHASE_RAD if found.unit == "rad" else _KNOWN * abs(found.value))
