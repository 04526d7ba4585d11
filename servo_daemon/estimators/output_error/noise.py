"""What noise there is: variances of the input's, the load torque's and the sensors' noise by maximum likelihood.

The likelihood is that of the innovations of `whitening`,

    −2 log p(e) = Σ log s + Σ ε²,      ε = innovation/√s

(Schweppe, *IEEE Trans. Inf. Theory* 11, 1965), minimised over the logarithms of the variances by Fisher scoring; the
derivatives of s and ε are differences, each a pass of the filter. A source of noise is used only if it raises the
likelihood by much more than chance does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.estimators.output_error.problem import Problem
from servo_daemon.estimators.output_error.rollout import INPUT
from servo_daemon.estimators.output_error.whitening import SOURCES, whiten
from servo_daemon.samples import F64

#: A source must lower −2 log p by more than this: chance does so once in 10⁵ (χ² with one degree of freedom).
WORTH = 20.0
#: Sources, in the order in which they are tried.
SOURCE_NAMES = ("input", "torque")
#: No noise is smaller than this share of its signal (in σ), nor larger than the signal.
_LEAST, _MOST = 1e-6, 1.0
#: σ of a source against its signal that are tried as a start.
_STARTS = (1e-4, 1e-3, 1e-2, 1e-1)
_DIFFERENCE, _LONGEST, _ENOUGH, _ROUNDS = 1e-3, 3.0, 1e-2, 30
#: Share of differences that must be multiples of the smallest for it to be the channel's step.
_STEPPED = 0.99


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """White noises, 1 σ each.

    Attributes:
        sources: in use, some of "input", "torque".
        input: of the model's input, held over a sample period; V, A or N·m as the input is.
        torque: of a load torque, held over a sample period, N·m.
        sensors: by channel, in its unit; never below what its steps make (step/√12).
        gain: by how much the sources lower −2 log p.
    """

    sources: tuple[str, ...]
    input: float
    torque: float
    sensors: dict[str, float]
    gain: float


@dataclass(frozen=True)
class NoiseLikelihood:
    """−2 log p of residuals as a function of the log-variances (of input, torque, then each channel).

    Attributes:
        models: per segment, see `whitening.tangent`.
        weights: per segment, shape (n, c), 0 where not valid.
        residuals: per segment, shape (n, c).
        low, high: bounds of the log-variances, shape (2 + c,).
    """

    models: Sequence[F64]
    weights: Sequence[F64]
    residuals: Sequence[F64]
    low: F64
    high: F64

    def innovations(self, log_variance: F64) -> tuple[F64, F64]:
        """ε and log s of all samples, shape (N,) each."""
        variance = np.where(log_variance > -np.inf, np.exp(log_variance), 0.0)
        parts = [
            whiten(m, w, r[:, :, None], variance)
            for m, w, r in zip(self.models, self.weights, self.residuals, strict=True)
        ]
        return (
            np.concatenate([p.values.ravel() for p in parts]),
            np.concatenate([p.log_variance.ravel() for p in parts]),
        )

    def value(self, log_variance: F64) -> float:
        return _value(*self.innovations(log_variance))

    def maximise(self, start: F64, free: Sequence[int]) -> tuple[F64, float]:
        """Fisher scoring from `start` over the log-variances `free`; the others stay.

        Returns:
            the log-variances and −2 log p there.
        """
        a, damping = start.copy(), 0.0
        here = self.innovations(a)
        for _ in range(_ROUNDS):
            g, H = self._derivatives(a, here, free)
            held = (a[free] <= self.low[free]) & (g > 0) | (a[free] >= self.high[free]) & (g < 0)
            open_ = np.flatnonzero(~held)
            if not len(open_):
                break
            A = H[np.ix_(open_, open_)]
            step = np.zeros(len(free))
            ridge = (damping + 1e-9) * np.maximum(np.diag(A), 1e-9)
            step[open_] = -np.linalg.solve(A + np.diag(ridge), g[open_])
            step *= min(1.0, _LONGEST / max(float(np.max(np.abs(step))), 1e-300))
            if -float(g @ step) < _ENOUGH:
                break
            trial = a.copy()
            trial[free] = np.clip(a[free] + step, self.low[free], self.high[free])
            there = self.innovations(trial)
            if _value(*there) < _value(*here):
                a, here, damping = trial, there, damping / 10
            else:
                damping = max(10 * damping, 1e-2)
                if damping > 1e6:
                    break
        return a, _value(*here)

    def _derivatives(self, a: F64, here: tuple[F64, F64], free: Sequence[int]) -> tuple[F64, F64]:
        """Gradient and expected Hessian of −2 log p."""
        e, logs = here
        d_e, d_logs = np.empty((len(free), len(e))), np.empty((len(free), len(e)))
        for row, k in enumerate(free):
            moved = a.copy()
            moved[k] += _DIFFERENCE
            e1, logs1 = self.innovations(moved)
            d_e[row], d_logs[row] = (e1 - e) / _DIFFERENCE, (logs1 - logs) / _DIFFERENCE
        g = d_logs.sum(axis=1) + 2 * d_e @ e
        raw = d_e + 0.5 * e * d_logs  # of the innovation itself, in units of √s
        return g, d_logs @ d_logs.T + 2 * raw @ raw.T


def _value(e: F64, logs: F64) -> float:
    return float(logs.sum() + e @ e)


def bounds(problem: Problem, torque_size: float) -> tuple[F64, F64]:
    """Of the log-variances: from a millionth of the signal, or its steps, to the signal."""
    u = np.concatenate([s.rows[:, INPUT] for s in problem.segments])
    size = np.array([max(float(np.sqrt(np.mean(u * u))), 1e-300), max(torque_size, 1e-300), *problem.spread])
    low = _LEAST * size
    low[SOURCES:] = np.maximum(low[SOURCES:], resolution(problem) / np.sqrt(12.0))
    return 2 * np.log(low), 2 * np.log(np.maximum(_MOST * size, low))


def resolution(problem: Problem) -> F64:
    """Step of each channel's values, shape (c,); 0 where they are no multiples of one."""
    out = np.zeros(len(problem.channels))
    for c in range(len(out)):
        values = np.concatenate([s.measured[s.valid[:, c], c] for s in problem.segments])
        d = np.diff(np.unique(values))
        d = d[d > 1e-9 * max(float(np.ptp(values)), 1e-300)]
        if len(d):
            ratio = d / d.min()
            out[c] = d.min() if np.mean(np.abs(ratio - np.round(ratio)) < 0.05) > _STEPPED else 0.0
    return out


def fit_noise(
    problem: Problem, likelihood: NoiseLikelihood, sources: Sequence[int], start: F64 | None = None
) -> tuple[NoiseModel, F64]:
    """The variances of the sensors and of those sources that earn their place.

    Args:
        sources: which of `SOURCE_NAMES` may be used, by index.
        start: log-variances found before: their sources are kept.
    """
    sensors = list(range(SOURCES, len(likelihood.low)))
    alone = np.full(len(likelihood.low), -np.inf)
    counts, squares = _sums(likelihood)
    alone[sensors] = np.clip(
        np.log(np.maximum(squares / np.maximum(counts, 1), 1e-300)), likelihood.low[sensors], likelihood.high[sensors]
    )
    plain = likelihood.value(alone)
    if start is not None:
        best, value = _settled(likelihood, start, sensors)
    else:
        best, value = alone, plain
        for k in sources:
            trial, trial_value = likelihood.maximise(_guess(likelihood, best, k), _free(best, k, sensors))
            if trial_value < value - WORTH:
                best, value = trial, trial_value
    sigma = np.exp(best / 2)
    names = tuple(SOURCE_NAMES[k] for k in range(SOURCES) if best[k] > -np.inf)
    by_channel = dict(zip(problem.channels, sigma[SOURCES:].tolist(), strict=True))
    return NoiseModel(names, float(sigma[0]), float(sigma[1]), by_channel, plain - value), best


def _settled(likelihood: NoiseLikelihood, start: F64, sensors: list[int]) -> tuple[F64, float]:
    """From variances found before; a source that is not worth its place any more goes."""
    used = [k for k in range(SOURCES) if start[k] > -np.inf]
    best, value = likelihood.maximise(start, [*used, *sensors])
    for k in used[1:]:
        fewer = best.copy()
        fewer[k] = -np.inf
        fewer, fewer_value = likelihood.maximise(fewer, [*(m for m in used if m != k), *sensors])
        if fewer_value < value + WORTH:
            best, value = fewer, fewer_value
    return best, value


def _free(best: F64, k: int, sensors: list[int]) -> list[int]:
    return sorted({k, *(m for m in range(SOURCES) if best[m] > -np.inf)}) + sensors


def _guess(likelihood: NoiseLikelihood, best: F64, k: int) -> F64:
    """The best of some sizes of source k, the sensors' noise as neighbouring residuals show it."""
    start = best.copy()
    for c in range(SOURCES, len(start)):
        second = np.concatenate([np.diff(r[:, c - SOURCES], 2) for r in likelihood.residuals])
        size = 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6.0)
        start[c] = np.clip(2 * np.log(max(size, 1e-300)), likelihood.low[c], likelihood.high[c])
    trials = []
    for share in _STARTS:
        trial = start.copy()
        trial[k] = likelihood.high[k] + 2 * np.log(share / _MOST)
        trials.append((likelihood.value(trial), share, trial))
    return min(trials, key=lambda t: t[:2])[2]


def _sums(likelihood: NoiseLikelihood) -> tuple[F64, F64]:
    """Valid samples and weighted squares by channel."""
    counts = np.sum([(w > 0).sum(axis=0) for w in likelihood.weights], axis=0)
    pairs = zip(likelihood.weights, likelihood.residuals, strict=True)
    return counts, np.sum([(w * r * r).sum(axis=0) for w, r in pairs], axis=0)
