"""How noisy sensors and input are and how fast the unknown inputs walk: by maximum likelihood over innovations.

    −2 log L = Σ (log s + ν²/s)          (Schweppe, *IEEE Trans. Inf. Theory* 11, 1965)

over pieces spread over the recording: a few thousand samples tell five intensities to some percent, and every
evaluation is a pass of the compiled filter. Readings of an encoder that stands are no sample of its noise; the filter
takes them, the likelihood does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.missing.smoother import Augmented, forward, packed
from servo_daemon.plant.at_once import alike
from servo_daemon.samples import F64

#: Pieces and samples of each that the likelihood looks at; the first samples of a piece only find the state (chosen;
#: not tried).
PIECES, PIECE_SAMPLES, SETTLING = 8, 512, 40
#: A run of equal readings counts with its first and last samples only (chosen; not tried).
_ALIVE = 4
#: A channel is in steps if this share of its readings repeats the one before (chosen; not tried).
_REPEATS = 0.02
#: −2 log L of the logarithms of all levels, their limits, and such logarithms with their −2 log L.
_Cost = Callable[[F64], float]
_Limits = Sequence[tuple[float, float]]
_Point = tuple[F64, float]


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Attributes:
    walk: per disturbance, (N·m)²/s or V²/s: how much its variance grows in a second.
    input_var: variance of the held input beyond what was recorded, V² (A², (N·m)²).
    channel_var: per measured channel, in its unit squared.
    """

    walk: Mapping[str, float]
    input_var: float
    channel_var: Mapping[str, float]

    def constants(self, a: Augmented, q: F64) -> F64:
        """As the compiled passes take them."""
        walk = [self.walk[name] for name in a.disturbances]
        return np.array([*q, *walk, self.input_var, *(self.channel_var[c] for c in a.channels)])


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive samples.

    Attributes:
        rows: shape (n, 3 + 2 c): t, h, input, channels, whether each is a measurement.
        z0, P0: shapes (n_z,), (n_z, n_z): state before the first sample.
        counted: shape (n, c): which innovations the likelihood takes.
        known: the state before the first sample is known as P0 says: nothing has to settle.
    """

    rows: F64
    z0: F64
    P0: F64
    counted: NDArray[np.bool_]
    known: bool = False

    def begin(self) -> F64:
        """State of the forward pass."""
        return np.concatenate([self.z0, packed(self.P0)])


def resolution(values: F64) -> float:
    """Step of a quantised signal: the least difference that occurs, where readings repeat; else 0."""
    distance = np.abs(np.diff(values[np.isfinite(values)]))
    moved = distance[distance > 1e-9 * max(float(np.max(distance, initial=0.0)), 1e-300)]
    if len(moved) == 0 or len(moved) > (1 - _REPEATS) * len(distance):
        return 0.0
    return float(np.percentile(moved, 1.0))


def alive(values: F64) -> NDArray[np.bool_]:
    """Shape (n,): False within a long run of equal readings."""
    change = np.flatnonzero(np.diff(values, prepend=np.nan, append=np.nan) != 0)
    begin = np.repeat(change[:-1], np.diff(change))
    end = np.repeat(change[1:], np.diff(change))
    k = np.arange(len(values))
    return np.asarray((k - begin < _ALIVE) | (end - k <= _ALIVE))


def fit_levels(
    a: Augmented, q: F64, stretches: Sequence[Stretch], start: NoiseLevels, floor: F64, *, from_still: bool = False
) -> NoiseLevels:
    """Maximum likelihood from a start.

    Args:
        floor: shape (c,), least variance of each channel (quantisation).
        from_still: also from where nothing walks, the likelier of both. What a winding lets through of its voltage's
            noise looks much like a torque that walks, and from there no descent finds back.
    """
    cost, n_d = _cost(a, q, _pieces(a, stretches)), len(a.disturbances)
    typical = np.log(
        [*(start.walk[d] for d in a.disturbances), start.input_var, *(start.channel_var[c] for c in a.channels)]
    )
    low = np.concatenate([typical[: n_d + 1] - 16.0, np.log(floor)])
    high = np.concatenate([typical[: n_d + 1] + 14.0, np.maximum(typical[n_d + 1 :], low[n_d + 1 :]) + 9.0])
    limits = list(zip(low, high, strict=True))
    begun = [_coarse(cost, _at(cost, typical, limits), (*range(n_d + 1), *range(n_d)), limits)]
    if from_still:
        still = _descent(cost, _at(cost, np.concatenate([low[:n_d], typical[n_d:]]), limits), limits)
        begun.append(_coarse(cost, still, range(n_d), limits))
    best, _ = min((_descent(cost, point, limits) for point in begun), key=lambda point: point[1])
    x = np.exp(best)
    walk = dict(zip(a.disturbances, x[:n_d].tolist(), strict=True))
    return NoiseLevels(walk, float(x[n_d]), dict(zip(a.channels, x[n_d + 1 :].tolist(), strict=True)))


def _at(cost: _Cost, x: F64, limits: _Limits) -> _Point:
    """The point within the limits."""
    inside = np.clip(x, *np.transpose(limits))
    return inside, cost(inside)


def _descent(cost: _Cost, start: _Point, limits: _Limits) -> _Point:
    """To the next minimum; the start where none is found."""
    from scipy.optimize import minimize

    options = {"maxiter": 25, "eps": 1e-3, "ftol": 1e-7}
    found = minimize(cost, start[0], method="L-BFGS-B", bounds=limits, options=options)
    return (np.asarray(found.x), float(found.fun)) if found.fun < start[1] else start


def _cost(a: Augmented, q: F64, pieces: Sequence[Stretch]) -> _Cost:
    """−2 log L but for a constant, as a function of the logarithms of all levels: walks, input, channels."""
    at_once = [
        (which, np.stack([pieces[k].begin() for k in which]), np.stack([pieces[k].rows for k in which]))
        for which in alike(len(p.rows) for p in pieces).values()
    ]

    def cost(x: F64) -> float:
        constants = np.concatenate([q, np.exp(x)])
        of = [0.0] * len(pieces)
        for which, begin, rows in at_once:
            for k, out in zip(which, forward(a).run_many(begin.copy(), constants, rows), strict=True):
                of[k] = _minus_two_log(pieces[k], out[:, a.columns["innovation"]], out[:, a.columns["precision"]])
        total = sum(of)
        return total if np.isfinite(total) else 1e12

    return cost


def _coarse(cost: _Cost, start: _Point, order: Iterable[int], limits: _Limits) -> _Point:
    """Coordinate by coordinate: the walks may be off by many orders of magnitude, where slopes are flat."""
    best, value = start
    for k in order:
        for trial in (-9.0, -4.5, 4.5, 9.0):
            x = best.copy()
            x[k] = np.clip(best[k] + trial, *limits[k])
            if (other := cost(x)) < value:
                best, value = x, other
    return best, value


def _pieces(a: Augmented, stretches: Sequence[Stretch]) -> list[Stretch]:
    """Some of the data, spread evenly; each begins at its measured state, widely uncertain, or where it is known to."""
    total = sum(len(s.rows) for s in stretches)
    if all(s.known for s in stretches):
        count = min(-(-PIECES * PIECE_SAMPLES * len(stretches) // total), len(stretches))
        return [stretches[int(k)] for k in np.linspace(0, len(stretches) - 1, count).astype(int)]
    if total <= PIECES * PIECE_SAMPLES * 1.5:
        chosen = [(s, 0, len(s.rows)) for s in stretches]
    else:
        chosen = []
        for s in stretches:
            count = max(1, round(PIECES * len(s.rows) / total))
            length = min(PIECE_SAMPLES, len(s.rows) // count)
            starts = np.linspace(0, len(s.rows) - length, count).astype(int)
            chosen += [(s, int(k), int(k) + length) for k in starts]
    return [_piece(a, s, begin, end) for s, begin, end in chosen if end - begin > SETTLING]


def _minus_two_log(piece: Stretch, nu: F64, precision: F64) -> float:
    """Of a piece, but for a constant, from its innovations and their inverse variances."""
    use = piece.counted & (precision > 0)
    return float(np.sum(nu[use] ** 2 * precision[use] - np.log(precision[use])))


def _piece(a: Augmented, s: Stretch, begin: int, end: int) -> Stretch:
    counted = s.counted[begin:end].copy()
    counted[:SETTLING] = False
    z0 = s.z0.copy()
    for k, channel in enumerate(a.channels):
        if channel in a.plant.state_names and s.rows[begin, 3 + len(a.channels) + k]:
            z0[a.plant.state_names.index(channel)] = s.rows[begin, 3 + k]
    return Stretch(np.ascontiguousarray(s.rows[begin:end]), z0, s.P0, counted)
