"""How well fits predict each sample from those before it, over the times of one part."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.trial.compare import surely_positive
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import fit_whole
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.noise_floor import measured_levels
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import CHOICE
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.noise.whitening import tangents, whiten
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.samples import F64

#: Per recording, shape (n,): which of the free runs its samples are in, of those of one part (−1: none).
Times = tuple[NDArray[np.int64], ...]
#: A model, and its fit to all that may be seen.
Seen = tuple[Trial, OutputErrorFit]


def times_of(data: Data, effects: tuple[str, ...], part: int) -> Times:
    """Of a part of the search's own division. What a recording begins with is in none: a fit begins there."""
    segments = data.problem(effects, {}).segments
    out = [np.full(len(r.block), -1, dtype=np.int64) for r in data.recordings]
    for k in data.split.of(part).tolist():
        segment = segments[k]
        if segment.begin > 0:
            out[segment.recording][segment.begin : segment.begin + len(segment.rows)] = k
    return tuple(out)


@dataclass(frozen=True, slots=True)
class Predicted:
    """Prediction errors over the times of a part, by free run, h of them, c channels.

    Attributes:
        deviance: shape (h,), −2 log p given all that came before each sample.
        errors: squares of the innovations.
        expected: the same as noise of the levels that the signals show makes them.
    """

    deviance: F64
    errors: Scored
    expected: Scored


def predicted(fit: OutputErrorFit, times: Times, levels: NoiseLevels) -> Predicted | None:
    """What a fit predicts of these times, whether it has seen them or not; None: there are none, or it has no noise to
    predict with.

    Args:
        levels: of the noise that is expected.
    """
    n, likeliest = max(int(runs.max()) for runs in times) + 1, fit.likeliest
    if likeliest is None or n == 0:
        return None
    problem = _with_all(fit.problem)
    unknowns = likeliest.point.unknowns
    noise = np.array([levels.input_var, 0.0, *(levels.channel_var[c] for c in problem.channels)])
    residuals = linearise(problem, unknowns).residuals
    deviance, squares, expected, counts = np.zeros(n), *(np.zeros((n, len(problem.channels))) for _ in range(3))
    for segment, model, r in zip(problem.segments, tangents(problem, unknowns), residuals, strict=True):
        weights = segment.valid.astype(float)
        out = whiten(model, weights, r[:, :, None], np.exp(likeliest.log_variance))
        best = whiten(model, weights, r[:, :, None], noise)
        white = out.values[:, :, 0]
        variance, least = (np.where(segment.valid, np.exp(x.log_variance), 0.0) for x in (out, best))
        runs = times[segment.recording][segment.begin : segment.begin + len(segment.rows)]
        use, at = runs >= 0, runs[runs >= 0]
        np.add.at(deviance, at, (out.log_variance + white**2)[use].sum(axis=1))
        np.add.at(squares, at, (white**2 * variance)[use])
        np.add.at(expected, at, least[use])
        np.add.at(counts, at, segment.valid[use].astype(float))
    there = counts.sum(axis=1) > 0
    errors = Scored(squares[there], counts[there], problem.spread)
    return Predicted(deviance[there], errors, replace(errors, squares=expected[there]))


def _with_all(problem: Problem) -> Problem:
    """The problem with all that was measured in the same segments."""
    return replace(problem, segments=tuple(replace(s, valid=np.isfinite(s.measured)) for s in problem.segments))


def predictions_of_both(data: Data, simple: Seen, rich: Seen) -> tuple[Predicted, Predicted] | None:
    """What two models predict of the part that the gain is measured on; None: of the part that decides the richer does
    not predict better where neither fit has seen it (95 %, resampled), or it cannot be told."""
    deciding = times_of(data, simple[0].effects, CHOICE)
    levels = measured_levels(longest_missing(data, rich[1]))
    less = [_fitted_without(data, *model, deciding) for model in (simple, rich)]
    # A model that is far off may not settle on less: as fitted to all of this it has seen what it predicts.
    fits = [less[0] or simple[1], less[1]]
    before, after = (None if f is None else predicted(f, deciding, levels) for f in fits)
    if before is None or after is None or not surely_positive(before.deviance - after.deviance):
        return None
    if data.split.measuring == CHOICE:
        return before, after
    measuring = times_of(data, simple[0].effects, data.split.measuring)
    seen = [f if f.likeliest is not None else other for (_, f), other in zip((simple, rich), fits, strict=True)]
    before, after = (None if f is None else predicted(f, measuring, levels) for f in seen)
    return None if before is None or after is None else (before, after)


def _fitted_without(data: Data, trial: Trial, fit: OutputErrorFit, times: Times) -> OutputErrorFit | None:
    """The model fitted without these times either, from where the fit to all that may be seen has come to."""
    marks = [np.ones(len(r.block), dtype=bool) if r.seen is None else r.seen for r in data.recordings]
    seen = tuple(replace(r, seen=m & (runs < 0)) for r, m, runs in zip(data.recordings, marks, times, strict=True))
    part = fit_whole(replace(data, recordings=seen), trial, fit.values)
    return part if part is not None and part.likeliest is not None else None
