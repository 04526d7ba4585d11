"""The motor's parameters by recursive least squares on modulated balances: starts the EKF, and watches it.

Two regressions, because two balances. With voltage, current and motion both are used (K comes from the armature, J
and B from the shaft with that K); with less, what is missing must be given (`known`), or nothing is said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import upper_median
from servo_daemon.parameters import WINDING_NAMES
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.balance_window import BalanceWindow
from servo_daemon.regression.balances import Sums, expected_square, noise_squares
from servo_daemon.regression.columns.derived_terms import ADDED_TO
from servo_daemon.regression.columns.terms import (
    armature_columns,
    armature_offsets,
    as_parameters,
    columns_of,
    derived_of,
    given_by,
    shaft_columns,
    shaft_signals,
    unseen_in,
)
from servo_daemon.regression.estimate import (
    RegressionEstimate,
    as_current,
    side_by_side,
    times_torque_constant,
    without_lag,
)
from servo_daemon.regression.held_shaft import HeldShaft
from servo_daemon.regression.lag import Lag
from servo_daemon.regression.modulating import Windows, make_windows
from servo_daemon.regression.plausible import Plausible
from servo_daemon.regression.rls import SPANS_S, LinearEstimate, SlidingRls
from servo_daemon.regression.rls_fit import OVERLAP
from servo_daemon.regression.sampling import FEWEST_SAMPLES, SPAN_S, Sampling
from servo_daemon.regression.small_matrices import in_columns
from servo_daemon.regression.stretch import Stretch, between_samples, joined, last, motion
from servo_daemon.samples import F64

#: After the first updates (a tick each) so many are worked off together: fewer calls on longer arrays.
_EAGER_UPDATES, _BATCH = 50, 10

#: A current has a direction beyond so many standard deviations of its noise.
_DIRECTED = 3.0
#: What a balance that does not close gives is known to this share at best, 1 σ (with a second inertia the shaft's
#: regression finds the sum of both, by slow motion).
_OPEN_STD = 0.3


class MotorRls:
    """Armature and shaft regression over a growing recording, a tick at a time.

    Args:
        plant: the model; effects it cannot express linearly keep their nominal values.
        known: parameters that are given, in natural units (needed where a signal is missing).
        nuisance: parameters of the plant that nobody asks for: no offset of the armature is named that is one of them.
        nominal: what orders, frequencies and the like are held at, and what is not linear is taken at.
        sees_angle: the angle is measured, not only the speed.
        spans_s: lengths of the regressions' windows, increasing (`rls`).
    """

    def __init__(
        self,
        plant: PlantModel,
        known: Mapping[str, float],
        nuisance: Sequence[str] = (),
        nominal: Mapping[str, float] | None = None,
        *,
        sees_angle: bool = True,
        spans_s: Sequence[float] = SPANS_S,
    ) -> None:
        self._plant, self._known, self._spans_s = plant, dict(known), tuple(spans_s)
        self._taken_at = {p.name: p.nominal for p in plant.parameters} | dict(nominal or {})
        self._current_gain = self._taken_at.get("g_i", 1.0)
        self._lag = Lag(self._taken_at["t_lag"]) if "t_lag" in plant.parameter_names else None
        given_torque = plant.drive == "voltage" and bool(known)
        unseen = unseen_in(plant.effects, sees_current=not given_torque, sees_angle=sees_angle)
        derived = derived_of(plant.effects)
        self._derived = tuple(d for d in derived if d.effect not in unseen)
        #: Balances that do not close, and judge nothing.
        self._open = frozenset[str]().union(*(d.open if d in self._derived else ADDED_TO for d in derived))
        self._shaft_effects = tuple(e for e in plant.effects if e not in unseen)
        self._shaft_columns = ("J", "B", *shaft_columns(self._shaft_effects))
        self._offsets = armature_offsets(plant.effects)
        self._armature_columns = (*WINDING_NAMES, *armature_columns(self._shaft_effects))
        asked = len(self._offsets) == 1 and self._offsets[0] not in nuisance
        of_terms = [c for d in self._derived for c in d.columns["armature"]]
        named = {c: c for c in (*WINDING_NAMES, "Vb", *of_terms)} | ({"one": self._offsets[0]} if asked else {})
        self._armature_named = {c: named[c] for c in self._armature_columns if c in named}
        self.window = BalanceWindow(self._armature_columns, self._shaft_columns, judges_mismatch=not given_torque)
        self._armature: SlidingRls | None = None
        self._shaft: SlidingRls | None = None
        self._held = HeldShaft(self._armature_columns)
        self._pending: list[Stretch] = []
        self._noise_var: dict[str, float] = {}
        self._sampling: Sampling | None = None
        self._estimate: RegressionEstimate | None = None
        self._updates = 0
        self._sag = 0.0
        self._plausible = {which: Plausible() for which in SPAN_S}
        self._next = {"armature": 0.0, "shaft": 0.0}

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters these regressions can give, if the motion shows them."""
        both = self._plant.drive == "voltage" and not self._known
        return (*(self._armature_named.values() if both else ()), *map(given_by, self._shaft_columns))

    def update(self, new: Stretch, noise_var: Mapping[str, float], sampling: Sampling | None = None) -> bool:
        """Take the samples of one tick; windows reach back into earlier ones. Returns whether they were worked off.

        Args:
            noise_var: of the measured channels, as far as it is known: what it adds to the regressors is taken out.
            sampling: noise and what else integrals over samples are off by, once a filter has found it: what the
                balances leave beyond it is no noise.

        The first ticks are worked off at once (the filter waits to start), later ones `_BATCH` at a time.
        """
        self._updates += 1
        self._noise_var, self._sampling = dict(noise_var), sampling
        if self._current_gain != 1.0 and new.current is not None:
            new = replace(new, current=new.current / self._current_gain)
        if self._lag is not None and new.voltage is not None:
            new = replace(new, voltage=self._lag.mean_of(new.time_s, new.voltage))
        self._pending.append(new)
        if self._updates > _EAGER_UPDATES and self._updates % _BATCH:
            return False
        stretch = recorded = joined(self._pending)
        end_s = float(stretch.time_s[-1])
        self.window.advance(end_s)
        for rls in (self._armature, self._shaft):
            if rls is not None:
                rls.advance(end_s)
        if len(stretch.time_s) >= FEWEST_SAMPLES:
            period = upper_median(stretch.time_s[1:] - stretch.time_s[:-1])
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

    def expect_change(self) -> None:
        """A parameter has stepped: rows that are far off what the regressions expect are no spoilt ones. (How much of
        the old motor they still hold the regressions see by themselves.)"""
        self.window.clear()
        self._plausible = {which: Plausible() for which in SPAN_S}

    def follow_lag(self, lag_s: float) -> None:
        """What the filter has found of the drive's lag, which no regression finds."""
        if self._lag is not None:
            self._lag.lag_s = lag_s

    def _between_samples(self, period_s: float) -> tuple[float, float]:
        """The current's mean between two samples is

            i_k + a (i_{k+1} − i_k) + (a − ½) h (K/R) dω/dt,   a = 1/(1 − exp(−x)) − 1/x,   x = h R/L,

        as it approaches the end of each held voltage with the time constant L/R while the speed goes on changing.

        Returns:
            a − ½ (0 .. ½), and (a − ½) h K/R in A·s²/rad (of a held shaft 0); zeros while R and L are not known.
        """
        names = self._estimate.names if self._estimate is not None else ()
        if self._estimate is None or any(n not in names for n in ("R", "L")):
            return 0.0, 0.0
        values = dict(zip(names, self._estimate.value.tolist(), strict=True))
        R, L, K = (values.get(n, 0.0) for n in WINDING_NAMES)
        if R <= 0.0 or L <= 0.0:
            return 0.0, 0.0
        x = min(max(period_s * R / L, 1e-3), 1e3)
        rest = float(1.0 / -np.expm1(-x) - 1.0 / x) - 0.5
        return rest, rest * period_s * K / R

    @property
    def winding(self) -> RegressionEstimate | None:
        """R and L of a motor whose shaft is held, where R is known; None: it is not, or R is not yet."""
        return self._held.estimate()

    @property
    def in_regression(self) -> tuple[str, ...]:
        """Parameters that some column of these regressions stands for, and that they can judge."""
        columns = {"armature": self._armature_named.values(), "shaft": [given_by(c) for c in self._shaft_columns]}
        left_out = {name for which in self._open for name in columns[which]}
        names = [n for n in self.names if n not in left_out]
        return tuple(dict.fromkeys((*names, *(self._offsets if "R" in names else ()))))

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
        if np.count_nonzero(bad):
            before = np.concatenate([[0], np.cumsum(bad)])
            # A gap before a window's first sample does no harm, one inside does.
            first = first[before[first + length] - before[first + 1] == 0]
        if broken:
            first = _apart(first, hop)
        return make_windows(s.time_s, first, length) if len(first) else None

    def _armature_rows(self, s: Stretch, period: float) -> None:
        direction = None
        brushes = "Vb" in self._armature_columns
        if (brushes or any(d.by_current_direction for d in self._derived)) and s.current is not None:
            direction = self._direction(s.current)
            s = replace(s, usable=s.usable & (direction != 0.0))
        w = self._windows(s, period, "armature")
        if w is None or s.voltage is None or s.current is None:
            return
        if self._armature is None:
            self._armature = SlidingRls(len(self._armature_columns), self._spans_s)
        speed, acceleration = motion(w, s)
        current, current_rate = w.integrals(s.current, 0, 1)
        columns = [current + self._sag * acceleration, -current_rate, speed]
        if "one" in self._armature_columns:
            columns.append(w.of_one)
        if direction is not None and brushes:
            columns.append(w.integral(direction))
        if "rip_sin" in self._armature_columns:
            columns += self._rippled_speed(w, s)
        columns += [w.integral(x) for d in self._derived for x in d.signals("armature", s, self._taken_at)]
        Phi, y = in_columns(columns), w.held(s.voltage)
        self._take("armature", self._armature, float(s.time_s[-1]), Phi, y, w)
        self._held.take(s, Phi, y)

    def _shaft_rows(self, s: Stretch, period: float) -> None:
        if self._plant.may_stick:
            s = replace(s, usable=s.usable & (s.sliding != 0.0))
        w = self._windows(s, period, "shaft")
        if w is None:
            return
        if self._shaft is None:
            self._shaft = SlidingRls(len(self._shaft_columns), self._spans_s)
        speed, acceleration = motion(w, s)
        columns = [acceleration, speed]
        if "B_neg" in self._shaft_columns:  # B is that of positive motion alone
            columns[1] = speed - w.integral(np.minimum(s.speed, 0.0))
        for effect in self._shaft_effects:
            columns += self._effect_columns(effect, w, s)
        y = self._driving_torque(w, s, speed, acceleration)
        if y is not None:
            Phi = in_columns(columns)
            self._take("shaft", self._shaft, float(s.time_s[-1]), Phi, y, w)

    def _take(self, which: str, rls: SlidingRls, time_s: float, Phi: F64, y: F64, w: Windows) -> None:
        """Rows for a regression and for the window, without those that wrong samples have spoilt."""
        if rls.value is not None:
            good = self._plausible[which].rows(y - Phi @ rls.value, y)
            if np.count_nonzero(good) < len(good):
                Phi, y, w = Phi[good], y[good], w.only(good)
        if len(y) == 0:
            return
        columns = self._armature_columns if which == "armature" else self._shaft_columns
        sums = Sums.of(Phi, y, w.weight_squares)
        noise = noise_squares(columns, sums.weight_squares, self._noise_var)
        rls.update(time_s, sums.gram, sums.rows, noise, self._expected(which, rls, sums))
        if which not in self._open:
            self.window.add(which, time_s, sums)

    def _expected(self, which: str, rls: SlidingRls, sums: Sums) -> float | None:
        """The sum of squares that noise and sampling leave of new rows; None while it is not known."""
        if self._sampling is None or rls.value is None or not self.window.judges_mismatch:
            return None
        columns = (*(self._armature_columns if which == "armature" else self._shaft_columns), "y")
        return expected_square(which, columns, sums, rls.value, self._sampling, self.window.y_channel(which))

    def _effect_columns(self, effect: str, w: Windows, s: Stretch) -> list[F64]:
        if not columns_of(effect, self._shaft_effects):
            return []
        return [w.integral(signal) for signal in shaft_signals(effect, s, self._taken_at)]

    def _direction(self, current: F64) -> F64:
        """Sign of the current per sample, 0 where its noise may have made it."""
        least = _DIRECTED * self._noise_var.get("current_A", 0.0) ** 0.5
        return np.where(np.abs(current) > least, np.sign(current), 0.0)

    def _rippled_speed(self, w: Windows, s: Stretch) -> list[F64]:
        """∫φ ω sin(n θ) and ∫φ ω cos(n θ), by parts."""
        n = self._taken_at["n_rip"]
        assert s.position is not None
        sine, cosine = w.integral(np.sin(n * s.position), 1), w.integral(np.cos(n * s.position), 1)
        return [cosine / n, -sine / n]

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

    def _armature_estimate(self) -> LinearEstimate | None:
        """R, L, K and what else is named; a constant that two offsets share is neither's."""
        found = None if self._armature is None else self._armature.estimate()
        if found is None:
            return None
        index = [self._armature_columns.index(c) for c in self._armature_named]
        value, covariance = found.value, found.covariance
        if index != list(range(len(value))):
            value, covariance = value[index], covariance[np.ix_(index, index)]
        names = tuple(self._armature_named.values())
        if "i0" in names:
            value, covariance = as_current(value, covariance, names.index("i0"))
        return replace(found, value=value, covariance=covariance)

    def _compute(self) -> RegressionEstimate | None:
        armature = self._armature_estimate()
        shaft = self._shaft.estimate() if self._shaft is not None else None
        if armature is None and (shaft is None or self._armature is not None):
            return self._held.estimate()  # without K the shaft's coefficients are quotients only
        blocks = [e for e in (armature, shaft) if e is not None]
        value = np.concatenate([e.value for e in blocks])
        covariance = side_by_side([e.covariance for e in blocks]) * OVERLAP
        own = tuple(self._armature_named.values()) if armature is not None else ()
        columns = [*own, *(self._shaft_columns if shaft is not None else [])]
        if armature is not None and shaft is not None:
            value, covariance = times_torque_constant(value, covariance, columns, len(own))
        elif self._plant.drive == "voltage" and self._known:
            value, covariance = without_lag(value, covariance, self._known["L"] / self._known["R"])
        if shaft is not None:
            value, covariance = as_parameters(columns, value, covariance)
        if self._open and (shaft is not None or "armature" in self._open):
            first = 0 if "armature" in self._open else len(own)
            doubt = np.array([k >= first for k in range(len(value))]) * _OPEN_STD * value
            covariance = covariance + np.diag(doubt**2)
        span_s = max(e.span_s for e in blocks)
        names = (*own, *map(given_by, columns[len(own) :]))
        return RegressionEstimate(names, value, covariance, span_s, all(e.closes for e in blocks))


def _apart(first: NDArray[np.intp], hop: int) -> NDArray[np.intp]:
    """Of increasing indices those that are at least `hop` after the last one taken."""
    taken: list[int] = []
    for k in first.tolist():
        if not taken or k - taken[-1] >= hop:
            taken.append(k)
    return np.array(taken, dtype=np.intp)
