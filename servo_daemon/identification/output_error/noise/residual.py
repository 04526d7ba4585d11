"""What the fit leaves: its size, whether it is white, and what it still follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import INPUT
from servo_daemon.identification.output_error.solver.solver import Point, mean_squares
from servo_daemon.samples import F64

#: Lags that are looked at, samples.
LAGS = 25
#: A correlation below this is none that matters, however many samples make it significant.
RELEVANT = 0.1
#: Correlation of a residual with the past input beyond which the model lacks some of the response.
_SIGNIFICANT = 4.0
#: Correlation that a pattern of rounding may have, and the power of sums over `_BLOCK` samples, 1 for white noise.
_PATTERN, _SLOW, _BLOCK = 0.6, 2.0, 20


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """Of one channel.

    Attributes:
        rmse: in the channel's unit.
        autocorrelation: the largest in modulus over lags 1 … `LAGS`.
        input_correlation: the largest in modulus with the input, lags 0 … `LAGS`, of the residual made white first.
        white: neither exceeds what noise gives by chance (4 σ) and what matters (0.1).
        outliers: samples that lost weight as isolated outliers.
    """

    rmse: float
    autocorrelation: float
    input_correlation: float
    white: bool
    outliers: int


def white_below(n: int) -> float:
    """The correlation that is none: what chance makes of n samples, or what does not matter."""
    return float(max(RELEVANT, _SIGNIFICANT / np.sqrt(max(n, 1))))


def residual_tests(problem: Problem, point: Point) -> dict[str, ResidualTest]:
    """One test for each channel."""
    out, rms = {}, np.sqrt(mean_squares(problem, point.sse))
    for c, name in enumerate(problem.channels):
        parts = [r[:, c] * np.sqrt(w[:, c]) for r, w in zip(point.linearisation.residuals, point.weights, strict=True)]
        inputs = [s.rows[:, INPUT] for s in problem.segments]
        there = [s.valid[:, c] for s in problem.segments]
        auto, cross, n = _autocorrelation(parts), _input_correlation(parts, inputs, there), sum(map(len, parts))
        limit = white_below(n)
        outliers = int(sum((w[:, c] < 1.0).sum() for w in point.weights))
        out[name] = ResidualTest(float(rms[c]), auto, cross, max(abs(auto), abs(cross)) < limit, outliers)
    return out


def _autocorrelation(parts: list[F64]) -> float:
    power = sum(float(r @ r) for r in parts)
    if power == 0.0:
        return 0.0
    lags = [sum(float(r[k:] @ r[:-k]) for r in parts if len(r) > k) / power for k in range(1, LAGS + 1)]
    return max(lags, key=abs)


def _input_correlation(parts: list[F64], inputs: list[F64], there: list[NDArray[np.bool_]]) -> float:
    """With the input as it comes: differences of both, so that a slow input correlates no more than a fast one.

    Args:
        there: per part, shape (n,): where it is a residual and not the 0 of what was not measured.
    """
    best = 0.0
    r = [np.diff(x) for x in parts]
    u = [np.diff(x) for x in inputs]
    at = [x[w[1:]] for x, w in zip(u, there, strict=True)]
    power = np.sqrt(sum(float(x @ x) for x in r) * sum(float(x @ x) for x in at))
    if power == 0.0:
        return 0.0
    for k in range(LAGS + 1):
        value = sum(float(a[k:] @ b[: len(b) - k]) for a, b in zip(r, u, strict=True) if len(a) > k) / power
        best = max(best, value, key=abs)
    return float(best)


def innovation_tests(
    problem: Problem, innovations: Sequence[F64], rms: F64, counted: Sequence[NDArray[np.bool_]], resolution: F64
) -> dict[str, ResidualTest]:
    """The same for whitened residuals.

    In closed loop the input answers to a residual from its own sample on: only the input before it may not correlate
    with it. At constant speed the rounding errors of an encoder repeat after a few samples: where rounding is most of
    the noise, a correlation is none of the model's as long as there is no more power at low frequencies, where motors
    live, than elsewhere.

    Args:
        innovations: over their standard deviations, per segment, shape (n, c).
        rms: shape (c,), of the innovations in the channels' units.
        counted: per segment, shape (n, c): samples that are a sample of the noise; a standing encoder's are not.
        resolution: shape (c,), step of each channel's values, or 0.
    """
    out = {}
    inputs = [s.rows[:, INPUT] for s in problem.segments]
    for c, name in enumerate(problem.channels):
        parts = [np.where(u[:, c], r[:, c], 0.0) for r, u in zip(innovations, counted, strict=True)]
        every, n = [r[:, c] for r in innovations], sum(int(u[:, c].sum()) for u in counted)
        there = [s.valid[:, c] for s in problem.segments]
        auto, cross = _autocorrelation(parts), _past_input_correlation(parts, inputs, there)
        limit = white_below(n)
        rounding = resolution[c] ** 2 / 12.0 > 0.5 * rms[c] ** 2
        pattern = bool(rounding and abs(auto) < _PATTERN and _slow_excess(every) < _SLOW)
        white = abs(cross) < limit and (abs(auto) < limit or pattern)
        out[name] = ResidualTest(float(rms[c]), auto, cross, bool(white), 0)
    return out


def _slow_excess(parts: list[F64]) -> float:
    """Mean square of sums over `_BLOCK` samples over what it is for white noise."""
    sums = [np.add.reduceat(r, np.arange(0, len(r) - _BLOCK + 1, _BLOCK)) for r in parts if len(r) >= _BLOCK]
    power = sum(float(r @ r) for r in parts) / sum(map(len, parts))
    if not sums or power == 0.0:
        return 1.0
    return float(np.mean(np.concatenate(sums) ** 2)) / (_BLOCK * power)


def _past_input_correlation(parts: list[F64], inputs: list[F64], there: list[NDArray[np.bool_]]) -> float:
    """Of white residuals with the input's changes at least one sample earlier; `there` as above."""
    u = [np.diff(x, prepend=x[0]) for x in inputs]
    at = [x[w] for x, w in zip(u, there, strict=True)]
    power = np.sqrt(sum(float(x @ x) for x in parts) * sum(float(x @ x) for x in at))
    if power == 0.0:
        return 0.0
    lags = range(1, LAGS + 1)
    values = [sum(float(a[k:] @ b[:-k]) for a, b in zip(parts, u, strict=True) if len(a) > k) / power for k in lags]
    return float(max(values, key=abs))
