"""Dry friction that the model does not have, in the shaft's balance: how much of it passes for B.

A drive that goes up and down turns at two speeds, and dry friction has the trace of more viscous friction: the balance
closes with a B that is 8 to 30 % too large, and nothing is left that says so. With the direction of the motion as one
more column the same rows show it, and by how much J and B move without it is how far they may be off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from servo_daemon.numerics import is_definite
from servo_daemon.regression.balances import GramWindow, Sums, noise_squares
from servo_daemon.regression.rls_fit import CHANCE_STDS, LEAST_SIGNAL, OVERLAP, SYSTEMATIC
from servo_daemon.regression.sampling import WINDOW_S
from servo_daemon.samples import F64


class HiddenFriction:
    """The shaft's rows of a model without dry friction, [Φ | what that would add | y], over the last seconds.

    Args:
        columns: of Φ.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        self._columns = tuple(columns)
        self._rows = GramWindow(WINDOW_S)

    def clear(self) -> None:
        self._rows.clear()

    def add(self, time_s: float, part: Sums) -> None:
        """Rows that end at about `time_s`."""
        self._rows.add(time_s, part)

    def moves(self, time_s: float, noise_var: Mapping[str, float]) -> dict[str, float] | None:
        """By how much the logarithms of J and B are off where the friction plainly is in the balance at `time_s`; None
        where the motion does not tell it."""
        total = self._rows.total(time_s)
        if total is None:
            return None
        noise = noise_squares((*self._columns, "dry"), total.weight_squares, noise_var)
        moved = _moved_by_last(total, noise)
        if moved is None:
            return None
        return {n: abs(m) for n, m in zip(self._columns, moved.tolist(), strict=True) if n in ("J", "B")}


def _moved_by_last(sums: Sums, noise: F64) -> F64 | None:
    """By how much the logarithms of the other coefficients move if the last column is left out, shape (n,): zero where
    its coefficient is not plainly positive; None where the rows do not tell it.

    Args:
        sums: of [Φ | last column | y].
        noise: what of the diagonal of the columns' Gram matrix is noise, shape (n + 1,).
    """
    n = len(noise)
    scale = np.sqrt(np.maximum(sums.gram.diagonal()[:-1], 1e-300))
    signal = (sums.gram[:-1, :-1] - np.diag(noise)) / (scale[:, None] * scale)
    if sums.rows <= 2 * n or not is_definite(signal, LEAST_SIGNAL):
        return None
    b = sums.gram[:-1, -1] / scale
    inverse = np.linalg.inv(signal)
    with_it, without = inverse @ b, np.linalg.solve(signal[:-1, :-1], b[:-1])
    square = float(sums.gram[-1, -1])
    left = max(0.0, square - float(b @ with_it))
    var = (OVERLAP * left / (sums.rows - n) + SYSTEMATIC**2 * square) * float(inverse[-1, -1])
    if not with_it[-1] > CHANCE_STDS * math.sqrt(var):
        return np.zeros(n - 1)
    shared = np.maximum(with_it[:-1], np.abs(without) / math.e)
    return np.asarray(np.log(np.maximum(without, shared / math.e) / shared))
