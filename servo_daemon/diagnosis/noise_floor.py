"""What noise alone would leave of free runs: the chosen model simulated with the noise that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.diagnosis.scored import Scored, scored_states
from servo_daemon.diagnosis.split import HELD_OUT
from servo_daemon.diagnosis.trial import Trial
from servo_daemon.estimators.output_error import OutputErrorFit
from servo_daemon.estimators.output_error.rollout import INPUT, free_run
from servo_daemon.estimators.output_error.solver import solve

_SEED = 11


def noise_floor(fit: OutputErrorFit, trial: Trial, part: int = HELD_OUT) -> Scored:
    """Errors of the free runs of a part if nothing but noise were left.

    Each is made anew by the trial's model with noise on its input and on its sensors, of the sizes that the fit found
    (without a noise model: those of the residual's fast part), and scored like a measured one.

    Args:
        fit: the same model fitted to everything, with its noise.
        trial: whose parameters hold.
        part: which free runs.
    """
    problem, rng = trial.states(part), np.random.default_rng(_SEED)
    input_std = fit.noise.input_std if fit.noise is not None else 0.0
    sensor = np.array([_sensor_std(fit, name, k) for k, name in enumerate(problem.channels)])
    found = solve(problem, problem.start({}), robust=False, max_iterations=8, curved=False)
    unknowns = problem.start({}) if found is None else found.point.unknowns
    segments, starts = [], problem.starts(unknowns, problem.carried(unknowns))
    for segment, x0 in zip(problem.segments, starts, strict=True):
        rows = segment.rows.copy()
        if input_std:
            rows[:, INPUT] += rng.normal(0.0, input_std, len(rows))
        shown, _ = free_run(problem.plant, problem.channels, problem.acting(unknowns, segment.recording), x0, rows)
        segments.append(replace(segment, measured=shown + rng.normal(size=shown.shape) * sensor, x0=x0))
    noisy = scored_states(replace(problem, segments=tuple(segments)))
    return replace(noisy, spread=problem.spread)


def _sensor_std(fit: OutputErrorFit, name: str, column: int) -> float:
    """In the channel's unit; without a noise model that of second differences, in which no motion is left."""
    if fit.noise is not None:
        return fit.noise.sensor_std[name]
    residuals = fit.solution.point.linearisation.residuals
    fast = np.concatenate([np.diff(r[:, column], n=2) for r in residuals if len(r) > 2])
    return float(np.sqrt(np.mean(np.square(fast)) / 6.0))
