"""Regression equations from the balances without differentiating anything: the method of modulating functions.

Multiply a balance by a smooth φ(t) that vanishes with its first derivatives at both ends of a window and integrate by
parts (Shinbrot 1957; Preisig & Rippin, *Comput. Chem. Eng.* 17, 1993): derivatives move from the noisy signals to φ.

    ∫φ v = R ∫φ i − L ∫φ' i − K ∫φ' θ                 (armature)
    K ∫φ i = J ∫φ'' θ − B ∫φ' θ + ∫φ τ_load           (shaft)

Both sides see the same φ, so noise is filtered alike; jittered time stamps enter exactly. v is held between samples, so
its integral is exact with φ's antiderivative; i and θ are taken by the trapezoidal rule, corrected in short windows
(`moments.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import NDArray

from servo_daemon.regression.moments import MOST_SAMPLES, correct
from servo_daemon.samples import F64

#: φ(s) = 1024 s⁵ (1 − s)⁵ on 0..1, the maximum is 1. Four derivatives vanish at both ends: two are needed to
#: integrate by parts, two more so that the trapezoidal rule is exact to h⁴ for the second derivative of φ too
#: (Euler–Maclaurin; with s³ an angle far from zero leaves an error at the ends that made B 40 % wrong where it is a
#: small part of the torque).
_HEIGHT = 1024.0
#: ∫φ = s⁶ times this polynomial.
_INTEGRAL_OVER_S6 = poly.polyint(_HEIGHT * poly.polypow([0.0, 1.0, -1.0], 5))[6:]


@dataclass(frozen=True, slots=True)
class Windows:
    """Weights that turn samples into modulated integrals; w windows of m samples each.

    Attributes:
        first: shape (w,), the first sample of each window.
        hop: samples from one window's first to the next one's; 0: not the same for all.
        index: shape (w, m), the samples of each window, some beyond the recording's ends where they are `moved`; None:
            as `first` and `hop` have it.
        held_weight: shape (w, m): for ∫φ of a signal held from each sample to the next; None: not asked for.
        weights: shape (3, w, m): for ∫φ, ∫φ', ∫φ'' of a continuous signal.
    """

    first: NDArray[np.intp]
    hop: int
    index: NDArray[np.intp] | None
    held_weight: F64 | None
    weights: F64

    @property
    def weight_squares(self) -> F64:
        """Σ over all windows of the squared weights, shape (3,): white noise of variance 1 adds so much to the square
        of ∫φ x, ∫φ' x and ∫φ'' x, summed over the windows."""
        return np.asarray(np.einsum("kwm,kwm->k", self.weights, self.weights))

    def only(self, which: NDArray[np.bool_]) -> Windows:
        """Some of the windows; which: shape (w,)."""
        held = None if self.held_weight is None else self.held_weight[which]
        first = self.first[which]
        hop = _hop(first) if self.index is None else 0
        index = None if hop else self._all()[which]
        return Windows(first, hop, index, held, self.weights[:, which])

    def touching(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which windows hold a flagged sample, shape (w,)."""
        before = np.concatenate([[0], np.cumsum(flags)])
        touched: NDArray[np.bool_] = before[self.first + self.weights.shape[2]] > before[self.first]
        return touched

    def moved(self, k: int) -> Windows:
        """The same weights on what comes k samples later (k < 0: earlier), the recording's ends held."""
        return replace(self, index=self._all() + k)

    def held(self, signal: F64) -> F64:
        """∫φ signal for a signal held between samples, shape (w,)."""
        assert self.held_weight is not None
        return np.asarray(np.einsum("wm,wm->w", self.held_weight, self._samples(signal)))

    def integral(self, signal: F64, derivative: int = 0) -> F64:
        """∫φ^(derivative) signal for a continuous signal, shape (w,)."""
        return self.integrals(signal, derivative)[0]

    def integrals(self, signal: F64, *derivatives: int) -> list[F64]:
        """`integral` for several derivatives in one pass over the signal."""
        samples = self._samples(signal)
        return [np.asarray(np.einsum("wm,wm->w", self.weights[k], samples)) for k in derivatives]

    def _samples(self, signal: F64) -> F64:
        """Shape (w, m), not to be written to."""
        if self.index is None and signal.flags.c_contiguous:
            return _view(signal, self.first, self.hop, self.weights.shape[2])
        return signal.take(self._all(), mode="clip")

    def _all(self) -> NDArray[np.intp]:
        return _index(self.first, self.weights.shape[2]) if self.index is None else self.index

    @property
    def of_one(self) -> F64:
        """∫φ of a constant one, shape (w,)."""
        return np.asarray(self.weights[0].sum(axis=1))


def _view(signal: F64, first: NDArray[np.intp], hop: int, length: int) -> F64:
    """The signal's samples in evenly spaced windows, shape (w, length), had in no time: looking each sample up takes as
    long as the integral over it."""
    step = signal.itemsize
    return np.ndarray((len(first), length), signal.dtype, signal, int(first[0]) * step, (hop * step, step))


def _index(first: NDArray[np.intp], length: int) -> NDArray[np.intp]:
    return first[:, None] + np.arange(length)


def _hop(first: NDArray[np.intp]) -> int:
    """The distance of windows that are evenly spaced; 0 where they are not."""
    steps = first[1:] - first[:-1]
    if len(steps) == 0:
        return len(first)
    return int(steps[0]) if (steps == steps[0]).all() else 0


def make_windows(
    time_s: F64, first: NDArray[np.intp], length: int, *, held: bool = True, exact: bool = False
) -> Windows:
    """Windows of `length` samples starting at the samples `first`.

    Args:
        time_s: shape (n,), strictly increasing.
        first: shape (w,).
        held: with the weights for a signal that is held between samples.
        exact: for polynomials, where the windows are short.
    """
    hop = _hop(first)
    index = None if hop else _index(first, length)
    if index is None and time_s.flags.c_contiguous:
        t = _view(time_s, first, hop, length).copy()
    else:
        t = time_s[_index(first, length)]
    begin = t[:, :1].copy()
    span = t[:, -1:] - begin
    # In place throughout: fresh arrays of a window's 20,000 samples cost more than what is computed in them.
    trapezoid = np.empty_like(t)
    np.subtract(t[:, 2:], t[:, :-2], out=trapezoid[:, 1:-1])
    trapezoid[:, 0], trapezoid[:, -1] = t[:, 1] - t[:, 0], t[:, -1] - t[:, -2]
    trapezoid *= 0.5
    t -= begin
    t /= span
    held_weight = _held_weight(t, span) if held else None
    weights = np.empty((3, *t.shape))
    place = t.copy() if exact and length <= MOST_SAMPLES else None
    _phi_and_derivatives(t, weights)
    trapezoid /= span
    weights *= trapezoid
    if place is not None:
        correct(weights, place, _HEIGHT)
    weights[0] *= span
    weights[2] /= span  # d/dt = d/ds / span
    return Windows(first, hop, index, held_weight, weights)


def _held_weight(s: F64, span: F64) -> F64:
    total = _phi_integral(s)
    out = np.zeros_like(s)
    np.subtract(total[:, 1:], total[:, :-1], out=out[:, :-1])
    out *= span
    return out


def _phi_and_derivatives(s: F64, out: F64) -> None:
    """φ, dφ/ds, d²φ/ds² into out, shape (3, …): with p = s (1 − s) they are p⁵, 5 p⁴ (1 − 2 s) and p³ (20 − 90 p) times
    the height; s is used up."""
    p = s * (1.0 - s)
    fifth, fourth, cube = out
    np.multiply(p, _HEIGHT, out=cube)
    cube *= p * p
    np.multiply(cube, p, out=fourth)
    np.multiply(fourth, p, out=fifth)
    s *= -10.0
    s += 5.0
    fourth *= s
    p *= -90.0
    p += 20.0
    cube *= p


def _phi_integral(s: F64) -> F64:
    """∫φ from 0 to s."""
    out = s * _INTEGRAL_OVER_S6[-1]
    for coefficient in _INTEGRAL_OVER_S6[-2:0:-1]:  # Horner's scheme; NumPy's `polyval` makes two arrays a step
        out += coefficient
        out *= s
    out += _INTEGRAL_OVER_S6[0]
    sixth = s * s
    sixth *= sixth * sixth
    out *= sixth
    return np.asarray(out)
