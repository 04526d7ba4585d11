"""What the balance names, as a finding: parameters with standard deviations, the gain on what was held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.diagnosis.inverse.fit import OFFSET, OWN, Explained, Start, non_negative
from servo_daemon.diagnosis.inverse.rows import BalanceRows, balance_rows
from servo_daemon.diagnosis.inverse.search import Found, search_balance
from servo_daemon.diagnosis.missing.missing import coordinates_with_load, missing_inputs
from servo_daemon.diagnosis.trial.compare import error_removed, share_of_removable
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import CHOICE, shorter_s
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.diagnosis.verdict.result import CandidateScore, Finding, HeldOut, NamedEffect
from servo_daemon.identification.output_error import FitOptions, FittedParameter, OutputErrorFit, fit_output_error
from servo_daemon.identification.output_error.precision.combinations import Combination
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.plant.effects import parameter_table
from servo_daemon.regression.linear_regression import ROBUST, fit_linear
from servo_daemon.samples import F64

#: Standard deviations above which an inertia or a friction is seen; where none is, its torque is taken for so small a
#: share of what is left (two: one Gaussian in twenty is beyond; the second chosen, not tried).
_SEEN, _UNSEEN = 2.0, 0.05
#: Relative step of a derivative (between rounding and curvature; chosen; not tried).
_STEP = 1e-6


@dataclass(frozen=True)
class Values:
    """Natural values and 1 σ by name; a σ of None: not seen, the value is one that would not show."""

    value: Mapping[str, float]
    std: Mapping[str, float | None]


def found_by_balance(data: Data, baseline: OutputErrorFit, base: Trial, nominal: Mapping[str, float]) -> Finding | None:
    """Search the shaft's balance for a cause where free runs have named none.

    Args:
        data: recordings and their split.
        baseline: the linear motor as fitted; a drive with more in its model, or one whose voltage is the input, is
            left to the free runs.
        base: the same as a trial.
        nominal: natural units; K scales all torques, and no data of a current and a position tell it.

    Returns:
        None: the balance names nothing.
    """
    plant = baseline.problem.plant
    if plant.drive == "voltage" or plant.effects:
        return None
    rows = balance_rows(data, (), {**base.values, **_known(plant.parameter_names, data, nominal)})
    found = None if rows is None else search_balance(rows)
    if rows is None or found is None:
        return None
    values, every = full_data_values(found.explained), data.full
    extended = _model(every, baseline, found.explained, values, K_known="K" in data.fixed or plant.drive == "torque")
    measuring, number = data.split.measuring, data.longest
    before, after, floor = found.base.scored(measuring), found.explained.scored(measuring), _floor(found, measuring)
    removed, ci95 = error_removed(before, after, floor)
    block = data.recordings[number].block
    return Finding(
        judged_by="balance",
        effects=_named(found, measuring, floor),
        extended=extended,
        baseline_score=_held_out(before, plant.drive),
        extended_score=_held_out(after, plant.drive),
        noise_floor=floor.nrmse,
        error_removed=removed,
        ci95=ci95,
        candidates=_candidates(found),
        before=missing_inputs(baseline, block, recording=number, coordinates=_linear(baseline, values, rows.factor)),
        after=missing_inputs(extended, block, recording=number),
    )


def _held_out(scored: Scored, drive: str) -> HeldOut:
    effort = "torque_Nm" if drive == "torque" else "current_A"
    return HeldOut({effort: float(np.sqrt(scored.mse[0]))}, scored.nrmse)


def _known(names: Sequence[str], data: Data, nominal: Mapping[str, float]) -> dict[str, float]:
    if "K" not in names:
        return {}
    return {"K": data.fixed.get("K", nominal.get("K", parameter_table()["K"].nominal))}


def full_data_values(explained: Explained) -> Values:
    """The regression over all rows, with standard deviations for a residual that is correlated and for what standing
    readings do not tell."""
    table, torque_of = explained.table[explained.told], explained.rows.torque[explained.told]
    beta = non_negative(table, torque_of)
    kept = np.flatnonzero((beta != 0) | (np.arange(len(beta)) >= len(OWN)))
    fit = fit_linear([str(k) for k in kept], table[:, kept], torque_of)
    full, covariance = np.zeros(len(beta)), np.zeros((len(beta), len(beta)))
    at = [int(name) for name in fit.names]
    full[at], covariance[np.ix_(at, at)] = fit.value, fit.covariances[ROBUST]
    covariance[kept, kept] += _unread_var(table[:, kept], torque_of, explained.rows.unread[explained.told])
    value: dict[str, float] = {}
    std: dict[str, float | None] = {}
    for k, name in enumerate(OWN):
        spread = float(np.sqrt(covariance[k, k]))
        seen = abs(full[k]) > _SEEN * spread > 0
        if seen or name != "TL":
            value[name] = float(full[k]) if seen else _invisible(explained, k)
            std[name] = spread if seen else None
    for torque in explained.torques:
        own = explained.columns_of(torque)
        found, spread_of = _with_std(torque.start, full[own], covariance[own, own])
        value |= found
        std |= spread_of
    return Values(value, std)


def _unread_var(table: F64, torque: F64, unread: F64) -> F64:
    """Variance of each coefficient, shape (m,), from readings that stand. Their errors are no noise: those of one
    reading may all be the same, anything up to half a step; those of different readings are independent."""
    step = 2.0 * float(unread.max(initial=0.0))
    if step == 0.0:
        return np.zeros(table.shape[1])
    _, reading = np.unique(np.rint(torque / step), return_inverse=True)
    most = np.array([np.bincount(reading, np.abs(row) * unread) for row in np.linalg.pinv(table)])
    return np.asarray((most**2).sum(axis=1) / 3.0)


def _invisible(explained: Explained, column: int) -> float:
    """A parameter of the motor whose torque would not show beside what is left."""
    size = float(np.sqrt(np.mean(explained.table[:, column] ** 2)))
    return _UNSEEN * float(np.std(explained.residual)) / max(size, 1e-300)


def _with_std(start: Start, b: F64, covariance: F64) -> tuple[dict[str, float], dict[str, float | None]]:
    """Parameters of coefficients and their 1 σ to first order."""
    value = dict(start(b) or {})
    jacobian = np.zeros((len(value), len(b)))
    for k in range(len(b)):
        step = _STEP * max(float(np.abs(b).max()), 1e-300)
        moved = start(b + step * np.eye(len(b))[k]) or value
        jacobian[:, k] = [(moved[n] - v) / step for n, v in value.items()]
    spread = np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0))
    return value, {n: float(s) for n, s in zip(value, spread, strict=True)}


def _model(
    data: Data, baseline: OutputErrorFit, explained: Explained, values: Values, *, K_known: bool
) -> OutputErrorFit:
    """The extended motor with these values, over free runs as short as they may be."""
    effects = tuple(e for t in explained.torques for e in t.effects) + ((OFFSET,) if "TL" in values.value else ())
    table = parameter_table()
    held = {n: float(np.clip(v, table[n].lower, table[n].upper)) for n, v in values.value.items()}
    if "K" in baseline.problem.plant.parameter_names:
        held["K"] = explained.rows.factor
    options = FitOptions(nominal=held, fixed=held, noise_model="none", thorough=False)
    segment_s = shorter_s(data.recordings, data.split.segment_s) or data.split.segment_s
    fit = fit_output_error(data.recordings, effects, replace(options, segment_s=segment_s))
    parameters = {n: _parameter(n, p, values, K_known=K_known) for n, p in fit.parameters.items()}
    if "K" in parameters and not K_known:
        parameters["K"] = replace(parameters["K"], value=None, status="undetermined")
    ratios = () if K_known else _ratios(explained.rows, values, parameters)
    return replace(fit, parameters=parameters, combinations=ratios)


def _parameter(name: str, fitted: FittedParameter, values: Values, *, K_known: bool) -> FittedParameter:
    """As the regression has it; a torque by an unknown K has no number."""
    if name not in values.value or parameter_table()[name].held == "always":
        return fitted
    std = values.std[name]
    if std is None or (not K_known and _is_torque(name)):
        return FittedParameter(None, None, fitted.unit, "undetermined", False)
    return FittedParameter(values.value[name], std, fitted.unit, "estimated", False)


def _is_torque(name: str) -> bool:
    return name == "J" or parameter_table()[name].unit.startswith("N·m")


def _ratios(rows: BalanceRows, values: Values, parameters: Mapping[str, FittedParameter]) -> tuple[Combination, ...]:
    """Torques over K, which is what a current tells."""
    units = {"J": "A·s²/rad", "B": "A·s/rad", "c2": "A·s²/rad²"}
    return tuple(
        Combination(f"{n}/K", values.value[n] / rows.factor, std / rows.factor, units.get(n, "A"))
        for n, std in values.std.items()
        if std is not None and n in parameters and parameters[n].value is None
    )


def _linear(baseline: OutputErrorFit, values: Values, factor: float) -> F64:
    """Coordinates of the linear motor of the balance, as `Missing.coordinates` has them."""
    (names, q), table = coordinates_with_load(baseline), parameter_table()
    motor = {name: value for name, value in values.value.items() if name in OWN}
    if "K" in names:
        motor["K"] = factor
    for name, value in motor.items():
        q[names.index(name)] = to_coordinate(table[name], float(np.clip(value, table[name].lower, table[name].upper)))
    return q


def _floor(found: Found, part: int) -> Scored:
    """What noise alone would leave of the balance: that of the measured effort, by its second differences, in which no
    motion is left."""
    scored = found.explained.scored(part)
    noise = float(np.mean(np.diff(found.explained.rows.effort, n=2) ** 2) / 6.0)
    return replace(scored, squares=noise * scored.counts)


def _named(found: Found, part: int, floor: Scored) -> tuple[NamedEffect, ...]:
    torques, out = found.explained.torques, []
    base, after = found.base.scored(part), found.explained.scored(part)
    for torque in torques:
        for k, effect in enumerate(torque.effects):
            less = (torque.without(k) if t is torque else t for t in torques)
            without = Explained(found.base.rows, tuple(t for t in less if t is not None)).scored(part)
            gain, _ = share_of_removable(base, without, after, floor)
            out.append(NamedEffect(effect, gain, found.equivalent.get(torque.name, ())))
    return tuple(out)


def _candidates(found: Found) -> tuple[CandidateScore, ...]:
    taken, out = set(found.explained.torques), []
    for t in (t for tried in found.tried for t in tried):
        error = t.explained.scored(CHOICE).nrmse
        out.append(CandidateScore(t.torque.name, t.beside, error, t.against.delta_bic, t.torque in taken))
    return tuple(out)
