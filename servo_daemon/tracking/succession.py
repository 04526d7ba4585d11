"""What a tracker with another model begins with: taken over from the one that ran before it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.linalg import block_diag

from servo_daemon.kalman.gaussian import Gaussian, to_coordinate
from servo_daemon.parameters import Parameter
from servo_daemon.tracking.plant_tracker import PlantTracker
from servo_daemon.tracking.prior_transfer import PriorTransfer, StartValue
from servo_daemon.tracking.tracker import Tracker

#: By how much (1 σ of the logarithm) an effect that the model lacks may bias a parameter that the filter still takes
#: for known. With each of 21 effects at 5 and 20 % of the working torque or voltage on three motors four of five were
#: biased by less than half of this, J by less than this; what no filter could notice (a second inertia adds 40 % to J,
#: a lag factors to L) the new one has to find. Below what costs the qualification, so that a motor that stands still is
#: not forgotten. Of an effect's parameter, over its scale.
_BIAS_STD: Mapping[str, float] = {"R": 0.10, "L": 0.14, "K": 0.05, "J": 0.14, "B": 0.14}
_BIAS_OTHER_STD = 0.14
#: A fitted value may be a minute old and its model not quite right: at least so much, 1 σ; without a std so much
#: (chosen; half and twice move no tracking figure).
_LEAST_STD, _UNTOLD_STD = 0.01, 0.30


def transferred(
    old: Tracker, new: Tracker, start: Mapping[str, StartValue], origin_s: float | None
) -> PriorTransfer | None:
    """What `new`, which has seen no sample yet, is to begin with.

    Args:
        old: as it is after a tick.
        start: values that a diagnosis or the user gives, by parameter.
        origin_s: the device time from which times among them count; None: as the old one counts.

    Returns:
        None where there is nothing to take over: one of the two does not run.
    """
    g = old.published()
    if not isinstance(old, PlantTracker) or not isinstance(new, PlantTracker) or g is None or old.first_s is None:
        return None
    table = {p.name: p for p in new.free}
    at = {name: k for k, name in enumerate(g.names)}
    sure = frozenset(n for n in table if n in at and n not in old.plan.held and old.qualification.qualified[at[n]])
    kept = [n for n in table if n in sure and n not in start]
    given = [n for n in table if n in start]
    index = [at[n] for n in kept]
    bias = np.array([_BIAS_STD.get(n, _BIAS_OTHER_STD) for n in kept]) * old.excitation.scales[index]
    pairs = [_given(table[n], *start[n]) for n in given]
    known = Gaussian(
        (*kept, *given),
        np.concatenate([g.mean[index], [mean for mean, _ in pairs]]),
        block_diag(g.covariance[np.ix_(index, index)] + np.diag(bias**2), np.diag([var for _, var in pairs])),
    )
    origin = old.first_s if origin_s is None else origin_s
    return PriorTransfer(known, sure, _slow_states(old, new), origin)


def _given(p: Parameter, value: float, std: float | None) -> tuple[float, float]:
    """Coordinate and variance of a value that was given."""
    clipped = min(max(value, p.lower), p.upper)
    if p.transform == "log":
        relative = _UNTOLD_STD if std is None else max(std / clipped, _LEAST_STD)
        return to_coordinate(p, clipped), relative**2
    size = abs(clipped) if clipped else 1.0
    return clipped, (_UNTOLD_STD * size if std is None else max(std, _LEAST_STD * size)) ** 2


def _slow_states(old: PlantTracker, new: PlantTracker) -> dict[str, tuple[float, float]]:
    """Of both plants: those beside current, speed and angle, which the first sample shows anyway."""
    there = {s.name for s in new.ekf.plant.states}
    x, var = old.ekf.x, old.ekf.state_var
    return {
        s.name: (float(x[k]), float(var[k]))
        for k, s in enumerate(old.ekf.plant.states)
        if s.name in there and s.name not in ("current_A", "velocity_rad_s", "position_rad") and math.isfinite(x[k])
    }
