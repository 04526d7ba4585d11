"""The motor's parameters by recursive least squares on modulated balances: starts the EKF, and watches it.

Two regressions, because two balances. With voltage, current and motion both are used (K comes from the armature, J
and B from the shaft with that K); with less, what is missing must be given (`known`), or nothing is said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.estimators.balance_window import BalanceWindow
from servo_daemon.estimators.balances import column_noise
from servo_daemon.estimators.modulating import Windows, make_windows
from servo_daemon.estimators.plausible import Plausible
from servo_daemon.estimators.rls import DirectionalRls, LinearEstimate
from servo_daemon.estimators.sampling import FEWEST_SAMPLES, SPAN_S
from servo_daemon.estimators.shaft_columns import DRY, EFFECT_SIGNALS, GIVES, SHAFT_COLUMNS
from servo_daemon.estimators.stretch import Stretch, between_samples, joined, last, median, motion, speed_sign
from servo_daemon.estimators.stretch import speed as speed_of
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: Excited directions forget with this time constant, s.
_MEMORY_S = 20.0
#: After the first updates (a tick each) so many are worked off together: fewer calls on longer arrays.
_EAGER_UPDATES, _BATCH = 50, 10
#: Windows overlap by half, so neighbouring rows share half their noise: their covariance is that much too small.
_OVERLAP_INFLATION = 2.0

_ARMATURE = ("R", "L", "K")


@dataclass(frozen=True, slots=True)
class RegressionEstimate:
    """Parameters in natural units: value shape (n,), covariance shape (n, n). Values may come out impossible."""

    names: tuple[str, ...]
    value: F64
    covariance: F64

    @property
    def std(self) -> F64:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


class MotorRls:
    """Armature and shaft regression over a growing recording, a tick at a time.

    Args:
        plant: the model; effects it cannot express linearly keep their nominal values.
        known: parameters that are given, in natural units (needed where a signal is missing).
    """

    def __init__(self, plant: PlantModel, known: Mapping[str, float]) -> None:
        self._plant, self._known = plant, dict(known)
        self._shaft_columns = ("J", "B", *(c for e in plant.effects for c in SHAFT_COLUMNS.get(e, ())))
        self._armature_columns = (*_ARMATURE, *(("one",) if "current_sensor_offset" in plant.effects else ()))
        given_torque = plant.drive == "voltage" and bool(known)
        self.window = BalanceWindow(self._armature_columns, self._shaft_columns, judges_mismatch=not given_torque)
        self._armature: DirectionalRls | None = None
        self._shaft: DirectionalRls | None = None
        self._pending: list[Stretch] = []
        self._noise_var: dict[str, float] = {}
        self._estimate: RegressionEstimate | None = None
        self._updates = 0
        self._sag = 0.0
        self._plausible = {which: Plausible() for which in SPAN_S}
        self._next = {"armature": 0.0, "shaft": 0.0}

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters these regressions can give, if the motion shows them."""
        both = self._plant.drive == "voltage" and not self._known
        return (*(_ARMATURE if both else ()), *(GIVES.get(c, c) for c in self._shaft_columns))

    def update(self, new: Stretch, noise_var: Mapping[str, float]) -> bool:
        """Take the samples of one tick; windows reach back into earlier ones. Returns whether they were worked off.

        Args:
            noise_var: of the measured channels, as far as it is known: what it adds to the regressors is taken out.

        The first ticks are worked off at once (the filter waits to start), later ones `_BATCH` at a time.
        """
        self._updates += 1
        self._noise_var = dict(noise_var)
        self._pending.append(new)
        if self._updates > _EAGER_UPDATES and self._updates % _BATCH:
            return False
        stretch = recorded = joined(self._pending)
        self.window.advance(float(stretch.time_s[-1]))
        if len(stretch.time_s) >= FEWEST_SAMPLES:
            period = median(stretch.time_s[1:] - stretch.time_s[:-1])
            rest, self._sag = self._between_samples(period)
            stretch = between_samples(stretch, rest)
            if stretch.voltage is not None and stretch.current is not None:
                self._armature_rows(stretch, period)
            self._shaft_rows(stretch, period)
            keep = max(FEWEST_SAMPLES, round(SPAN_S["shaft"] / period)) + 2
            recorded = last(recorded, keep)
        self._pending = [recorded]
        self._estimate = self._compute()
        return True

    def _between_samples(self, period_s: float) -> tuple[float, float]:
        """The current's mean between two samples is

            i_k + a (i_{k+1} − i_k) + (a − ½) h (K/R) dω/dt,   a = 1/(1 − exp(−x)) − 1/x,   x = h R/L,

        as it approaches the end of each held voltage with the time constant L/R while the speed goes on changing.

        Returns:
            a − ½ (0 .. ½), and (a − ½) h K/R in A·s²/rad; zeros while R, L and K are not known.
        """
        names = self._estimate.names if self._estimate is not None else ()
        if self._estimate is None or any(n not in names for n in _ARMATURE):
            return 0.0, 0.0
        R, L, K = (float(self._estimate.value[names.index(n)]) for n in _ARMATURE)
        if R <= 0.0 or L <= 0.0:
            return 0.0, 0.0
        x = min(max(period_s * R / L, 1e-3), 1e3)
        rest = float(1.0 / -np.expm1(-x) - 1.0 / x) - 0.5
        return rest, rest * period_s * K / R

    @property
    def in_regression(self) -> tuple[str, ...]:
        """Parameters that some column of these regressions stands for."""
        offset = ("i0",) if "one" in self._armature_columns else ()
        return (*self.names, *offset) if "R" in self.names else self.names

    def _windows(self, s: Stretch, period: float, which: str) -> Windows | None:
        """Windows that have not been used yet, half overlapping, none across unusable samples; of the armature, whose
        voltage is not known in a gap, none across a gap either."""
        length = max(FEWEST_SAMPLES, round(SPAN_S[which] / period)) + 1
        bad = ~s.usable
        broken = which == "armature" and s.gap is not None and bool(s.gap.any())
        if broken:
            assert s.gap is not None
            bad = bad | s.gap
        hop = max(1, length // 2)
        begin = int(np.searchsorted(s.time_s, self._next[which] - 0.25 * period))
        first = np.arange(begin, len(s.time_s) - length + 1, 1 if broken else hop, dtype=np.intp)
        if len(first) == 0:
            return None
        self._next[which] = float(s.time_s[first[-1] + (1 if broken else hop)])
        before = np.concatenate([[0], np.cumsum(bad)])
        # A gap before a window's first sample does no harm, one inside does.
        first = first[before[first + length] - before[first + 1] == 0]
        if broken:
            first = _apart(first, hop)
        return make_windows(s.time_s, first, length) if len(first) else None

    def _armature_rows(self, s: Stretch, period: float) -> None:
        w = self._windows(s, period, "armature")
        if w is None or s.voltage is None or s.current is None:
            return
        if self._armature is None:
            rows_per_s = 2.0 / max(SPAN_S["armature"], FEWEST_SAMPLES * period)
            self._armature = DirectionalRls(len(self._armature_columns), _MEMORY_S * rows_per_s)
        speed, acceleration = motion(w, s)
        current, current_rate = w.integrals(s.current, 0, 1)
        columns = [current + self._sag * acceleration, -current_rate, speed]
        if "one" in self._armature_columns:
            columns.append(w.of_one)
        Phi, y = np.column_stack(columns), w.held(s.voltage)
        self._take("armature", self._armature, float(s.time_s[-1]), Phi, y, w)

    def _shaft_rows(self, s: Stretch, period: float) -> None:
        if DRY.intersection(self._plant.effects):
            s = replace(s, usable=s.usable & (speed_sign(s) != 0.0))
        w = self._windows(s, period, "shaft")
        if w is None:
            return
        if self._shaft is None:
            rows_per_s = 2.0 / max(SPAN_S["shaft"], FEWEST_SAMPLES * period)
            self._shaft = DirectionalRls(len(self._shaft_columns), _MEMORY_S * rows_per_s)
        speed, acceleration = motion(w, s)
        columns = [acceleration, speed]
        if "asymmetric_friction" in self._plant.effects:  # B is that of positive motion alone
            columns[1] = speed - w.integral(np.minimum(speed_of(s), 0.0))
        for effect in self._plant.effects:
            columns += self._effect_columns(effect, w, s)
        y = self._driving_torque(w, s, speed, acceleration)
        if y is not None:
            Phi = np.column_stack(columns)
            self._take("shaft", self._shaft, float(s.time_s[-1]), Phi, y, w)

    def _take(self, which: str, rls: DirectionalRls, time_s: float, Phi: F64, y: F64, w: Windows) -> None:
        """Rows for a regression and for the window, without those that wrong samples have spoilt."""
        if rls.rows > 2 * Phi.shape[1]:
            good = self._plausible[which].rows(y - Phi @ rls.value, y)
            if not good.all():
                Phi, y, w = Phi[good], y[good], w.only(good)
        if len(y) == 0:
            return
        columns = self._armature_columns if which == "armature" else self._shaft_columns
        weight_squares = w.weight_squares
        rls.update(Phi, y, column_noise(columns, weight_squares, self._noise_var))
        self.window.add(which, time_s, Phi, y, weight_squares)

    def _effect_columns(self, effect: str, w: Windows, s: Stretch) -> list[F64]:
        if effect not in SHAFT_COLUMNS:
            return []
        return [w.integral(signal) for signal in EFFECT_SIGNALS[effect](s)]

    def _driving_torque(self, w: Windows, s: Stretch, speed: F64, acceleration: F64) -> F64 | None:
        """∫φ of motor torque, divided by K where K is to come from the armature; None if it cannot be had."""
        if s.torque is not None:
            return w.integral(s.torque)
        if s.current is not None:
            factor = 1.0 if s.voltage is not None else self._known.get("K")
            return None if factor is None else factor * (w.integral(s.current) + self._sag * acceleration)
        if s.voltage is not None and "R" in self._known and "K" in self._known:
            K, R = self._known["K"], self._known["R"]
            return (w.held(s.voltage) - K * speed) * (K / R)
        return None

    def estimate(self) -> RegressionEstimate | None:
        """What the regressions say, in natural units; None before they can say anything. It changes slowly and is
        asked for often: computed anew with each of the first updates, later with every batch."""
        return self._estimate

    def _compute(self) -> RegressionEstimate | None:
        armature = _first(self._armature.estimate(), len(_ARMATURE)) if self._armature is not None else None
        shaft = self._shaft.estimate() if self._shaft is not None else None
        if armature is None and (shaft is None or self._armature is not None):
            return None  # without K the shaft's coefficients are quotients only
        blocks = [e for e in (armature, shaft) if e is not None]
        value = np.concatenate([e.value for e in blocks])
        covariance = _side_by_side([e.covariance for e in blocks]) * _OVERLAP_INFLATION
        names = [*(_ARMATURE if armature is not None else []), *(self._shaft_columns if shaft is not None else [])]
        if armature is not None and shaft is not None:
            value, covariance = _times_torque_constant(value, covariance, names)
        elif self._plant.drive == "voltage" and self._known:
            value, covariance = _without_lag(value, covariance, self._known["L"] / self._known["R"])
        if "sin" in names:
            value, covariance = _amplitude_and_phase(value, covariance, names.index("sin"))
        return RegressionEstimate(tuple(GIVES.get(n, n) for n in names), value, covariance)


def _apart(first: NDArray[np.intp], hop: int) -> NDArray[np.intp]:
    """Of increasing indices those that are at least `hop` after the last one taken."""
    taken: list[int] = []
    for k in first.tolist():
        if not taken or k - taken[-1] >= hop:
            taken.append(k)
    return np.array(taken, dtype=np.intp)


def _first(e: LinearEstimate | None, n: int) -> LinearEstimate | None:
    """The first n coefficients: an offset's is of no use to anybody."""
    return None if e is None else LinearEstimate(e.value[:n], e.covariance[:n, :n], e.residual_var)


def _side_by_side(covariances: list[F64]) -> F64:
    """Of estimates that are independent of each other: a block diagonal matrix."""
    ends = np.cumsum([len(c) for c in covariances]).tolist()
    out = np.zeros((ends[-1], ends[-1]))
    for end, c in zip(ends, covariances, strict=True):
        out[end - len(c) : end, end - len(c) : end] = c
    return out


def _times_torque_constant(value: F64, covariance: F64, names: Sequence[str]) -> tuple[F64, F64]:
    """Shaft coefficients were found per unit of K (the third value): multiply, errors included to first order. A share
    of the torque (mu) is one of the current as well."""
    K = value[2]
    per_K = np.array([k >= 3 and name != "mu" for k, name in enumerate(names)])
    by = np.diag(np.where(per_K, K, 1.0))
    by[per_K, 2] = value[per_K]
    return np.where(per_K, K * value, value), by @ covariance @ by.T


def _without_lag(value: F64, covariance: F64, lag_s: float) -> tuple[F64, F64]:
    """(J, B, …) where (v − K ω)/R stood for the current, which lags behind it by L/R: the coefficient of dω/dt was then
    J + B L/R (to first order in the lag)."""
    by = np.eye(len(value))
    by[0, 1] = -lag_s
    return by @ value, by @ covariance @ by.T


def _amplitude_and_phase(value: F64, covariance: F64, k: int) -> tuple[F64, F64]:
    """(Tg cos φ, Tg sin φ) at k, k+1 as (Tg, φ): Tg sin(θ + φ) = (Tg cos φ) sin θ + (Tg sin φ) cos θ."""
    c, s = value[k], value[k + 1]
    size = max(float(np.hypot(c, s)), 1e-300)
    by = np.eye(len(value))
    by[k : k + 2, k : k + 2] = [[c / size, s / size], [-s / size**2, c / size**2]]
    out = value.copy()
    out[k], out[k + 1] = size, np.arctan2(s, c)
    return out, by @ covariance @ by.T
