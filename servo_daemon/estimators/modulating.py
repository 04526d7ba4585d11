"""Regression equations from the balances without differentiating anything: the method of modulating functions.

Multiply a balance by a smooth φ(t) that vanishes with its first derivatives at both ends of a window and integrate by
parts (Shinbrot 1957; Preisig & Rippin, *Comput. Chem. Eng.* 17, 1993): derivatives move from the noisy signals to φ.

    ∫φ v = R ∫φ i − L ∫φ' i − K ∫φ' θ                 (armature)
    K ∫φ i = J ∫φ'' θ − B ∫φ' θ + ∫φ τ_load           (shaft)

Both sides see the same φ, so noise is filtered alike; jittered time stamps enter exactly. v is held between samples, so
its integral is exact with φ's antiderivative; i and θ are taken by the trapezoidal rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import NDArray

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
        index: shape (w, m), the samples of each window.
        held_weight: shape (w, m): for ∫φ of a signal held from each sample to the next.
        weights: shape (3, w, m): for ∫φ, ∫φ', ∫φ'' of a continuous signal.
    """

    index: NDArray[np.intp]
    held_weight: F64
    weights: F64

    @property
    def weight_squares(self) -> F64:
        """Σ over all windows of the squared weights, shape (3,): white noise of variance 1 adds so much to the square
        of ∫φ x, ∫φ' x and ∫φ'' x, summed over the windows."""
        return np.asarray(np.einsum("kwm,kwm->k", self.weights, self.weights))

    def only(self, which: NDArray[np.bool_]) -> Windows:
        """Some of the windows; which: shape (w,)."""
        return Windows(self.index[which], self.held_weight[which], self.weights[:, which])

    def held(self, signal: F64) -> F64:
        """∫φ signal for a signal held between samples, shape (w,)."""
        return np.asarray(np.einsum("wm,wm->w", self.held_weight, signal.take(self.index)))

    def integral(self, signal: F64, derivative: int = 0) -> F64:
        """∫φ^(derivative) signal for a continuous signal, shape (w,)."""
        return self.integrals(signal, derivative)[0]

    def integrals(self, signal: F64, *derivatives: int) -> list[F64]:
        """The same for several derivatives, with one look at the signal."""
        samples = signal.take(self.index)
        return [np.asarray(np.einsum("wm,wm->w", self.weights[k], samples)) for k in derivatives]

    @property
    def of_one(self) -> F64:
        """∫φ, shape (w,)."""
        return np.asarray(self.weights[0].sum(axis=1))


def make_windows(time_s: F64, first: NDArray[np.intp], length: int) -> Windows:
    """Windows of `length` samples starting at the samples `first`.

    Args:
        time_s: shape (n,), strictly increasing.
        first: shape (w,).
    """
    index = first[:, None] + np.arange(length)
    t = time_s.take(index)
    span = t[:, -1:] - t[:, :1]
    s = (t - t[:, :1]) / span
    trapezoid = np.empty_like(t)
    trapezoid[:, 1:-1] = (t[:, 2:] - t[:, :-2]) / 2
    trapezoid[:, 0], trapezoid[:, -1] = (t[:, 1] - t[:, 0]) / 2, (t[:, -1] - t[:, -2]) / 2
    held = np.zeros_like(t)
    total = _phi_integral(s)
    np.multiply(total[:, 1:] - total[:, :-1], span, out=held[:, :-1])
    weights = np.empty((3, *t.shape))
    for weight, phi in zip(weights, _phi_and_derivatives(s), strict=True):
        np.multiply(phi, trapezoid, out=weight)
        trapezoid /= span  # d/dt = d/ds / span
    return Windows(index, held, weights)


def _phi_and_derivatives(s: F64) -> tuple[F64, F64, F64]:
    """φ, dφ/ds, d²φ/ds² in the shape of s: with p = s (1 − s) they are p⁵, 5 p⁴ (1 − 2 s) and p³ (20 − 90 p) times
    the height."""
    p = s * (1.0 - s)
    cube = p * p * (_HEIGHT * p)
    fourth = cube * p
    return fourth * p, fourth * (5.0 - 10.0 * s), cube * (20.0 - 90.0 * p)


def _phi_integral(s: F64) -> F64:
    """∫φ from 0 to s."""
    square = s * s
    total = np.full_like(s, _INTEGRAL_OVER_S6[-1])
    for coefficient in _INTEGRAL_OVER_S6[-2::-1].tolist():  # Horner
        total *= s
        total += coefficient
    square *= square * square
    total *= square
    return total
