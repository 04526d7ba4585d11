"""Least squares of the missing series over the traces of supposed causes, held out by time blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servo_daemon.diagnosis.missing.missing import Fitted, Missing
from servo_daemon.diagnosis.missing.response import smoothed
from servo_daemon.parameters import WINDING_NAMES
from servo_daemon.plant.columns.screening import Motion, Trace
from servo_daemon.samples import F64

#: Time blocks, and folds of the cross-validation: fold f holds out blocks f, f + FOLDS, …, so that a step or a slow
#: drift has both sides in every part (chosen; not tried).
BLOCKS, FOLDS = 20, 5
#: A trace beyond it has no sum of squares: numbers end at 10³⁰⁸.
_LARGEST = 1e100
#: A change of J by this share costs as much as the whole series (`Regression`; chosen; not tried).
MOST_CHANGE = 0.3


@dataclass(frozen=True)
class Regression:
    """Normal equations by time block.

    Attributes:
        XX, Xy, yy: shapes (blocks, m, m), (blocks, m), (blocks,); series in units of their standard deviations.
        unknown: the series' variances summed, in the same units.
        stiffness: shape (m,), 1/(largest relative change)² of the inertia's column, 0 of the others.

    The stiffness matters: the unmodelled torque is K i − J dω/dt − B ω, so a current together with parameters near zero
    "explains" any of it. A change of J by `MOST_CHANGE` therefore costs as much as the whole series.
    """

    XX: F64
    Xy: F64
    yy: F64
    unknown: float
    stiffness: F64

    @classmethod
    def of(
        cls,
        missing: Missing,
        motion: Motion,
        traces: Sequence[Trace],
        stiff: Sequence[float],
    ) -> Regression:
        """Series over traces; `stiff`: the stiffness of the first of them, as `of_parameters` has it."""
        # A trace that leaves the range of numbers (a spring too stiff for this sampling, a speed of zero in a
        # denominator) explains nothing.
        columns = smoothed(missing, traces)
        for shown in columns.values():
            shown[:, ~((shown.max(axis=0) < _LARGEST) & (shown.min(axis=0) > -_LARGEST))] = 0.0
        edges = np.linspace(0, len(motion.t), BLOCKS + 1).astype(int)
        XX, Xy, yy = np.zeros((BLOCKS, len(traces), len(traces))), np.zeros((BLOCKS, len(traces))), np.zeros(BLOCKS)
        unknown, moving = 0.0, ~motion.rest & missing.seen
        for name, series in missing.series.items():
            unit = float(np.median(missing.std[name]))
            unknown += float(np.sum((missing.std[name][moving] / unit) ** 2))
            for b, (begin, end) in enumerate(pairwise(edges)):
                here = moving[begin:end] / unit
                X, y = columns[name][begin:end] * here[:, None], series[begin:end] * here
                XX[b] += X.T @ X
                Xy[b] += X.T @ y
                yy[b] += y @ y
        stiffness = np.zeros(len(traces))
        stiffness[: len(stiff)] = stiff
        return cls(XX, Xy, yy, unknown, stiffness)

    def coefficients(self, columns: Sequence[int], blocks: Sequence[int] = range(BLOCKS)) -> F64:
        """Least squares over some blocks, shape (columns,)."""
        chosen = list(columns)
        over = list(blocks)
        A = self.XX[over].sum(axis=0)[np.ix_(chosen, chosen)] + np.diag(self.stiffness[chosen] * self.yy[over].sum())
        scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
        found, *_ = np.linalg.lstsq(A / np.outer(scale, scale), self.Xy[over].sum(axis=0)[chosen] / scale, rcond=1e-9)
        return np.asarray(found / scale)

    def errors(self, columns: Sequence[int]) -> tuple[float, float]:
        """Sum of squares left: where it was fitted, and on the blocks held out."""
        inside = self._left(columns, self.coefficients(columns), range(BLOCKS))
        heldout = 0.0
        for fold in range(FOLDS):
            out = range(fold, BLOCKS, FOLDS)
            rest = [b for b in range(BLOCKS) if b not in out]
            heldout += self._left(columns, self.coefficients(columns, rest), out)
        return max(inside, 1e-300), max(heldout, 1e-300)

    def _left(self, columns: Sequence[int], beta: F64, blocks: Sequence[int]) -> float:
        chosen, over = list(columns), list(blocks)
        A = self.XX[over].sum(axis=0)[np.ix_(chosen, chosen)]
        return float(self.yy[over].sum() - 2 * beta @ self.Xy[over].sum(axis=0)[chosen] + beta @ A @ beta)


def biased_names(fit: Fitted, missing: Missing) -> list[str]:
    """Free parameters whose change would leave something missing, in the order of `of_parameters`.

    Where a current is the input no data tell K: it scales all torques, and a K of nothing would leave nothing missing.
    """
    voltage = missing.augmented.plant.drive == "voltage"
    known = ("J", "B", "Tc", "TL", "i0", "v0", *(WINDING_NAMES if voltage else ()))
    return [name for name in (*fit.problem.free, *fit.problem.local) if name in known]


def of_parameters(motion: Motion, fit: Fitted, missing: Missing) -> tuple[list[Trace], list[float]]:
    """What a change of each free parameter of the plant would leave missing (R, L, K, J, B: per relative change), and
    how stiff each is: J, without which none of the trivial explanations works; R, K and B may be biased by any
    amount."""
    m, one = motion, np.ones(len(motion.t))
    voltage = missing.augmented.plant.drive == "voltage"
    K = m.p.get("K", 1.0)
    known = {
        "J": Trace(torque=m.p["J"] * m.omega_rate),
        "B": Trace(torque=m.p["B"] * m.omega),
        "K": Trace(torque=-K * m.i, voltage=K * m.omega) if voltage else Trace(torque=-K * m.i),
        "Tc": Trace(torque=np.where(m.rest, 0.0, m.direction)),
        "TL": Trace(torque=one),
        "i0": Trace(shown={"current_A": one}) if voltage else Trace(torque=K * one),
        "v0": Trace(voltage=one),
    }
    if voltage:
        known |= {"R": Trace(voltage=m.p["R"] * m.i), "L": Trace(voltage=m.p["L"] * m.i_rate)}
    names = biased_names(fit, missing)
    return [known[name] for name in names], [MOST_CHANGE**-2.0 if name == "J" else 0.0 for name in names]
