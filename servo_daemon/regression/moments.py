"""Weights of short windows, corrected so that polynomials are integrated exactly.

With a dozen samples in a window the trapezoidal rule makes 2 % of the window's first angle an acceleration, and 1 % of
its speed: where the angle is a count from far away, or the friction small, that is all of the friction.
"""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.samples import F64

#: Longer windows are not corrected: there the rule leaves 1e-5 of an angle at most.
MOST_SAMPLES = 80
#: Windows in which samples are further apart than so many times the usual are left as they are: there is no telling.
_GAP = 3.0
#: Powers of time that are integrated exactly, 0 to this one.
_DEGREE = 4


def _moments(height: float) -> F64:
    """∫φ^(k) s^j ds over 0..1 for φ = height s⁵ (1 − s)⁵; shape (3, _DEGREE + 1)."""
    of_phi = [height * math.factorial(5 + j) * math.factorial(5) / math.factorial(11 + j) for j in range(_DEGREE + 1)]
    first = [0.0, *(-j * of_phi[j - 1] for j in range(1, _DEGREE + 1))]
    second = [0.0, 0.0, *(j * (j - 1) * of_phi[j - 2] for j in range(2, _DEGREE + 1))]
    return np.array([of_phi, first, second])


def correct(weights: F64, s: F64, height: float) -> None:
    """The smallest change, the ends' samples least, that makes the weights right for polynomials; in place.

    Args:
        weights: shape (3, w, m), for ∫φ ds, ∫φ' ds and ∫φ'' ds.
        s: shape (w, m), the samples' places in their windows, 0..1.
        height: of φ.
    """
    even = (s[:, 1:] - s[:, :-1]).max(axis=1) * (s.shape[1] - 1) < _GAP
    if not even.all():
        part = weights[:, even]
        if even.any():
            correct(part, s[even], height)
        weights[:, even] = part
        return
    power = s[:, None, :] ** np.arange(_DEGREE + 1)[None, :, None]
    free = power * (s * (1.0 - s))[:, None, :] ** 2
    lacking = _moments(height)[:, None, :] - np.einsum("kwm,wjm->kwj", weights, power)
    share = np.linalg.solve(np.einsum("wjm,wim->wji", free, power), np.moveaxis(lacking, 0, -1))
    weights += np.einsum("wjk,wjm->kwm", share, free)
