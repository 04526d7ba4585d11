"""The motor that `tune` designs for: from a capture, as far as that goes, else from nominal and fixed values.

A capture with voltage, current and motion tells all five parameters, as they are at its end: the daemon's own pipeline.
One without a current sensor tells no single one of them, but all of what a loop that measures the angle alone can see:
the speed's answer to the voltage. The motor is then any one of those with that answer; gains and margins are the same
for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from servo_daemon.commands.shared import common
from servo_daemon.config import DriveConfig
from servo_daemon.errors import BadInputError, TuningError
from servo_daemon.published.snapshot import Covariance, Estimate, ParameterEstimate
from servo_daemon.tuning.knowledge import NEEDED, Coefficient, MotorKnowledge, motor_with_answer

if TYPE_CHECKING:
    from servo_daemon.captures import Capture
    from servo_daemon.identification.output_error import OutputErrorFit
    from servo_daemon.identification.output_error.precision.combinations import VoltageAnswer

#: A residual of this share of the signal's spread, and not white, is worth a word.
_LEFT = 0.02
#: Components of null directions are rounded to this.
_ROUNDED = 0.02
#: In this order parameters are easily had: a multimeter, a datasheet, …
_EASY = ("R", "K", "L", "J", "B")


def known_motor(drive: DriveConfig, capture: Capture | None, fixed: Mapping[str, float]) -> MotorKnowledge:
    """The motor.

    Args:
        fixed: values that the user gave; they win.

    Raises:
        TuningError: too little is known; the text says what is missing and where it may come from.
        BadInputError: the capture cannot be used.
    """
    if capture is None:
        return _nominal(drive, fixed)
    meaning = capture.meaning(drive.signals.meaning())
    try:
        if "current_A" in capture.channels:
            return _tracked(drive, capture, fixed)
    except TuningError:  # too short for the daemon's filter, perhaps not for a fit
        if meaning.measures_voltage:
            raise
    return _fitted(drive, capture.as_dc(meaning), fixed)


def _nominal(drive: DriveConfig, fixed: Mapping[str, float]) -> MotorKnowledge:
    from servo_daemon.pipeline.publish import published_parameters
    from servo_daemon.published.knowledge import motor_knowledge

    parameters = [
        ParameterEstimate(p.name, drive.nominal.get(p.name), None, p.unit, drive.nominal.get(p.name), "fixed")
        for p in published_parameters(drive)
    ]
    try:
        return motor_knowledge(parameters, None, drive.model, {}, "nominal", fixed)
    except TuningError as error:
        raise TuningError(f"{error}; a CAPTURE, --fix P=v or [drive.nominal] of --config give it") from error


def _tracked(drive: DriveConfig, capture: Capture, fixed: Mapping[str, float]) -> MotorKnowledge:
    """As the daemon would know it at the capture's end."""
    from servo_daemon.published.knowledge import motor_knowledge

    e = _estimate(capture, drive)
    return motor_knowledge(e.parameters, e.covariance, e.model, e.state, "capture", fixed)


def _estimate(capture: Capture, drive: DriveConfig) -> Estimate:
    """The motor at the end of a capture: the daemon's own pipeline over it.

    Raises:
        BadInputError: the capture is too short to say anything.
    """
    from servo_daemon.pipeline.pipeline import Pipeline

    meaning = capture.meaning(drive.signals.meaning())
    pipeline = Pipeline(drive, common.capture_info(capture), meaning=meaning)
    with common.progress(capture.duration_s, "s", "estimating") as bar:
        for block in capture.blocks(common.BLOCK_SAMPLES):
            pipeline.process(block, rows=False)
            bar.update(float(block.time_s[-1] - block.time_s[0]))
    estimate = pipeline.finish() or pipeline.current()
    if estimate is None:
        raise BadInputError(f"{capture.path}: too short to estimate anything from")
    return estimate


def _fitted(drive: DriveConfig, capture: Capture, fixed: Mapping[str, float]) -> MotorKnowledge:
    """The motor as the mean over a capture: output error."""
    from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error

    nominal = {name: value for name, value in drive.nominal.items() if name != "J_m"}
    fit = fit_output_error([Recording(str(capture.path), capture.block())], drive.model, FitOptions(nominal, fixed))
    for name, spread in zip(fit.problem.channels, fit.problem.spread, strict=True):
        if not fit.white and fit.residual[name].rmse > _LEFT * spread:
            share = fit.residual[name].rmse / spread
            common.note(
                f"{capture.path}: the model leaves {100 * share:.2g} % of {name}, more than noise: an effect is "
                'missing (model = ["coulomb_friction"] in --config?), and the gains are for another motor than this one'
            )
    return fitted_motor(drive, fit, fixed, str(capture.path))


def fitted_motor(drive: DriveConfig, fit: OutputErrorFit, fixed: Mapping[str, float], where: str) -> MotorKnowledge:
    """The motor of a fit.

    Args:
        where: the data, for messages.

    Raises:
        TuningError: too little is known.
    """
    from servo_daemon.published.knowledge import motor_knowledge

    nominal = {name: value for name, value in drive.nominal.items() if name != "J_m"}
    if fit.answer is not None and any(fit.parameters[n].status == "undetermined" for n in NEEDED):
        return _by_answer(fit, fit.answer)
    parameters = [
        ParameterEstimate(
            name,
            p.value,
            p.std,
            p.unit,
            nominal.get(name),
            "tracking" if p.std is not None else "estimating",
            "not determined by this capture" if p.status == "undetermined" else None,
        )
        for name, p in fit.parameters.items()
    ]
    known = [name for name in fit.after.names if fit.parameters[name].std is not None]
    try:
        return motor_knowledge(parameters, _covariance(fit, known), fit.problem.plant.effects, {}, "capture", fixed)
    except TuningError as error:
        enough = ",".join(f"{name}=…" for name in _to_be_given(fit))
        raise TuningError(
            f"{where}: {error}; --fix {enough} (or [drive.nominal] of --config) would do, or a capture with "
            "more motion or more signals"
        ) from error


def _covariance(fit: OutputErrorFit, names: Sequence[str]) -> Covariance:
    rows = [fit.after.names.index(name) for name in names]
    values = fit.after.covariance[np.ix_(rows, rows)].tolist()
    return Covariance(tuple(names), tuple(tuple(row) for row in values))


def _by_answer(fit: OutputErrorFit, answer: VoltageAnswer) -> MotorKnowledge:
    from servo_daemon.identification.procedure.validate import natural_values

    values = natural_values(fit)
    torques = [p.name for p in fit.problem.plant.parameters if p.unit == "N·m"]
    return motor_with_answer(
        tuple(Coefficient(c.expression, c.value, c.std, c.unit) for c in answer.coefficients),
        answer.covariance,
        fit.problem.plant.effects,
        {name: values[name] * values["R"] / values["K"] for name in torques},
    )


def _to_be_given(fit: OutputErrorFit) -> tuple[str, ...]:
    """The fewest of R, L, K, J, B that must be given so that no null direction is left among them."""
    absent = [n for n in NEEDED if n not in fit.problem.plant.parameter_names]
    lost = [n for n in _EASY if n in fit.after.names and fit.parameters[n].std is None]
    rows = np.array([[d.components.get(n, 0.0) for n in lost] for d in fit.null_directions])
    rows = rows.reshape(len(fit.null_directions), len(lost))  # also where there are none of both
    rank = np.linalg.matrix_rank(rows, tol=_ROUNDED) if rows.size else 0
    for size in range(rank, len(lost)):
        for chosen in combinations(range(len(lost)), size):
            if np.linalg.matrix_rank(rows[:, list(chosen)], tol=_ROUNDED) == rank:
                return tuple(n for n in NEEDED if n in absent or n in [lost[k] for k in chosen])
    return tuple(n for n in NEEDED if n in absent or n in lost)
