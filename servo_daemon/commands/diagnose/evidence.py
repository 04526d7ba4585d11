"""What document and report of `diagnose` show beside the diagnosis itself: free runs over whole captures, and the
unmodelled torque and voltage that the named effects answer for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing, NoiseLevels, missing_inputs
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.errors import ServoDaemonError
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.problem.score import Score
from servo_daemon.identification.procedure.validate import natural_values, scored
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.samples import F64

#: Working torques (voltages) are alike within this factor.
_ANOTHER = 1.5


@dataclass(frozen=True)
class Evidence:
    """Beside a diagnosis.

    Attributes:
        free_runs: of each capture: one run over all of it and runs of 1 s, of the baseline and of the extended model
            (None: there is none). The models were fitted to these captures.
        longest: number of the capture that the unmodelled torque and voltage are of.
        asked: what is missing when the baseline has the motor of the extended model: what the named effects have to
            answer for. The baseline's own fit hides a part of it in biased parameters. None: nothing was named, or it
            cannot be simulated.
        left: what is missing beside the named effects, smoothed like `asked`. With intensities of its own a model that
            errs everywhere a little calls that noise, and what is missing comes out as nothing.
    """

    free_runs: tuple[tuple[Score, Score | None], ...]
    longest: int
    asked: Missing | None
    left: Missing | None


def gather_evidence(d: Diagnosis) -> Evidence:
    """Run the models over the captures once more."""
    runs = tuple((scored(c, d.baseline), None if d.extended is None else scored(c, d.extended)) for c in d.captures)
    longest = int(np.argmax([len(c) for c in d.captures]))
    if d.extended is None or d.after is None:
        return Evidence(runs, longest, None, None)
    motor = _motor_of_extended(d, d.extended)
    levels = _intensities(d, d.after, motor, longest)
    if levels is None:
        return Evidence(runs, longest, None, d.after)
    asked = _smoothed(d, longest, d.baseline, motor, levels)
    return Evidence(runs, longest, asked, _smoothed(d, longest, d.extended, d.after.coordinates, levels) or d.after)


def has_other_torques(d: Diagnosis, evidence: Evidence) -> bool:
    """Whether the baseline's torques are of quite another size than the extended model's, so that nothing missing of
    the one compares with the other."""
    return evidence.asked is not None and evidence.asked.levels != d.before.levels


def _smoothed(
    d: Diagnosis, longest: int, fit: OutputErrorFit, coordinates: F64, levels: NoiseLevels | None
) -> Missing | None:
    """What a model misses; None where it cannot be simulated."""
    block = d.captures[longest].block()
    try:
        return missing_inputs(fit, block, recording=longest, coordinates=coordinates, levels=levels)
    except ServoDaemonError:  # a picture less
        return None


def _intensities(d: Diagnosis, after: Missing, motor: F64, longest: int) -> NoiseLevels | None:
    """The baseline's, unless the extended model's motor works with quite another torque: where no current is measured
    a fit's torques may be of any size, and intensities are torques. Then walks are no slower than the baseline's as
    shares of what either motor works with, nor than what is likeliest with the effects left out; and noise is what the
    model that needs less of it needs. None: they cannot be found.

    Args:
        motor: of the extended model, for the baseline's plant.
    """
    share = {name: after.size[name] / size for name, size in d.before.size.items()}
    if all(1 / _ANOTHER < s < _ANOTHER for s in share.values()):
        return d.before.levels
    likeliest = _smoothed(d, longest, d.baseline, motor, None)
    if likeliest is None:
        return None
    one, other = likeliest.levels, after.levels
    return NoiseLevels(
        {name: max(walk, share[name] ** 2 * d.before.levels.walk[name]) for name, walk in one.walk.items()},
        min(one.input_var, other.input_var),
        {name: min(var, other.channel_var[name]) for name, var in one.channel_var.items()},
    )


def _motor_of_extended(d: Diagnosis, extended: OutputErrorFit) -> F64:
    """Coordinates of the baseline's plant as `Missing.coordinates` has them."""
    values = natural_values(d.baseline) | natural_values(extended)
    plant = d.before.augmented.plant
    return np.array([to_coordinate(p, values[p.name]) if p.name in values else 0.0 for p in plant.parameters])
