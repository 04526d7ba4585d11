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

import numpy as np

from servo_daemon.estimators.rls import SYSTEMATIC
from servo_daemon.samples import F64

#: How much of an error of the balance can lie along a parameter's term, where it is not all: what is wrong with a
#: voltage goes with the voltage and the current; with the current's derivative it goes only as far as it comes at a
#: wrong time, and that `skew_s` of the configuration answers for.
ALIGNED = {"L": 1.0 / 12.0}


@dataclass(slots=True)
class GramWindow:
    """Gram matrices of the last seconds' regressors [Φ | y], summed.

    Attributes:
        span_s: how far back.
    """

    span_s: float
    _parts: deque[tuple[float, F64, F64]] = field(default_factory=deque)

    def clear(self) -> None:
        self._parts.clear()

    def add(self, time_s: float, Phi: F64, y: F64, weight_squares: F64) -> None:
        """Rows that end at about `time_s`: Phi shape (m, n), y shape (m,), and the sums of the squares of the windows'
        weights for ∫φ, ∫φ', ∫φ'', shape (3,): what white noise of variance 1 adds to the squares of an integral."""
        rows = np.column_stack([Phi, y])
        self._parts.append((time_s, rows.T @ rows, weight_squares))

    def total(self, time_s: float) -> tuple[F64, F64] | None:
        """Sums over what is younger than `span_s` at `time_s`, shapes (n + 1, n + 1) and (3,); None if nothing is."""
        while self._parts and time_s - self._parts[0][0] > self.span_s:
            self._parts.popleft()
        if not self._parts:
            return None
        return np.sum([g for _, g, _ in self._parts], axis=0), np.sum([w for _, _, w in self._parts], axis=0)


#: A regressor is motion only as far as it is larger than this many times its noise (in squares). An encoder's steps at
#: constant speed are no white noise, their sum over a window can be far larger than white noise of the same variance.
_NOISE_MARGIN = {"current_A": 4.0, "position_rad": 25.0}
#: A balance that closes to this share (rms) closes: integrals over samples are no more exact than that.
_CLOSES = 0.01
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
    """d residual / d coordinate of each parameter, as weights on the columns "R", "L", "K", "one", "y"."""
    slopes = {name: _unit(columns, name, value[name]) for name in ("R", "L", "K")}
    if "one" in columns:
        slopes["i0"] = _unit(columns, "one", -value["R"])
    return slopes


def shaft_slopes(columns: Sequence[str], value: Mapping[str, float], per_current: bool) -> dict[str, F64]:
    """The same for the columns "J", "B", effects' and "y", in N·m.

    Args:
        per_current: y is ∫φ i and K a parameter of this balance; else y is a torque.
    """
    own = ("J", "B", "Tc", "Tc_neg", "B_neg", "c2")
    slopes = {name: _unit(columns, name, -value[name]) for name in own if name in columns}
    if "mu" in columns:
        slopes["mu"] = _unit(columns, "mu", -value["mu"] * (value["K"] if per_current else 1.0))
    if "one" in columns:
        slopes["TL"] = _unit(columns, "one", -1.0)
        if per_current and "i0" in value:
            slopes["i0"] = _unit(columns, "one", -value["K"])
    if "sin" in columns:
        Tg, phi = value["Tg"], value["phi_g"]
        s, c = _unit(columns, "sin", 1.0), _unit(columns, "cos", 1.0)
        slopes["Tg"] = -Tg * (np.cos(phi) * s + np.sin(phi) * c)
        slopes["phi_g"] = -Tg * (np.cos(phi) * c - np.sin(phi) * s)
    if per_current:
        slopes["K"] = _unit(columns, "y", value["K"])
    return slopes


def information(gram: F64, noise: F64, slopes: Mapping[str, F64], names: Sequence[str], size_per_y: float) -> F64:
    """F of one balance over the coordinates `names`, shape (n, n).

    Args:
        gram, noise: of [Φ | y], shape (m + 1, m + 1), and what of it is noise.
        size_per_y: the balance's size per unit of its last column.
    """
    energy = float(gram[-1, -1]) * size_per_y**2
    if not energy > 0:
        return np.zeros((len(names), len(names)))
    S = np.column_stack([slopes.get(name, np.zeros(len(gram))) / ALIGNED.get(name, 1.0) for name in names])
    return np.asarray(S.T @ (gram - noise) @ S / (SYSTEMATIC**2 * energy))


def column_noise(
    columns: Sequence[str], weight_squares: F64, noise_var: Mapping[str, float], y_channel: str | None = None
) -> F64:
    """What white noise adds to the columns' Gram matrix on average, shape (n, n); without any margin.

    Args:
        columns: of Φ, and "y" if it is one of them.
        y_channel: the channel that y is ∫φ of, if it is a noisy one.
    """
    out = np.zeros(len(columns))
    for k, name in enumerate(columns):
        channel, derivative = (y_channel or "", 0) if name == "y" else _NOISE_IN.get(name, ("", 0))
        out[k] = noise_var.get(channel, 0.0) * weight_squares[derivative]
    return np.diag(out)


def mismatch_std(gram: F64, expected: float, slopes: Mapping[str, F64]) -> dict[str, float]:
    """By how much each coordinate may be off because the balance does not close: 1 σ, if all that its best fit leaves,
    beyond the noise, were an error along that parameter's own term.

    Args:
        gram: of [Φ | y], shape (m + 1, m + 1).
        expected: how much of the fit's sum of squares noise explains.
        slopes: d residual / d coordinate, as weights on the columns.
    """
    scale = np.sqrt(np.maximum(np.diag(gram)[:-1], 1e-300))
    A = gram[:-1, :-1] / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    inverse = np.linalg.inv(A)
    b = gram[:-1, -1] / scale
    total = float(gram[-1, -1])
    structure = max(0.0, total - float(b @ inverse @ b) - expected - _CLOSES**2 * total)
    out = {}
    for name, slope in slopes.items():
        k = int(np.argmax(np.abs(slope[:-1])))
        size = float(np.abs(slope[k]))
        if size > 0.0:
            out[name] = float(np.sqrt(structure * inverse[k, k])) / scale[k] / size
    return out


def _unit(columns: Sequence[str], name: str, weight: float) -> F64:
    out = np.zeros(len(columns))
    out[list(columns).index(name)] = weight
    return out
