"""A model fitted to free runs of several lengths, where what it leaves is no noise.

Where the torque itself is given there is no noise of a supply that adds up along a run: what free runs leave are the
model's own errors, and how much they bias a parameter depends on where the runs happen to begin. On the EMPS axis cuts
of 0.5 and 0.52 s put the moving mass at 94.3 and 95.1 kg, each with 0.2 kg of standard deviation. The mean over several
lengths has less of that, and how far they lie apart is what a single one leaves unsaid.

A constant error of the torque adds up with the square of the time. Where longer runs err by more than that the motor
has run away from the simulation (over another detent of its cogging), and what is fitted to them follows that.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import fit_runs, honest
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.errors import NumericalError
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.precision.information import wider
from servo_daemon.identification.output_error.republished import republished, with_settled_states
from servo_daemon.samples import F64

#: So many lengths of the free runs, from that of the search to so many times it. Longer ones hold the slow part of an
#: error, which short runs take for a part of their initial states.
_CUTS, _LONGER = 5, 4.0
#: … and err by no more than so many times what a constant torque adds up to (cogging on samples of 200 Hz: 5 to 10).
_RUN_AWAY = 2.0
#: No longer than this, s: a run of many seconds with dry friction has valleys of its own (chosen; not tried).
_LONGEST_S = 4.0


def mean_over_cuts(data: Data, trial: Trial, fit: OutputErrorFit) -> OutputErrorFit:
    """The fit, or, if noise does not explain what it leaves and the model is driven by its torque or current, the mean
    of such fits over several lengths of the free runs, in the parameters' coordinates.

    Args:
        fit: of the trial's model to the full data.
    """
    problem = fit.problem
    if fit.white or problem.plant.drive == "voltage" or problem.local or "gap" in problem.free:
        return fit
    known = [k for k in range(problem.n_shared) if not fit.after.undetermined[k]]
    estimates = _estimates(data, trial, fit)
    if not known or len(estimates) < _CUTS:
        return fit
    unknowns = fit.solution.point.unknowns.copy()
    unknowns[known] = np.mean(estimates, axis=0)[known]
    settled = with_settled_states(problem, unknowns)
    if settled is None:
        return fit
    apart = np.std(estimates, axis=0, ddof=1)
    return honest(republished(fit, settled, wider(fit.after, {k: float(apart[k]) for k in known})))


def _estimates(data: Data, trial: Trial, fit: OutputErrorFit) -> list[F64]:
    """Shape (n_shared,) each, of the lengths that could be fitted; phases less than half a turn from the fit's."""
    n = fit.problem.n_shared
    here, phases = fit.solution.point.unknowns[:n], fit.problem.is_phase[:n]
    begin, shortest = {**trial.values, **fit.values}, data.split.segment_s
    out: list[F64] = []
    least: F64 | None = None  # error of the shortest runs
    for length in np.geomspace(shortest, max(shortest, min(_LONGER * shortest, _LONGEST_S)), _CUTS).tolist():
        with suppress(NumericalError):
            cut = fit_runs(data, trial, begin, length)
            error = np.sqrt(cut.solution.point.sse)
            least = error if least is None else least
            if cut.problem.free == fit.problem.free and np.all(error <= _RUN_AWAY * (length / shortest) ** 2 * least):
                found = cut.solution.point.unknowns[:n]
                turns = np.where(phases, np.round((found - here) / (2.0 * np.pi)), 0.0)
                out.append(found - 2.0 * np.pi * turns)
    return out
