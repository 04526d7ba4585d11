"""What document and report of `diagnose` show beside the diagnosis itself: free runs over whole captures, and the
missing torque and voltage that the named effects answer for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.missing import Missing, NoiseLevels, missing_inputs
from servo_daemon.diagnosis.result import Diagnosis
from servo_daemon.errors import ServoDaemonError
from servo_daemon.estimators.base import to_coordinate
from servo_daemon.estimators.output_error import OutputErrorFit
from servo_daemon.estimators.output_error.score import Score
from servo_daemon.identification.validate import natural_values, scored
from servo_daemon.samples import F64

#: Working torques (voltages) are alike within this factor.
_ANOTHER = 1.5


@dataclass(frozen=True)
class Evidence:
    """Beside a diagnosis.

    Attributes:
        free_runs: of each capture: one run over all of it and runs of 1 s, of the baseline and of the extended model
            (None: there is none). The models were fitted to these captures.
        longest: number of the capture that the missing torque and voltage are of.
        asked: what is missing when the baseline has the motor of the extended model: what the named effects have to
            answer for. The baseline's own fit hides a part of it in bent parameters. None: nothing was named, or it
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
    asked = _smoothed(d, longest, d.baseline, _motor_of_extended(d, d.extended), _intensities(d, d.after))
    if asked is None:
        return Evidence(runs, longest, None, d.after)
    left = _smoothed(d, longest, d.extended, d.after.coordinates, asked.levels)
    return Evidence(runs, longest, asked, left or d.after)


def _smoothed(
    d: Diagnosis, longest: int, fit: OutputErrorFit, coordinates: F64, levels: NoiseLevels | None
) -> Missing | None:
    """What a model misses; None where it cannot be simulated."""
    try:
        return missing_inputs(
            fit, d.captures[longest].block(), recording=longest, coordinates=coordinates, levels=levels
        )
    except ServoDaemonError:  # a picture less
        return None


def _intensities(d: Diagnosis, after: Missing) -> NoiseLevels | None:
    """The baseline's, unless the extended model's motor works with quite another torque: where no current is measured
    a fit's torques may be of any size, and intensities are torques. None: to be found anew."""
    alike = all(1 / _ANOTHER < after.size[name] / size < _ANOTHER for name, size in d.before.size.items())
    return d.before.levels if alike else None


def _motor_of_extended(d: Diagnosis, extended: OutputErrorFit) -> F64:
    """Coordinates of the baseline's plant as `Missing.coordinates` has them."""
    values = natural_values(d.baseline) | natural_values(extended)
    plant = d.before.augmented.plant
    return np.array([to_coordinate(p, values[p.name]) if p.name in values else 0.0 for p in plant.parameters])
