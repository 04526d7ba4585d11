"""Least squares over sums of rows, and what they leave beyond noise (`rls`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servo_daemon.numerics import is_definite
from servo_daemon.samples import F64

#: By how much the model of a row may be off, as a share of y: dead time, ripple, friction that is not quite viscous
#: (decision 14).
SYSTEMATIC = 1e-3
#: A balance that closes to this share (rms) closes: its parameters change while it is summed up, and integrals over
#: samples are no more exact (chosen; free within half and twice).
CLOSES = 0.01
#: Windows of the modulating functions overlap by half, so neighbouring rows share half their noise: covariances are
#: that much too small.
OVERLAP = 2.0
#: Noise is compensated only while it is a smaller part of every regressor than the second, and a larger part of one
#: than the first: what is less moves nothing (chosen; half and twice move no tracking figure).
_LEAST_NOISE, _MOST_NOISE = 1e-12, 0.3
#: A column this much smaller than the largest is zero: no units of motors differ by as much.
_INVISIBLE = 1e-12
#: Least information of a direction, each column over its own size: rounding is smaller, and two columns that are the
#: same (friction and load of a motor that turns one way) leave only their own coefficients unknown.
_LEAST_SHARE = 1e-9
#: The same once noise is taken away: with less of a direction left the noise was all there was (free within 1e-10 ..
#: 1e-6, tried on nine runs of the simulated servo).
LEAST_SIGNAL = 1e-8
#: Fewest rows for each coefficient (chosen; free within half and twice).
_ROWS_PER_COEFFICIENT = 2.0
#: A sum of squares is larger than expected, and a window excluded, beyond so many standard deviations of what chance
#: makes of it (a Gaussian is beyond four once in 16,000 times).
CHANCE_STDS = 4.0
#: What the rows leave goes up and down with the motion by this factor (in squares; jitter, what the current does
#: between samples): with 1 a steady motor's standard deviations were up to five times as large for no error.
_LEVEL_VARIES = 2.0
#: A sum of squares is no smaller than this share of y's: rounding.
_EXACT = 1e-15


@dataclass(frozen=True, slots=True)
class Block:
    """Rows that end at about `time_s`, or sums over several blocks.

    Attributes:
        gram: of [Φ | y], shape (n + 1, n + 1).
        noise: what of the diagonal of ΦᵀΦ is noise of the regressors, shape (n,).
        rows, told: how many, and of how many the expected residual is known.
        expected: that residual's Σ of squares.
    """

    time_s: float
    gram: F64
    noise: F64
    rows: float
    told: float
    expected: float

    @property
    def n(self) -> int:
        """Number of coefficients."""
        return len(self.noise)

    @property
    def packed(self) -> F64:
        """All but the time in one array, so that blocks are summed in one go."""
        return np.concatenate([self.gram.ravel(), self.noise, (self.rows, self.told, self.expected)])

    @classmethod
    def unpacked(cls, time_s: float, sums: F64, n: int) -> Block:
        """Block of n coefficients from its packed form."""
        end = (n + 1) ** 2
        return cls(time_s, sums[:end].reshape(n + 1, n + 1), sums[end : end + n], *sums[end + n :].tolist())


@dataclass(frozen=True, slots=True)
class Fit:
    """Fit over one window: value shape (n,), inverse and information shape (n, n).

    Attributes:
        left, energy: Σ of squares that the fit leaves of y, and of y.
        rows: how many.
        expected: of what is left, what the sensors' noise explains; infinite where it is not known.
    """

    span_s: float
    value: F64
    inverse: F64
    information: F64
    left: float
    energy: float
    rows: float
    expected: float

    @property
    def residual_var(self) -> float:
        """Variance of the residual of one row."""
        return self.left / (self.rows - len(self.value))

    @property
    def chance(self) -> float:
        """By how much larger than expected, as a share, a sum of squares is by chance."""
        return CHANCE_STDS * math.sqrt(2.0 * OVERLAP / (self.rows - len(self.value)))


def fitted(span_s: float, sums: Block) -> Fit | None:
    """Least squares over one window; None where its rows do not determine the coefficients."""
    A, b, energy, rows = sums.gram[:-1, :-1], sums.gram[:-1, -1], float(sums.gram[-1, -1]), sums.rows
    scale = np.sqrt(A.diagonal())
    # A regressor that is (all but) zero: also one that was in the beginning and is dying away.
    if rows <= _ROWS_PER_COEFFICIENT * sums.n or scale.min() < _INVISIBLE * max(float(scale.max()), 1e-7):
        return None
    square = scale[:, None] * scale
    values, vectors = np.linalg.eigh(A / square)
    inverse = (vectors / np.maximum(values, _LEAST_SHARE)) @ vectors.T / square
    biased = inverse @ b
    left = max(energy - float(b @ biased), _EXACT * energy)
    expected = sums.expected * rows / sums.told if sums.told > 0.5 * rows else math.inf
    value = _compensated(sums, biased, scale)
    return Fit(span_s, value, inverse, A, left, energy, rows, expected)


def _compensated(sums: Block, biased: F64, scale: F64) -> F64:
    """The coefficients without the bias that noise in the regressors makes: (A − N) θ = b.

    Args:
        biased: the coefficients with it, shape (n,).
        scale: root of A's diagonal, shape (n,).
    """
    part = sums.noise / np.square(scale)
    most = float(part.max())
    if not _LEAST_NOISE < most < _MOST_NOISE:
        return biased
    signal = sums.gram[:-1, :-1] / (scale[:, None] * scale)
    signal.flat[:: len(scale) + 1] -= part
    if not is_definite(signal, LEAST_SIGNAL):
        return biased
    return np.asarray(np.linalg.solve(signal, sums.gram[:-1, -1] / scale) / scale)


def excludes(shortest: Fit, value: F64) -> bool:
    """Whether the shortest window's rows cannot be of a motor with these coefficients: their cost rises by more than
    chance and an error of the model make of it."""
    n = len(value)
    off = value - shortest.value
    cost = float(off @ shortest.information @ off)
    scale = OVERLAP * shortest.residual_var + SYSTEMATIC**2 * shortest.energy
    return cost > scale * (n + CHANCE_STDS * math.sqrt(2.0 * n))


def structure(fit: Fit, quiet: Fit) -> float:
    """Σ of squares that a window's best fit leaves beyond noise.

    Args:
        quiet: the rows with the least residual: noise is no larger than there.
    """
    by_noise = _noise(fit.rows, fit.energy, quiet, quiet.chance)
    told = fit.expected * (1.0 + fit.chance) + CLOSES**2 * fit.energy
    return max(0.0, fit.left - min(by_noise, told))


def unexplained(newest: Block, value: F64, shortest: Fit, quiet: Fit) -> float:
    """Σ of squares that coefficients leave of the newest rows beyond noise, as if all of the shortest window's rows
    were as far off: a motor that has changed a moment ago."""
    rows = newest.rows
    weights = np.append(-value, 1.0)
    left = float(weights @ newest.gram @ weights)
    chance = CHANCE_STDS * math.sqrt(2.0 * OVERLAP / rows)
    return max(0.0, left - _noise(rows, float(newest.gram[-1, -1]), quiet, chance)) * max(shortest.rows / rows, 1.0)


def _noise(rows: float, energy: float, quiet: Fit, chance: float) -> float:
    """Σ of squares that noise may leave of rows, and an error of the model that goes with their size.

    Args:
        energy: Σ y².
        chance: how much more of it there may be, as a share.
    """
    return _LEVEL_VARIES * rows * quiet.residual_var * (1.0 + chance) + (2.0 * SYSTEMATIC) ** 2 * energy
