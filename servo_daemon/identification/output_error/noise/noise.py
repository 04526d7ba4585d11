"""What noise there is: variances of the input's, the load torque's and the sensors' noise by maximum likelihood.

The likelihood is that of the innovations of `whitening`,

    −2 log p(e) = Σ log s + Σ ε²,      ε = innovation/√s

(Schweppe, *IEEE Trans. Inf. Theory* 11, 1965), minimised over the logarithms of the variances by Fisher scoring; the
derivatives of s and ε are differences, each a pass of the filter. A source of noise is used only if it raises the
likelihood by much more than chance does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.identification.output_error.noise.scoring import Axes, deviance, fisher_scoring
from servo_daemon.identification.output_error.noise.whitening import SOURCES, Prepared, Tangent, prepare
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import INPUT
from servo_daemon.numerics import STD_OF_MEDIAN
from servo_daemon.samples import F64

#: A source must lower −2 log p by more than this: chance does so once in 10⁵ (χ² with one degree of freedom).
WORTH = 20.0
#: Sources by index.
INPUT_NOISE, TORQUE_NOISE = range(SOURCES)
#: No noise is smaller than this share of its signal (in σ), nor larger than the signal.
_LEAST, _MOST = 1e-6, 1.0
#: Its square is still a number.
_TINY = 1e-100
#: σ of a source against its signal that are tried as a start.
_STARTS = (1e-4, 1e-3, 1e-2, 1e-1)
#: By which a log-variance is moved for a derivative, and its longest step.
DIFFERENCE, LONGEST = 1e-3, 3.0
#: Share of differences that must be multiples of the smallest for it to be the channel's step.
_STEPPED = 0.99
#: The smallest difference is at most so many steps; how near to a whole number counts as one.
_COARSEST, _WHOLE = 4, 0.02


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """White noises, 1 σ each.

    Attributes:
        input_std: of the applied voltage, held over a sample period, beyond what the recording shows, V.
        sensor_std: by channel, in its unit; never below what its steps make (step/√12).
        gain: by how much the voltage's noise lowers −2 log p.
    """

    input_std: float
    sensor_std: Mapping[str, float]
    gain: float


def noise_model(problem: Problem, log_variance: F64, gain: float) -> NoiseModel:
    """In the units of the signals."""
    sigma = np.exp(log_variance / 2).tolist()
    return NoiseModel(sigma[INPUT_NOISE], dict(zip(problem.channels, sigma[SOURCES:], strict=True)), gain)


@dataclass(frozen=True)
class NoiseLikelihood:
    """−2 log p of residuals as a function of the log-variances (of input, torque, then each channel), shape (2 + c,);
    −∞: a source that is not there.

    Attributes:
        prepared: per segment.
        alone: log-variances of the sensors if there is no other noise.
        local: log-variances of the sensors as neighbouring residuals show them.
        low, high: bounds of the log-variances.
    """

    prepared: Sequence[Prepared]
    alone: F64
    local: F64
    low: F64
    high: F64

    def innovations(self, log_variance: F64) -> tuple[F64, F64]:
        """ε and log s of all samples, shape (N,) each."""
        parts = [p.run(np.exp(log_variance)) for p in self.prepared]
        return (
            np.concatenate([p.values.ravel() for p in parts]),
            np.concatenate([p.log_variance.ravel() for p in parts]),
        )

    def value(self, log_variance: F64) -> float:
        return deviance(self.innovations(log_variance))

    def sensors_alone(self) -> F64:
        """Log-variances where no noise enters the motor."""
        return np.concatenate([np.full(SOURCES, -np.inf), np.clip(self.alone, self.low[SOURCES:], self.high[SOURCES:])])

    def with_source(self, a: F64, source: int) -> tuple[F64, float]:
        """The best with one source more than in `a`, and −2 log p there."""
        start = a.copy()
        if not np.isfinite(a[:SOURCES]).any():  # so far the sensors answered for everything
            start[SOURCES:] = np.clip(self.local, self.low[SOURCES:], self.high[SOURCES:])
        trials = []
        for share in _STARTS:
            start[source] = self.high[source] + 2 * np.log(share / _MOST)
            trials.append((self.value(start), start.copy()))
        return self.refine(min(trials, key=lambda t: t[0])[1])

    def refine(self, start: F64) -> tuple[F64, float]:
        """The best near variances found before, and −2 log p there."""
        return self.maximise(start, np.flatnonzero(start > -np.inf).tolist())

    def maximise(self, start: F64, free: Sequence[int]) -> tuple[F64, float]:
        """Fisher scoring from `start` over the log-variances `free`; the others stay.

        Returns:
            the log-variances and −2 log p there.
        """
        k = len(start)
        axes = Axes(self.low, self.high, np.full(k, DIFFERENCE), np.full(k, LONGEST))
        found = fisher_scoring(self.innovations, start, free, axes)
        return found.at, found.value


def bounds(problem: Problem, torque_size: float) -> tuple[F64, F64]:
    """Of the log-variances: from a millionth of the signal, or its steps, to the signal."""
    u = np.concatenate([s.rows[:, INPUT] for s in problem.segments])
    size = np.array([max(float(np.sqrt(np.mean(u * u))), 1e-300), max(torque_size, 1e-300), *problem.spread])
    low = np.maximum(_LEAST * size, _TINY)
    low[SOURCES:] = np.maximum(low[SOURCES:], resolution(problem) / np.sqrt(12.0))
    return 2 * np.log(low), 2 * np.log(np.maximum(_MOST * size, low))


def _multiples(ratio: F64) -> float:
    """Share of whole numbers."""
    return float(np.mean(np.abs(ratio - np.round(ratio)) < _WHOLE))


def resolution(problem: Problem) -> F64:
    """Step of each channel's values, shape (c,); 0 where they are no multiples of one."""
    out = np.zeros(len(problem.channels))
    for c in range(len(out)):
        values = np.concatenate([s.measured[s.valid[:, c], c] for s in problem.segments])
        d = np.diff(np.unique(values))
        d = d[d > 1e-9 * max(float(np.ptp(values)), 1e-300)]
        # The smallest difference may be two or three steps, where nothing is slow.
        steps = [d.min() / m for m in range(1, _COARSEST + 1)] if len(d) else []
        out[c] = next((step for step in steps if _multiples(d / step) > _STEPPED), 0.0)
    return out


def likelihood_of(
    models: Sequence[Tangent], weights: Sequence[F64], residuals: Sequence[F64], limits: tuple[F64, F64]
) -> NoiseLikelihood:
    """Of residuals, shape (n, c) per segment.

    Args:
        models: per segment, see `whitening.tangent`.
        weights: per segment, shape (n, c), 0 where not valid.
        limits: see `bounds`.
    """
    counts = np.sum([(w > 0).sum(axis=0) for w in weights], axis=0)
    squares = np.sum([(w * r * r).sum(axis=0) for w, r in zip(weights, residuals, strict=True)], axis=0)
    alone = np.log(np.maximum(squares / np.maximum(counts, 1), 1e-300))
    second = np.concatenate([np.diff(r, 2, axis=0) for r in residuals])
    local = 2 * np.log(np.maximum(STD_OF_MEDIAN / np.sqrt(6.0) * np.median(np.abs(second), axis=0), 1e-300))
    parts = zip(models, weights, residuals, strict=True)
    return NoiseLikelihood(tuple(prepare(m, w, r[:, :, None]) for m, w, r in parts), alone, local, *limits)
