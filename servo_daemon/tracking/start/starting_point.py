"""Where the filter starts: the regression where it knows, nominal values for the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servo_daemon.kalman.gaussian import Gaussian, to_coordinate
from servo_daemon.parameters import LINEAR, Parameter
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.residual_analysis import EXACT_STD
from servo_daemon.regression.sampling import BLIND_STD, settled_share

#: The regression's start is trusted this much less than it says: its noise is not quite white (free within a half and
#: twice: tests/recovery/constants.py).
_INFLATION = 3.0
#: The regression may start the filter at once when it knows every free parameter this well (1 σ, relative, inflated:
#: 5 % by its own word, decision 32).
GOOD_STD = 0.15
#: Beyond this relative std a logarithm of the regression's value means little (chosen; half and twice move no tracking
#: figure).
USABLE_STD = 0.5
#: A nominal value is a datasheet's, or a motor that has aged: 1 σ of its logarithm, a factor of two.
_NOMINAL_STD = 0.7
#: A guess from the regression's error alone, or an effect's start value: 1 σ of its logarithm, a factor of 4.5 (the
#: benchmark `starts` is up to five times off).
_GUESS_STD = 1.5
#: A nominal value further from the regression than this many σ is not believed (decision 32).
_IMPLAUSIBLE = 4.0


def well_known(found: RegressionEstimate | None, names: Sequence[str]) -> bool:
    """Whether the regression alone may start the filter."""
    if found is None or any(n not in found.names for n in names):
        return False
    index = [found.names.index(n) for n in names]
    value, std = found.value[index], found.std[index]
    return bool((value > 0).all() and (_INFLATION * std < GOOD_STD * value).all())


def starting_point(
    free: Sequence[Parameter],
    found: RegressionEstimate | None,
    nominal: Mapping[str, float],
    sample_period_s: float = 0.0,
) -> Gaussian | None:
    """Mean and covariance of the free parameters' coordinates; None if nothing is known of one of R, L, K, J, B."""
    taken = [p for p in free if found is not None and _usable(p, found)]
    mean, covariance = np.zeros(len(free)), np.zeros((len(free), len(free)))
    if found is not None and taken:
        _put_regression(free, taken, found, mean, covariance, sample_period_s)
    for k, p in enumerate(free):
        if p in taken:
            continue
        guess = _guess(p, found, nominal)
        if guess is None:
            return None
        mean[k], covariance[k, k] = guess
    return Gaussian(tuple(p.name for p in free), mean, covariance)


def _usable(p: Parameter, found: RegressionEstimate) -> bool:
    if p.name not in found.names:
        return False
    k = found.names.index(p.name)
    value, std = float(found.value[k]), float(found.std[k])
    if p.transform == "identity":
        return std < 0.1 * (p.upper - p.lower)
    return p.lower < value < p.upper and std < USABLE_STD * value


def _put_regression(
    free: Sequence[Parameter],
    taken: Sequence[Parameter],
    found: RegressionEstimate,
    mean: np.ndarray,
    cov: np.ndarray,
    sample_period_s: float,
) -> None:
    """The regression's values with their correlations, in estimated coordinates. What is straight in natural units (all
    values on one line fit equally well) is curved in logarithms: σ off along it the logarithm is σ²/2 beside it, which
    is added to its spread."""
    source = [found.names.index(p.name) for p in taken]
    target = [list(free).index(p) for p in taken]
    value = found.value[source]
    slope = np.array([1.0 / v if p.transform == "log" else 1.0 for p, v in zip(taken, value, strict=True)])
    mean[target] = [to_coordinate(p, float(v)) for p, v in zip(taken, value, strict=True)]
    part = found.covariance[np.ix_(source, source)] * np.outer(slope, slope) * _INFLATION**2
    blind = settled_share(dict(zip(found.names, found.value.tolist(), strict=True)), sample_period_s)
    floor = [(EXACT_STD + BLIND_STD.get(p.name, 0.0) * blind) ** 2 if p.transform == "log" else 0.0 for p in taken]
    bias = [part[k, k] ** 2 / 4.0 if p.transform == "log" else 0.0 for k, p in enumerate(taken)]
    cov[np.ix_(target, target)] = (part + part.T) / 2 + np.diag(floor) + np.diag(bias)


def _guess(p: Parameter, found: RegressionEstimate | None, nominal: Mapping[str, float]) -> tuple[float, float] | None:
    """Coordinate and variance where the regression does not determine the parameter."""
    if found is not None and p.name in found.names and p.transform == "log":
        k = found.names.index(p.name)
        value, std = float(found.value[k]), float(found.std[k])
        bound = max(value, 0.0) + _IMPLAUSIBLE * std
        given = nominal.get(p.name)
        if bound > p.lower and (given is None or given > bound or given < value - _IMPLAUSIBLE * std):
            return to_coordinate(p, float(np.clip(max(value, 0.5 * std), p.lower, p.upper))), _GUESS_STD**2
    if p.name in nominal:
        std = _NOMINAL_STD if p.transform == "log" else _GUESS_STD
        return to_coordinate(p, nominal[p.name]), std**2
    if p in LINEAR:
        return None
    return to_coordinate(p, p.nominal), _GUESS_STD**2
