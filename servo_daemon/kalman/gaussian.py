"""The form of an estimator's answer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.parameters import Parameter
from servo_daemon.samples import F64

#: Beyond this e^x is no number.
_LARGEST_EXPONENT = 709.0


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Estimates in the estimated coordinate: log(P) for positive parameters, P for signed ones.

    Attributes:
        names: parameter names, length n.
        mean: shape (n,).
        covariance: shape (n, n), symmetric positive (semi-)definite.
    """

    names: tuple[str, ...]
    mean: F64
    covariance: F64

    @property
    def std(self) -> F64:
        """shape (n,), in the estimated coordinate (relative, for a log parameter)."""
        return np.asarray(np.sqrt(np.maximum(self.covariance.diagonal(), 0.0)))


def to_coordinate(parameter: Parameter, value: float) -> float:
    """The coordinate in which a parameter is estimated."""
    return float(np.log(value)) if parameter.transform == "log" else float(value)


def from_coordinate(parameter: Parameter, coordinate: float, std: float) -> tuple[float, float]:
    """Value and 1 σ in the parameter's unit (first order for a logarithm: σ_P = P σ_log P)."""
    if parameter.transform == "log":
        value = math.exp(coordinate) if not coordinate > _LARGEST_EXPONENT else math.inf
        return value, value * std
    return float(coordinate), float(std)


def coordinates_of(parameters: Iterable[Parameter], values: Mapping[str, float]) -> F64:
    """Coordinates of values in natural units, shape (n,), in the parameters' order; the inverse of `natural_values`."""
    return np.array([to_coordinate(p, values[p.name]) for p in parameters])


def natural_values(parameters: Iterable[Parameter], coordinates: F64) -> dict[str, float]:
    """Values in natural units by name; coordinates: shape (n,), in the parameters' order."""
    return {p.name: from_coordinate(p, c, 0.0)[0] for p, c in zip(parameters, coordinates.tolist(), strict=True)}


def completed(g: Gaussian, parameters: Sequence[Parameter], held_var: float) -> tuple[F64, F64]:
    """Coordinates, shape (n,), and covariance, shape (n, n), of all parameters in their order: as given, or at the
    table's value.

    Args:
        held_var: variance of a parameter that is held, added to all.
    """
    names = [p.name for p in parameters]
    mean = np.array([to_coordinate(p, p.nominal) for p in parameters])
    covariance = np.diag(np.full(len(names), held_var))
    index = [names.index(name) for name in g.names]
    mean[index] = g.mean
    covariance[np.ix_(index, index)] = g.covariance + np.diag(np.full(len(index), held_var))
    return mean, covariance
