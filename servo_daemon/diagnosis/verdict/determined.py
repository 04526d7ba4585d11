"""Whether the data determine an effect that is to be named."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects import effects_by_name

#: A value is known with a standard deviation below this share of it, a phase below this much, rad (decision 85).
_KNOWN, _KNOWN_PHASE_RAD = 0.5, 0.5
#: Part of a gradient along a direction without a trace beyond which a combination is open (chosen; not tried).
_LEAK = 1e-4
#: Log ratios that are zero within their covariance: chance makes their squared distance larger once in 20 times (the
#: usual level of a χ² test).
_CHANCE = 0.95
#: What a torque, an inertia or a stiffness is compared with where its own unit is open: without a current (the voltage
#: that overcomes it, N·m Ω/(N·m/A)), without a voltage (its current), without either (its acceleration).
_RELATIVE_TO = ({"R": 1.0, "K": -1.0}, {"K": -1.0}, {"J": -1.0})


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
    """Itself; where no value can be given because a unit is open, as a multiple."""
    found = fit.parameters[p.name]
    if found.status != "estimated" or found.value is None or not found.std:
        return _known_relatively(p, fit)
    return found.std < (_KNOWN_PHASE_RAD if found.unit == "rad" else _KNOWN * abs(found.value))


def _known_relatively(p: Parameter, fit: OutputErrorFit) -> bool:
    """Of a positive parameter: logarithms add up."""
    info = fit.after
    for others in _RELATIVE_TO if p.transform == "log" else ():
        weights = {p.name: 1.0, **others}
        gradient = np.array([weights.get(name, 0.0) for name in info.names])
        leak = float(np.max(np.abs(info.exact @ gradient), initial=0.0))
        if leak <= _LEAK * float(np.linalg.norm(gradient)) and float(np.linalg.norm(gradient @ info.root)) < _KNOWN:
            return True
    return False
