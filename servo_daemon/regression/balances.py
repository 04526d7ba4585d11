"""What a window of motion can say of each parameter when the balances themselves are only nearly right.

The noise of the sensors averages out, an error of the model does not. If each balance (voltages, torques) may be off by
the share `SYSTEMATIC` of its size, in the worst way that there is, then with the modulated regressors C (one column per
parameter's coordinate, `modulating.py`) and the balance's own size y

    F = Cᵀ C / (SYSTEMATIC² yᵀ y)

is the information about the coordinates that such an error leaves. A parameter whose term is a thousandth of its
balance, or a multiple of another's (R and K at one constant speed), is not determined however long one looks and
however well the noise is known; the filter alone would take the colour of the noise for information. What the
sensors' noise may put into C is no motion and is taken out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from servo_daemon.regression.columns import terms as regression_terms
from servo_daemon.regression.rls_fit import SYSTEMATIC
from servo_daemon.regression.sampling import Sampling, between_samples, coarse
from servo_daemon.samples import F64

#: How much of an error of the balance can lie along a parameter's term, where it is not all: what is wrong with a
#: voltage goes with the voltage and the current; with the current's derivative it goes only as far as it comes at a
#: wrong time, and that `skew_s` of the configuration answers for.
ALIGNED = {"L": 1.0 / 12.0}

#: Noise levels are known to this factor (in squares; free within a half and twice: tests/recovery/constants.py).
NOISE_KNOWN = 2.0
#: With so few samples in a window that φ itself is hardly followed a balance closes no better than to this share (at
#: 100 Hz, L/R = 1 ms: 4 to 13 % on the four test motors).
_COARSE_CLOSES = 0.15


def added(arrays: Sequence[F64]) -> F64:
    """The sum of some small arrays of one shape, without first making one large array of them."""
    return reduce(np.add, arrays)


@dataclass(frozen=True, slots=True)
class Sums:
    """Sums over rows of regressors [Φ | y].

    Attributes:
        gram: their Gram matrix, shape (n + 1, n + 1).
        weight_squares: sums of the squares of the windows' weights for ∫φ, ∫φ', ∫φ'', shape (3,): what white noise of
            variance 1 adds to the squares of an integral.
        rows: how many.
    """

    gram: F64
    weight_squares: F64
    rows: int

    @classmethod
    def of(cls, Phi: F64, y: F64, weight_squares: F64) -> Sums:
        """Phi shape (m, n), y shape (m,)."""
        rows = np.empty((len(y), Phi.shape[1] + 1))
        rows[:, :-1], rows[:, -1] = Phi, y
        return cls(rows.T @ rows, weight_squares, len(rows))

    @classmethod
    def total(cls, parts: Sequence[Sums]) -> Sums | None:
        """Sum of several; None if there are none."""
        if not parts:
            return None
        return cls(added([p.gram for p in parts]), added([p.weight_squares for p in parts]), sum(p.rows for p in parts))


@dataclass(slots=True)
class GramWindow:
    """Sums over the last seconds' rows.

    Attributes:
        span_s: how far back.
    """

    span_s: float
    _parts: deque[tuple[float, Sums]] = field(default_factory=deque)
    _total: Sums | None = None  # over `_parts`, once it has been asked for

    def clear(self) -> None:
        self._parts.clear()
        self._total = None

    def add(self, time_s: float, part: Sums) -> None:
        """Rows that end at about `time_s`."""
        self._parts.append((time_s, part))
        self._total = None

    def since(self, time_s: float) -> Sums | None:
        """Sums over the rows that ended after that; None if there are none."""
        return Sums.total([part for end_s, part in self._parts if end_s > time_s])

    def total(self, time_s: float) -> Sums | None:
        """Sums over what is younger than `span_s` at `time_s`; None if nothing is."""
        while self._parts and time_s - self._parts[0][0] > self.span_s:
            self._parts.popleft()
            self._total = None
        if self._total is None:
            self._total = Sums.total([part for _, part in self._parts])
        return self._total


#: A regressor is motion only as far as it is larger than this many times its noise (in squares). An encoder's steps at
#: constant speed are no white noise, their sum over a window can be far larger than white noise of the same variance.
_NOISE_MARGIN = {"current_A": 4.0, "position_rad": 25.0}
#: Which channel's noise, and in which integral, is in each column.
_NOISE_IN = {
    "R": ("current_A", 0),
    "L": ("current_A", 1),
    "K": ("position_rad", 1),
    "J": ("position_rad", 2),
    "B": ("position_rad", 1),
    "B_neg": ("position_rad", 1),
}


def noise_gram(
    columns: Sequence[str], weight_squares: F64, noise_var: Mapping[str, float], y_channel: str | None
) -> F64:
    """What the sensors' noise may add to the diagonal of [Φ | y]'s Gram matrix, shape (n + 1, n + 1).

    Args:
        columns: of Φ, and "y".
        noise_var: per channel; one that is not measured adds nothing.
        y_channel: the channel that y is ∫φ of, if it is a noisy one.
    """
    most = {channel: margin * noise_var.get(channel, 0.0) for channel, margin in _NOISE_MARGIN.items()}
    return column_noise(columns, weight_squares, most, y_channel)


def armature_slopes(columns: Sequence[str], value: Mapping[str, float]) -> dict[str, F64]:
    """d residual / d coordinate of each parameter, as weights on the columns "R", "L", "K", effects' and "y"."""
    slopes: dict[str, F64] = {}
    for name in columns:
        if name != "y":
            _add(slopes, columns, name, regression_terms.armature_coefficient(name, value)[1])
    return slopes


def shaft_slopes(columns: Sequence[str], value: Mapping[str, float], per_current: bool) -> dict[str, F64]:
    """The same for the columns "J", "B", effects' and "y", in N·m.

    Args:
        per_current: y is ∫φ i and K a parameter of this balance; else y is a torque.
    """
    slopes: dict[str, F64] = {}
    for name in columns:
        if name != "y":
            _, by = regression_terms.coefficient(name, value)
            torque = value["K"] if per_current and regression_terms.is_share(name) else 1.0
            _add(slopes, columns, name, {p: -torque * slope for p, slope in by.items()})
    if "one" in columns and per_current and "i0" in value:
        slopes["i0"] = _unit(columns, "one", -value["K"])
    if per_current:
        slopes["K"] = _unit(columns, "y", value["K"])
    return slopes


def _add(slopes: dict[str, F64], columns: Sequence[str], name: str, by: Mapping[str, float]) -> None:
    """To each parameter's slope what its part in the coefficient of one column makes."""
    for parameter, slope in by.items():
        part = _unit(columns, name, slope)
        slopes[parameter] = slopes[parameter] + part if parameter in slopes else part


def information(gram: F64, noise: F64, slopes: Mapping[str, F64], names: Sequence[str], size_per_y: float) -> F64:
    """F of one balance over the coordinates `names`, shape (n, n).

    Args:
        gram, noise: of [Φ | y], shape (m + 1, m + 1), and what of it is noise.
        size_per_y: the balance's size per unit of its last column.
    """
    energy = float(gram[-1, -1]) * size_per_y**2
    if not energy > 0:
        return np.zeros((len(names), len(names)))
    S = np.zeros((len(gram), len(names)))
    for k, name in enumerate(names):
        if name in slopes:
            S[:, k] = slopes[name] / ALIGNED.get(name, 1.0)
    return np.asarray(S.T @ (gram - noise) @ S / (SYSTEMATIC**2 * energy))


def column_noise(
    columns: Sequence[str], weight_squares: F64, noise_var: Mapping[str, float], y_channel: str | None = None
) -> F64:
    """What white noise adds to the columns' Gram matrix on average, shape (n, n); without any margin.

    Args:
        columns: of Φ, and "y" if it is one of them.
        y_channel: the channel that y is ∫φ of, if it is a noisy one.
    """
    return np.diag(noise_squares(columns, weight_squares, noise_var, y_channel))


def noise_squares(
    columns: Sequence[str], weight_squares: F64, noise_var: Mapping[str, float], y_channel: str | None = None
) -> F64:
    """Diagonal of what the sensors' noise adds to ΦᵀΦ, shape (n,)."""
    sums = weight_squares.tolist()
    where = [(y_channel or "", 0) if name == "y" else _NOISE_IN.get(name, ("", 0)) for name in columns]
    return np.array([noise_var.get(channel, 0.0) * sums[derivative] for channel, derivative in where])


def expected_square(
    which: str, columns: Sequence[str], sums: Sums, coefficients: F64, sampling: Sampling, y_channel: str | None
) -> float:
    """The sum of squares that noise and sampling leave of rows, at the most.

    Args:
        which: "armature" or "shaft".
        columns: of Φ, and "y".
        coefficients: of Φ's columns, shape (n,).
        y_channel: as for `column_noise`.
    """
    noise_var = dict(sampling.noise_var)
    if "current_A" in noise_var:
        noise_var["current_A"] += between_samples(sampling, which)
    noise = noise_squares(columns, sums.weight_squares, noise_var, y_channel)
    inexact = (_COARSE_CLOSES * coarse(which, sampling.period_s)) ** 2 * float(sums.gram[-1, -1])
    return NOISE_KNOWN * float(np.append(np.square(coefficients), 1.0) @ noise) + inexact


def _unit(columns: Sequence[str], name: str, weight: float) -> F64:
    out = np.zeros(len(columns))
    out[columns.index(name)] = weight
    return out
