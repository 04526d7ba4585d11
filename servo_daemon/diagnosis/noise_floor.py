"""What noise alone would leave of the held-out parts: the chosen model simulated with the noise that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.diagnosis.select import Selection
from servo_daemon.estimators.output_error import OutputErrorFit
from servo_daemon.estimators.output_error.problem import Segment
from servo_daemon.estimators.output_error.rollout import INPUT, free_run
from servo_daemon.estimators.output_error.solver import solve
from servo_daemon.samples import F64

_SEED = 11


def noise_floor_nrmse(fit: OutputErrorFit, selection: Selection) -> float:
    """n of the contract, as `Trial.nrmse`.

    Each held-out free run of the chosen model is made anew with noise on its input and on its sensors, of the sizes that
    the fit found (without a noise model: those of the residual's fast part), and scored like a measured one.
    """
    trial = selection.chosen
    problem, rng = trial.test, np.random.default_rng(_SEED)
    input_std = fit.noise.input_std if fit.noise is not None else 0.0
    sensor = np.array([_sensor_std(fit, name, k) for k, name in enumerate(problem.channels)])
    given = dict(problem.given) | _values(selection)
    states = replace(problem, free=(), local=(), given=given)
    clean = solve(states, states.start({}), robust=False, max_iterations=12)
    if clean is None:
        return 0.0
    segments = []
    for k, segment in enumerate(states.segments):
        x0 = states.initial_state(clean.point.unknowns, k)
        q = states.coordinates(clean.point.unknowns, segment.recording)
        noisy_rows = segment.rows.copy()
        noisy_rows[:, INPUT] += rng.normal(0.0, input_std, len(noisy_rows)) if input_std else 0.0
        shown, _ = free_run(states.plant, states.channels, q, x0, noisy_rows)
        measured = shown + rng.normal(0.0, 1.0, shown.shape) * sensor
        segments.append(replace(segment, measured=measured, x0=x0))
    again = replace(states, segments=tuple(segments))
    found = solve(again, again.start({}), robust=False, max_iterations=12)
    return 0.0 if found is None else _nrmse(found.point.linearisation.residuals, tuple(segments), problem.spread)


def _values(selection: Selection) -> dict[str, float]:
    trial = selection.chosen
    logs = {p.name: p.transform == "log" for p in trial.test.plant.parameters}
    return {n: float(np.log(v)) if logs[n] else v for n, v in trial.values.items()}


def _sensor_std(fit: OutputErrorFit, name: str, column: int) -> float:
    if fit.noise is not None:
        return fit.noise.sensor_std[name]
    residuals = fit.solution.point.linearisation.residuals
    fast = np.concatenate([np.diff(r[:, column], n=2) for r in residuals if len(r) > 2])
    return float(np.median(np.abs(fast))) * 1.4826 / np.sqrt(6.0)


def _nrmse(residuals: tuple[F64, ...], segments: tuple[Segment, ...], spread: F64) -> float:
    squares = np.sum([(r * r).sum(axis=0) for r in residuals], axis=0)
    counts = np.sum([s.valid.sum(axis=0) for s in segments], axis=0)
    return float(np.sqrt(np.mean(squares / np.maximum(counts, 1) / spread**2)))
