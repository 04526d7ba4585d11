"""Both balances' findings as one list of parameters with a joint covariance, sorted by what they are worth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.identification.inverse_dynamics.armature import L_WEIGHT, ArmatureFit
from servo_daemon.identification.inverse_dynamics.estimate import Axis, Estimate, unit_on
from servo_daemon.identification.inverse_dynamics.solve import ShaftFit
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.effects import parameter_table
from servo_daemon.regression.linear_regression import ROBUST, WHITE, is_determined
from servo_daemon.samples import F64


@dataclass(frozen=True, slots=True)
class Found:
    """`names` (n,), in the order of publication; `value` (n,), `covariances` (3, n, n), `units`."""

    names: tuple[str, ...]
    value: F64
    covariances: F64
    units: tuple[str, ...]
    null_directions: tuple[Mapping[str, float], ...]


def sorted_out(shaft: ShaftFit, armature: ArmatureFit | None, axis: Axis) -> Found:
    """The joint result: what the shaft owes to the armature's K makes their errors correlated."""
    names, value, covariances = list(shaft.names), shaft.value, shaft.covariances
    directions = shaft.null_directions
    if armature is not None:
        names = [*armature.names, *names]
        value = np.concatenate([armature.value, value])
        covariances = _joint(armature.covariances, covariances, shaft.by_armature)
        directions = (*armature.fit.null_directions, *directions)
    order = sorted(
        range(len(names)), key=lambda k: MOTOR_NAMES.index(b) if (b := _base(names[k])) in MOTOR_NAMES else 9
    )
    chosen = tuple(names[k] for k in order)
    units = tuple(_unit(n, axis) for n in chosen)
    return Found(chosen, value[order], covariances[:, np.array(order, np.intp)[:, None], order], units, directions)


def _joint(upper: F64, lower: F64, by: F64) -> F64:
    cross = by @ upper
    return np.block([[upper, cross.transpose(0, 2, 1)], [cross, lower + by @ upper @ by.T]])


def _base(name: str) -> str:
    return name.removesuffix("/K")


def _unit(name: str, axis: Axis) -> str:
    table = parameter_table()
    unit = unit_on(axis, table[_base(name)].unit)
    return f"{unit}/({unit_on(axis, table['K'].unit)})" if name.endswith("/K") else unit


def as_estimates(found: Found) -> tuple[dict[str, Estimate], dict[str, Estimate]]:
    """(what is determined, positive parameters that are not)."""
    std = np.sqrt(np.maximum(np.diagonal(found.covariances, axis1=1, axis2=2), 0.0))
    good: dict[str, Estimate] = {}
    bad: dict[str, Estimate] = {}
    for k, name in enumerate(found.names):
        estimate = Estimate(float(found.value[k]), float(std[ROBUST, k]), found.units[k], float(std[WHITE, k]))
        unclear = not is_determined(estimate.value, std[:, k] ** 2, L_WEIGHT if name == "L" else 1.0)
        positive = parameter_table()[_base(name)].transform == "log"
        (bad if positive and unclear else good)[name] = estimate
    return good, bad
