"""What named effects leave of the unmodelled torque and voltage."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.missing.signals import motion_of
from servo_daemon.diagnosis.screening.dependence import LEAST_SIZE
from servo_daemon.diagnosis.search.evidence import working_shares
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.noise_floor import errs_by_noise
from servo_daemon.identification.output_error import OutputErrorFit

#: What is left where the motor moves is no more than this share of what the effects explain (right names of the
#: calibration set: at most 0.05, an eddy-current brake called Coulomb friction: 0.8), but for so many of the samples.
#: Impacts and first steps come a sample early or late in the best of models: what is left at moments is no sign.
_LEFT, _MOMENTS = 0.15, 0.02


def leaves_much(selection: Selection, before: Missing, extended: OutputErrorFit, missing: Missing) -> bool:
    """Whether more is left than noise: beside what the effects explain, and in free runs. What a slow winding lets
    through of its voltage's noise looks like a torque that is left."""
    if _left(missing) <= max(_LEFT * _explained(selection, before, missing), LEAST_SIZE):
        return False
    return not errs_by_noise(selection.data, extended, selection.chosen, missing)


def _left(missing: Missing) -> float:
    """RMS of what is missing where the motor moves, but for moments, as a share of what it works with: the larger of
    torque and voltage. Neither what its standard deviations explain is part of it, nor what a shaft that sticks keeps
    from showing."""
    moving = missing.seen & ~motion_of(missing).rest
    series = [(v[moving], missing.std[n][moving], missing.size[n]) for n, v in missing.series.items()]
    squares = [np.sort((v**2 - std**2) / size**2) for v, std, size in series]
    most = (float(np.mean(s[: max(round((1.0 - _MOMENTS) * len(s)), 1)])) for s in squares if len(s))
    return math.sqrt(max([0.0, *most]))


def _explained(selection: Selection, before: Missing, after: Missing) -> float:
    """The effects' torques and voltages as a share of what the motor works with; at least what is told by the missing
    series themselves."""
    left = after.mean_square
    by_series = [math.sqrt(max(was - left[n], 0.0)) for n, was in before.mean_square.items() if n in left]
    return max([*working_shares(selection.added, selection.chosen, after).values(), *by_series], default=0.0)


def removed_of_missing(before: Missing, after: Missing) -> float:
    """(b² − e²)/(b² − n²) of unmodelled torque and voltage, in mean squares beyond what their standard deviations
    explain."""
    room, taken = 0.0, 0.0
    for n, was in before.mean_square.items():
        left = after.mean_square.get(n, 0.0)
        noise = float(np.mean(np.square(after.std[n][after.seen]))) / before.size[n] ** 2 if n in after.std else 0.0
        room += max(was - min(noise, left), 0.0)
        taken += was - left
    return taken / room if room > 0.0 else 0.0
