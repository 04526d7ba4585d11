"""Cheap screening: how much of the missing torque and voltage each effect of the contract could explain.

Every effect is a few columns (its formula over the smoothed signals, carried through the smoother), linear in their
coefficients; what is not linear is scanned. They are fitted to both series at once, in units of their standard
deviations, beside what the plant's free parameters would explain: a bent R, K or B is no effect. The score is the
share explained of time blocks that the coefficients have not seen. It ranks candidates and gives their start values; a
verdict it is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.basis import Basis, Context, Family
from servo_daemon.diagnosis.missing import Missing
from servo_daemon.diagnosis.response import Trace, smoothed
from servo_daemon.diagnosis.signals import Motion, motion_of
from servo_daemon.diagnosis.torque_families import FAMILIES
from servo_daemon.diagnosis.two_mass_families import FAMILIES as TWO_MASS
from servo_daemon.diagnosis.winding_families import CURRENT, SENSORS, WINDING
from servo_daemon.estimators.output_error import OutputErrorFit
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: Time blocks, and folds of the cross-validation: fold f holds out blocks f, f + FOLDS, …, so that a step or a slow
#: drift has both sides in every part.
BLOCKS, FOLDS = 20, 5
#: A parameter more must lower what is left by this share to come before.
_WORTH = 0.05


@dataclass(frozen=True, slots=True)
class ScreenedCandidate:
    """One effect.

    Attributes:
        effect: name of the contract.
        share: of the missing torque and voltage that it explains beyond the plant's free parameters, 0 .. 1.
        start: start values of its parameters, SI units ("channel" of a delay: the channel's name).
        heldout_share: the same on blocks the coefficients have not seen; negative: worse than nothing.
    """

    effect: str
    share: float
    start: Mapping[str, float | str]
    heldout_share: float


def families(plant: PlantModel) -> dict[str, Family]:
    """The effects that this plant's input can show, by name, less those it has."""
    known = dict(FAMILIES)
    if plant.drive == "voltage":
        known |= WINDING
    if plant.drive != "torque":
        known |= CURRENT
    known |= SENSORS | TWO_MASS
    return {name: family for name, family in known.items() if name not in plant.effects}


def screen(fit: OutputErrorFit, missing: Missing) -> tuple[ScreenedCandidate, ...]:
    """All effects that could be, the most promising first.

    Args:
        fit: whose free parameters explain first.
        missing: of `missing_inputs`.
    """
    motion = motion_of(missing)
    nuisance = _of_parameters(motion, fit, missing)
    context = _context(missing, motion, nuisance)
    bases = [b for family in families(fit.problem.plant).values() for b in family(context)]
    keys = list(context.traces)
    equations = _Equations.of(missing, motion, [*nuisance, *context.traces.values()])
    before = equations.errors(range(len(nuisance)))
    best: dict[str, tuple[float, ScreenedCandidate]] = {}
    for basis in bases:
        columns = [*range(len(nuisance)), *(len(nuisance) + keys.index(key) for key in basis.columns)]
        scored = _scored(basis, equations, columns, before)
        if scored is not None and (basis.effect not in best or scored[0] < best[basis.effect][0]):
            best[basis.effect] = scored
    return tuple(candidate for _, candidate in sorted(best.values(), key=lambda pair: pair[0]))


def _scored(
    basis: Basis, equations: _Equations, columns: Sequence[int], before: tuple[float, float]
) -> tuple[float, ScreenedCandidate] | None:
    """Rank (low is good) and candidate; None where no physical parameters give these coefficients."""
    start = basis.start(equations.coefficients(columns)[-len(basis.columns) :])
    if start is None:
        return None
    inside, heldout = equations.errors(columns)
    # The mean square of what is missing is that of its mean and its variance: where the series is no larger than its
    # standard deviation there is little to explain.
    share = (before[0] - inside) / (before[0] + equations.unknown)
    heldout_share = (before[1] - heldout) / (before[1] + equations.unknown)
    rank = float(np.log(max(1 - heldout_share, 1e-12))) + _WORTH * basis.parameters
    plain = {name: value if isinstance(value, str) else float(value) for name, value in start.items()}
    return rank, ScreenedCandidate(basis.effect, float(share), plain, float(heldout_share))


@dataclass(frozen=True)
class _Equations:
    """Normal equations by time block: XᵀX (blocks, m, m), Xᵀy (blocks, m), yᵀy (blocks,); the series' variances summed."""

    XX: F64
    Xy: F64
    yy: F64
    unknown: float

    @classmethod
    def of(cls, missing: Missing, motion: Motion, traces: Sequence[Trace]) -> _Equations:
        columns = smoothed(missing, traces)
        block = np.minimum((np.arange(len(motion.t)) * BLOCKS) // len(motion.t), BLOCKS - 1)
        XX, Xy, yy = np.zeros((BLOCKS, len(traces), len(traces))), np.zeros((BLOCKS, len(traces))), np.zeros(BLOCKS)
        unknown = 0.0
        for name, series in missing.series.items():
            unit = float(np.median(missing.std[name]))
            X, y = columns[name] / unit, series / unit
            unknown += float(np.sum((missing.std[name][~motion.rest] / unit) ** 2))
            for b in range(BLOCKS):
                here = (block == b) & ~motion.rest
                XX[b] += X[here].T @ X[here]
                Xy[b] += X[here].T @ y[here]
                yy[b] += y[here] @ y[here]
        return cls(XX, Xy, yy, unknown)

    def coefficients(self, columns: Sequence[int], blocks: Sequence[int] = range(BLOCKS)) -> F64:
        """Least squares over some blocks, shape (columns,)."""
        chosen = list(columns)
        A = self.XX[list(blocks)].sum(axis=0)[np.ix_(chosen, chosen)]
        scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
        found, *_ = np.linalg.lstsq(A / np.outer(scale, scale), self.Xy[list(blocks)].sum(axis=0)[chosen] / scale, rcond=1e-9)
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


def _of_parameters(motion: Motion, fit: OutputErrorFit, missing: Missing) -> list[Trace]:
    """What a change of each free parameter of the plant would leave missing."""
    m, one = motion, np.ones(len(motion.t))
    voltage = missing.augmented.plant.drive == "voltage"
    known = {
        "R": Trace(voltage=m.i),
        "L": Trace(voltage=m.i_rate),
        "K": Trace(torque=-m.i, voltage=m.omega) if voltage else Trace(torque=-m.i),
        "J": Trace(torque=m.omega_rate),
        "B": Trace(torque=m.omega),
        "Tc": Trace(torque=np.where(m.rest, 0.0, m.direction)),
        "TL": Trace(torque=one),
        "i0": Trace(shown={"current_A": one}) if voltage else Trace(torque=m.p.get("K", 1.0) * one),
        "v0": Trace(voltage=one),
    }
    return [known[name] for name in (*fit.problem.free, *fit.problem.local) if name in known]


def _context(missing: Missing, motion: Motion, nuisance: Sequence[Trace]) -> Context:
    moving = ~motion.rest
    residual = {name: np.where(moving, series, 0.0) for name, series in missing.series.items()}
    columns = smoothed(missing, nuisance) if nuisance else {}
    stacked = [(columns[n] / np.median(missing.std[n])) * moving[:, None] for n in columns]
    if stacked:
        y = np.concatenate([residual[n] / np.median(missing.std[n]) for n in columns])
        beta, *_ = np.linalg.lstsq(np.vstack(stacked), y, rcond=1e-9)
        residual = {n: np.where(moving, missing.series[n] - columns[n] @ beta, 0.0) for n in columns}
    held = motion.direction
    if "torque" in residual and moving.any():
        level = float(residual["torque"] @ motion.direction) / int(moving.sum())
        at_rest = np.clip(missing.series["torque"] / level, -1, 1) if level > 0 else np.zeros(len(held))
        held = np.where(moving, motion.direction, at_rest)
    return Context(motion, residual, held)
