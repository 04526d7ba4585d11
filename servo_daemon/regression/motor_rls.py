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
from servo_daemon.regression.columns.of_model import ModelColumns
from servo_daemon.regression.columns.rows import ModelRows, RowMaker
from servo_daemon.regression.columns.terms import as_parameters, given_by
from servo_daemon.regression.estimate import (
    RegressionEstimate,
    as_current,
    side_by_side,
    times_torque_constant,
    without_lag,
)
from servo_daemon.regression.held_shaft import HeldShaft
from servo_daemon.regression.lag import Lag
from servo_daemon.regression.plausible import Plausible
from servo_daemon.regression.rls import SPANS_S, LinearEstimate, SlidingRls
from servo_daemon.regression.rls_fit import OVERLAP
from servo_daemon.regression.sampling import FEWEST_SAMPLES, SPAN_S, Sampling, coarse, sampled_std, settling
from servo_daemon.regression.stretch import Stretch, between_samples, joined, last
from servo_daemon.samples import F64

#: After the first ticks so many are worked off together: fewer calls on longer arrays (chosen; the first is free within
#: half and twice, with twenty rows at a time the RLS errs by a fifth more).
_EAGER_UPDATES, _BATCH = 50, 10
#: Of a drive whose ticks come several together every second time it is not asked what follows from it (chosen; every
#: time is no better, every fourth time the RLS errs by 6 % more).
_ASKED_EVERY = 2

#: What a balance that does not close gives is known to this share at best, 1 σ (with a second inertia the shaft's
#: regression finds the sum of both, by slow motion; chosen; half and twice move no tracking figure).
_OPEN_STD = 0.3


class MotorRls:
    """Armature and shaft regression over a growing recording, a tick at a time.

    Args:
        plant: the model; effects it cannot express linearly keep their nominal values.
        known: parameters that are given, in natural units (needed where a signal is missing).
        biases: parameters of the plant that nobody asks for: no offset of the armature is named that is one of them.
        nominal: what orders, frequencies and the like are held at, and what is not linear is taken at.
        sees_angle: the angle is measured, not only the speed.
        spans_s: lengths of the regressions' windows, increasing (`rls`).
    """

    def __init__(
        self,
        plant: PlantModel,
        known: Mapping[str, float],
        biases: Sequence[str] = (),
        nominal: Mapping[str, float] | None = None,
        *,
        sees_angle: bool = True,
        spans_s: Sequence[float] = SPANS_S,
    ) -> None:
        self._plant, self._known, self._spans_s = plant, dict(known), tuple(spans_s)
        self._nominal = dict(nominal or {})
        self._taken_at = {p.name: p.nominal for p in plant.parameters} | self._nominal
        self._current_gain = self._taken_at.get("g_i", 1.0)
        self._lag = Lag(self._taken_at["t_lag"]) if "t_lag" in plant.parameter_names else None
        given_torque = plant.drive == "voltage" and bool(known)
        columns = ModelColumns.of(plant, biases, sees_current=not given_torque, sees_angle=sees_angle)
        self._columns, self._rows = columns, RowMaker(plant, columns, self._known, self._taken_at)
        self.window = BalanceWindow(columns.armature, columns.shaft, judges_mismatch=not given_torque)
        self._rls: dict[str, SlidingRls] = {}
        self._held = HeldShaft(columns.armature)
        self._pending: list[Stretch] = []
        self._noise_var: dict[str, float] = {}
        self._sampling: Sampling | None = None
        self._estimate: RegressionEstimate | None = None
        self._updates = self._waiting = self._unasked = 0
        self._sag = self._period_s = 0.0
        self._plausible = {which: Plausible() for which in SPAN_S}

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters these regressions can give, if the motion shows them."""
        both = self._plant.drive == "voltage" and not self._known
        return (*(self._columns.named.values() if both else ()), *self._columns.given)

    def update(
        self, new: Stretch, noise_var: Mapping[str, float], sampling: Sampling | None = None, ticks: int = 1
    ) -> bool:
        """Take the samples of one tick; windows reach back into earlier ones. Returns whether there is something new
        to ask for.

        Args:
            noise_var: of the measured channels, as far as it is known: what it adds to the regressors is taken out.
            sampling: noise and what else integrals over samples are off by, once a filter has found it: what the
                balances leave beyond it is no noise.
            ticks: how many it is, where it is not one.

        The first ticks are worked off at once (the filter waits to start), later ones `_BATCH` at a time.
        """
        self._updates += ticks
        self._waiting += ticks
        self._noise_var, self._sampling = dict(noise_var), sampling
        if self._current_gain != 1.0 and new.current is not None:
            new = replace(new, current=new.current / self._current_gain)
        if self._lag is not None and new.voltage is not None:
            new = replace(new, voltage=self._lag.mean_of(new.time_s, new.voltage))
        self._held.watch(new)
        self._pending.append(new)
        if self._updates > _EAGER_UPDATES and self._waiting < _BATCH:
            return False
        self._waiting = 0
        stretch = recorded = joined(self._pending)
        end_s = float(stretch.time_s[-1])
        self.window.advance(end_s)
        for rls in self._rls.values():
            rls.advance(end_s)
        if len(stretch.time_s) >= FEWEST_SAMPLES:
            self._period_s = period = upper_median(stretch.time_s[1:] - stretch.time_s[:-1])
            rest, self._sag = self._between_samples(period)
            stretch = between_samples(stretch, rest)
            if stretch.voltage is not None and stretch.current is not None:
                self._take("armature", self._rows.armature(stretch, period, noise_var.get("current_A", 0.0), self._sag))
            self._take("shaft", self._rows.shaft(stretch, period, self._sag))
            keep = max(FEWEST_SAMPLES, round(SPAN_S["shaft"] / period)) + 2
            recorded = last(recorded, keep)
        self._pending = [recorded]
        self._unasked = self._unasked + 1 if ticks > 1 else _ASKED_EVERY
        if self._unasked < _ASKED_EVERY:
            return False
        self._unasked = 0
        self._estimate = self._compute()
        return True

    def expect_change(self) -> None:
        """A parameter has stepped: rows that are far off what the regressions expect are no spoilt ones. (How much of
        the old motor they still hold the regressions see by themselves.) The balances begin anew, and are not asked
        before they hold a whole batch: of a tick or two they would say that the motion shows nothing."""
        self.window.clear()
        self._waiting = 0
        self._plausible = {which: Plausible() for which in SPAN_S}

    def follow_lag(self, lag_s: float) -> None:
        """Take over the drive's lag as the filter has found it, which no regression finds."""
        if self._lag is not None:
            self._lag.lag_s = lag_s

    def _between_samples(self, period_s: float) -> tuple[float, float]:
        """The current's mean between two samples is

            i_k + a (i_{k+1} − i_k) + (a − ½) h (K/R) dω/dt,   a = 1/(1 − exp(−x)) − 1/x,   x = h R/L,

        as it approaches the end of each held voltage with the time constant L/R while the speed goes on changing.

        The regressions themselves see little of L where the winding settles from one sample to the next: they cannot
        tell it from the share of the step, so that they would keep a wrong one that they began with.

        Returns:
            a − ½ (0 .. ½), and (a − ½) h K/R in A·s²/rad (of a held shaft 0). Where a window holds the fewest samples
            (below 600 Hz) with the nominal L, where one is given, while the regression does not know it, and in the
            beginning of the nominal winding without the second part; zeros in the beginning elsewhere.
        """
        if "L" not in self.names:
            return 0.0, 0.0
        found, few = self._estimate, coarse("armature", period_s) == 1.0
        if found is None and not few:
            return 0.0, 0.0
        own = {} if found is None else dict(zip(found.names, found.value.tolist(), strict=True))
        R, L, K = (own.get(name, self._taken_at[name]) for name in WINDING_NAMES)
        if found is None:
            K = 0.0
        if found is None or (few and "L" in self._nominal and not found.with_unseen.knows("L")):
            L = self._taken_at["L"]
        if R <= 0.0 or (L <= 0.0 and not few):
            return 0.0, 0.0
        rest = settling(R, L, period_s)[0] - 0.5
        return rest, rest * period_s * K / R

    @property
    def stands(self) -> bool:
        """Whether the shaft has not moved since the first sample."""
        return self._held.stands

    @property
    def winding(self) -> RegressionEstimate | None:
        """R and L of a motor whose shaft is held, where R is known; None: it is not, or R is not yet."""
        return self._held.estimate()

    @property
    def in_regression(self) -> tuple[str, ...]:
        """Parameters that some column of these regressions stands for, and that they can judge."""
        names = [n for n in self.names if n in self._columns.judged]
        return tuple(dict.fromkeys((*names, *(self._columns.offsets if "R" in names else ()))))

    def _take(self, which: str, rows: ModelRows | None) -> None:
        """Rows for a regression and for the window, without those that wrong samples have spoilt."""
        if rows is None:
            return
        columns = self._columns.armature if which == "armature" else self._columns.shaft
        rls = self._rls.setdefault(which, SlidingRls(len(columns), self._spans_s))
        time_s = float(rows.samples.time_s[-1])
        good = np.ones(len(rows.y), np.bool_)
        if rls.value is not None:
            good = self._plausible[which].rows(rows.y - rows.Phi @ rls.value, rows.y)
        if rows.creeping is not None:
            good = good & ~rows.creeping  # what holds a shaft is no sliding friction
        if good.any():
            sums = _sums_of(rows, good)
            noise = noise_squares(columns, sums.weight_squares, self._noise_var)
            rls.update(time_s, sums.gram, sums.rows, noise, self._expected(which, rls, sums))
            if which not in self._columns.open:
                self.window.add(which, time_s, sums)
                if rows.dry is not None:
                    self.window.hidden_friction.add(time_s, _sums_of(rows, good, rows.dry))
        if which == "armature":
            self._held.take(rows.samples, rows.Phi, rows.y)

    def _expected(self, which: str, rls: SlidingRls, sums: Sums) -> float | None:
        """The sum of squares that noise and sampling leave of new rows; None while it is not known."""
        if self._sampling is None or rls.value is None or not self.window.judges_mismatch:
            return None
        columns = (*(self._columns.armature if which == "armature" else self._columns.shaft), "y")
        return expected_square(which, columns, sums, rls.value, self._sampling, self.window.y_channel(which))

    def estimate(self) -> RegressionEstimate | None:
        """What the regressions say, in natural units; None before they can say anything. It changes slowly and is
        asked for often: computed anew with each of the first updates, later with every batch."""
        return self._estimate

    def _armature_estimate(self) -> LinearEstimate | None:
        """R, L, K and what else is named; a constant that two offsets share is neither's."""
        found = self._rls["armature"].estimate() if "armature" in self._rls else None
        if found is None:
            return None
        index = [self._columns.armature.index(c) for c in self._columns.named]
        value, covariance = found.value, found.covariance
        if index != list(range(len(value))):
            value, covariance = value[index], covariance[np.ix_(index, index)]
        names = tuple(self._columns.named.values())
        if "i0" in names:
            value, covariance = as_current(value, covariance, names.index("i0"))
        return replace(found, value=value, covariance=covariance)

    def _unseen(self, names: Sequence[str], value: F64) -> F64:
        """What the samples are too slow to show, 1 σ in natural units, shape (n,): the more of what values far off by
        just that and nominal ones say."""
        own = dict(zip(names, value.tolist(), strict=True))
        shares = [[sampled_std(n, v, self._period_s) for n in names] for v in (own, self._nominal)]
        return np.asarray(np.max(shares, axis=0) * np.abs(value))

    def _compute(self) -> RegressionEstimate | None:
        armature = self._armature_estimate()
        shaft = self._rls["shaft"].estimate() if "shaft" in self._rls else None
        if armature is None and (shaft is None or "armature" in self._rls):
            return self._held.estimate()  # without K the shaft's coefficients are quotients only
        blocks = [e for e in (armature, shaft) if e is not None]
        value = np.concatenate([e.value for e in blocks])
        covariance = side_by_side([e.covariance for e in blocks]) * OVERLAP
        own = tuple(self._columns.named.values()) if armature is not None else ()
        columns = [*own, *(self._columns.shaft if shaft is not None else [])]
        if armature is not None and shaft is not None:
            value, covariance = times_torque_constant(value, covariance, columns, len(own))
        elif self._plant.drive == "voltage" and self._known:
            value, covariance = without_lag(value, covariance, self._known["L"] / self._known["R"])
        if shaft is not None:
            value, covariance = as_parameters(columns, value, covariance)
        if self._columns.open and (shaft is not None or "armature" in self._columns.open):
            first = 0 if "armature" in self._columns.open else len(own)
            doubt = np.array([k >= first for k in range(len(value))]) * _OPEN_STD * value
            covariance = covariance + np.diag(doubt**2)
        span_s = max(e.span_s for e in blocks)
        names = (*own, *map(given_by, columns[len(own) :]))
        unseen = self._unseen(names, value) if self._plant.drive == "voltage" else None
        return RegressionEstimate(names, value, covariance, span_s, all(e.closes for e in blocks), unseen)


def _sums_of(rows: ModelRows, which: NDArray[np.bool_], further: F64 | None = None) -> Sums:
    """Of some of the rows, with one column more where there is one, shape (m,)."""
    Phi = rows.Phi if further is None else np.column_stack([rows.Phi, further])
    if which.all():
        return Sums.of(Phi, rows.y, rows.windows.weight_squares)
    return Sums.of(Phi[which], rows.y[which], rows.windows.only(which).weight_squares)
