"""Parameters under which little is missing, where a fit that lacks an effect has biased them.

A simulation that sticks where the motor moves, or moves where it sticks, can be fitted best by absurd parameters, and
then nearly all of torque and voltage is "missing". The balances are linear in R, L, K, J and B: the change of the free
ones that leaves least of both series is a better place to look from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.missing.missing import Fitted, Missing, coordinates_with_load, missing_inputs
from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.missing.response import smoothed
from servo_daemon.diagnosis.missing.signals import motion_of
from servo_daemon.errors import NumericalError
from servo_daemon.identification.output_error import Recording
from servo_daemon.identification.output_error.starts import regression_values
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.numerics import least_squares
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.columns.screening import Trace
from servo_daemon.samples import F64, SampleBlock

#: Parameters are changed where more than this share of the voltage (ten times as much of the torque) is missing, at
#: most so often, and as long as that helps (chosen; not tried).
_MUCH, _ROUNDS = 0.03, 4
#: Factors by which a parameter moves at most in a round (chosen; not tried).
_LEAP = (1e-3, 1e3)


def balanced_missing_inputs(
    fit: Fitted,
    block: SampleBlock,
    *,
    recording: int = 0,
    seen: NDArray[np.bool_] | None = None,
    levels: NoiseLevels | None = None,
) -> Missing:
    """As `missing_inputs`, with the free parameters of the linear motor moved to where the balances want them, where
    much is missing. The parameters used are in `Missing.coordinates`.

    Raises:
        BadInputError, NumericalError: as `missing_inputs`.
    """
    if "gap" in fit.problem.plant.parameter_names:  # not linear in J: the load's is another one
        return missing_inputs(fit, block, recording=recording, seen=seen, levels=levels)
    where = _Where(block, recording, seen)
    first = best = _first(fit, where, levels)
    for _ in range(_ROUNDS):
        if _share(best) < _MUCH:
            break
        names = best.augmented.plant.parameter_names
        q = best.coordinates.copy()
        for name, change in _changes(fit, best).items():
            q[names.index(name)] += float(np.log(np.clip(1 + change, *_LEAP)))
        missing = _if_possible(fit, where, q, best.levels)
        if missing is None or _share(missing) >= 0.9 * _share(best):
            break
        best = missing
    if best.coordinates is first.coordinates:
        return first
    return _if_possible(fit, where, best.coordinates) or first


@dataclass(frozen=True, slots=True)
class _Where:
    """What is looked at; see `missing_inputs`."""

    block: SampleBlock
    recording: int
    seen: NDArray[np.bool_] | None


def _first(fit: Fitted, where: _Where, levels: NoiseLevels | None) -> Missing:
    """With the fitted parameters, or with those of the regression where these leave less or can alone be used.

    Raises:
        NumericalError: neither can be.
    """
    fitted = _if_possible(fit, where, levels=levels)
    if fitted is not None and _share(fitted) < _MUCH:
        return fitted
    q = _regressed(fit, where)
    known = None if q is None else _if_possible(fit, where, q, levels)
    if fitted is None and known is None:
        raise NumericalError("missing torque and voltage: the smoother left the range of numbers")
    if fitted is None or (known is not None and _share(known) < 0.9 * _share(fitted)):
        assert known is not None
        return known
    return fitted


def _if_possible(fit: Fitted, where: _Where, q: F64 | None = None, levels: NoiseLevels | None = None) -> Missing | None:
    try:
        return missing_inputs(
            fit, where.block, recording=where.recording, coordinates=q, levels=levels, seen=where.seen
        )
    except NumericalError:
        return None


def _share(missing: Missing) -> float:
    """RMS of what is missing over the working size, a tenth of it for the torque: the larger of both."""
    rms = {name: float(np.sqrt(square)) for name, square in missing.mean_square.items()}
    return max(share if name == "voltage" else 0.1 * share for name, share in rms.items())


def _regressed(fit: Fitted, where: _Where) -> F64 | None:
    """The daemon's regression of both balances in the place of the fitted R, L, K, J and B: the winding's, which no
    load torque biases, tells K from a fit that followed a torque by another inertia."""
    found = regression_values(Recording("capture", where.block, where.seen).seen_block, fit.problem.plant)
    _, q = coordinates_with_load(fit)
    for k, p in enumerate(fit.problem.plant.parameters):  # with them what the regression says of offsets and loads
        if p.name in found and p.name in fit.problem.free:
            q[k] = to_coordinate(p, found[p.name])
    return q if found else None


def _changes(fit: Fitted, missing: Missing) -> dict[str, float]:
    """Relative change of each free parameter of the linear motor: R, L and K from the winding's balance, which no load
    biases, then J and B from the shaft's."""
    m = motion_of(missing)
    free = {name for name in fit.problem.free if name in MOTOR_NAMES}
    out: dict[str, float] = {}
    if "voltage" in missing.series and "torque" in missing.series:
        winding = {"R": m.p["R"] * m.i, "L": m.p["L"] * m.i_rate, "K": m.p["K"] * m.omega}
        traces = {name: Trace(voltage=values) for name, values in winding.items() if name in free}
        out = _least_squares(missing, "voltage", traces, missing.series["voltage"], missing.seen)
    if "torque" in missing.series and not m.rest.all():
        shaft = {"J": m.p["J"] * m.omega_rate, "B": m.p["B"] * m.omega}
        traces = {name: Trace(torque=values) for name, values in shaft.items() if name in free}
        traces["dry"] = Trace(torque=np.where(m.rest, 0.0, m.direction))
        torque = missing.series["torque"]
        if "K" in out:
            torque = torque + out["K"] * m.p["K"] * m.i
        out |= _least_squares(missing, "torque", traces, torque, ~m.rest & missing.seen)
        out.pop("dry", None)
    return out


def _least_squares(
    missing: Missing, name: str, traces: Mapping[str, Trace], series: F64, where: NDArray[np.bool_]
) -> dict[str, float]:
    if not traces:
        return {}
    columns = smoothed(missing, list(traces.values()))[name][where]
    return dict(zip(traces, least_squares(columns, series[where])[0].tolist(), strict=True))
