"""Of each parameter: is it excited, may it move, is it known, and how far the balances let it be off."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.parameters import Parameter
from servo_daemon.regression import balances, closure
from servo_daemon.regression.estimate import KNOWS, RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import Sampling, blind_std, coarse, settles_between
from servo_daemon.samples import F64
from servo_daemon.tracking.noise import coarse_input
from servo_daemon.tracking.plan.roster import Mask, Roster
from servo_daemon.tracking.start.starter import NUISANCE_SHARE
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.fusion import LOST, QUALIFIED, Qualification, confirms
from servo_daemon.tracking.validity.last_known import LastKnown
from servo_daemon.tracking.validity.vouching import Vouching

#: An unexcited parameter's covariance grows with its drift up to this 1 σ.
_IDLE_STD = 0.3
#: A regression that may be off by as much (1 σ, relative) because of the sampling alone is no judge.
_BLIND = 0.1
#: Of a motor whose model lacks something nothing is known better, 1 σ of a logarithm: no balance over samples that
#: could contradict the filter is more exact.
_LACKING_STD = 0.01
#: What no balance over samples sees (a spring, a delay) is known no better than this, 1 σ of a logarithm: the filter
#: alone takes what its model is off by for information.
_ALONE_STD = 0.01
#: A parameter that is known no better than this, 1 σ of its logarithm, is a guess.
_GUESS_STD = 0.5
#: Errors of two parameters go together from this correlation on.
_ONE_LINE = 0.8
#: Parameters of the armature's balance, which has its own say.
_ARMATURE = ("R", "L", "K")
#: The lags of winding and drive are told apart by the speed alone, which acts behind the drive's: alike to this factor
#: one of them may be as much longer as the other is shorter (with 4.0 and 4.6 ms all of R .. B were up to 26 % off).
_ALIKE = 2.0
#: Parameters that the balances judge by name (`BalanceWindow.verdicts`).
_JUDGED = (*_ARMATURE, "J", "B", "Tc")
#: Parameters that are known worse than this would lead the instrument astray.
_LED_ASTRAY_STD = 0.25


@dataclass(frozen=True, slots=True)
class Tick:
    """What else there is to know after a tick.

    Attributes:
        settled: the filter has run for long enough for its noise levels to be no guesses, and its first samples have
            been gone over where it started from little.
        open: a jump is being looked for.
        explained: ticks that the noise does not explain are the exception.
        white: innovations are.
        inductance_std: 1 σ of ln L that the steps of the recorded voltage leave open; looked up when the regressions
            have been worked off.
        sampling: noise and what else integrals over samples are off by.
        end_s: device time.
    """

    settled: bool
    open: bool
    explained: bool
    white: bool
    inductance_std: float
    sampling: Sampling
    end_s: float


class ParameterJudge:
    """One drive's.

    Attributes:
        excitation, qualification: per parameter.
        confirmed: parameters for which the regression speaks, or which it cannot judge, shape (n,).
        begins_to_follow: the filter uses its instrument for the first time.
        mismatch_std: 1 σ of the coordinates by which they may be off because the balances do not close, shape (n,).
        last_known: each parameter as it was when it was last known.
        calm_s: for how long the filter's innovations have been as they should be.
    """

    def __init__(self, roster: Roster, ekf: Ekf, rls: MotorRls) -> None:
        self._roster, self._ekf, self._rls = roster, ekf, rls
        n = len(roster.parameters)
        self.excitation, self.qualification = Excitation(n), Qualification(n)
        self.mismatch_std: F64 = np.zeros(n)
        self._lags_alike = False
        self._vouching = Vouching()
        self._unjudged = False  # by the balances, since the first samples were gone over
        self._idle_std: F64 = np.where(roster.nuisance, NUISANCE_SHARE, _IDLE_STD)
        self.last_known = LastKnown(n)
        self.calm_s = 0.0
        self._trusted: Mask = np.zeros(n, dtype=bool)
        self._follows = self._followed = self.begins_to_follow = False
        self._moves: tuple[Mask, F64] = self._trusted, np.zeros(n)  # which may, and their process noise
        self.confirmed: Mask = ~roster.covered

    def begin(self, trusted: Mask, time_s: float) -> None:
        """A filter starts.

        Args:
            trusted: parameters from a saved state, or from another model's filter, where they were qualified; (n,).
            time_s: device time.
        """
        self.last_known.begin(trusted, time_s)
        self._unjudged = False
        self.calm_s = 0.0
        self._trusted = trusted
        self._vouching = Vouching()
        self._follows = self._followed = self.begins_to_follow = False
        self.confirmed = trusted | ~self._roster.covered

    def begin_anew(self, follows: bool) -> None:
        """The first samples have been gone over again: what was seen with the values of then is forgotten.

        Args:
            follows: along the instrument.
        """
        self._follows = self._followed = follows
        self._rls.window.pass_over()
        self._rls.window.forget_values()
        self._unjudged = True
        self.excitation.forget()
        self._ekf.use_instrument(follows)

    def vouch(self) -> None:
        """The filter's values are those of the greatest likelihood: no regression need speak for them."""
        self._vouching.done = True

    def reset(self) -> None:
        self.qualification.qualified[:] = False
        self.excitation.reset()

    def walk(self, walking: Mask) -> F64:
        """Process noise per coordinate, 1/s."""
        return np.asarray(walking * self._roster.drift_square * np.square(self.excitation.scales))

    def update(self, duration_s: float, fresh: bool, tick: Tick) -> None:
        """After each tick: which parameters may move, which are known.

        Args:
            fresh: the regressions have been worked off.
        """
        roster, values = self._roster, self._roster.values(self._ekf.coordinates) if fresh else {}
        self.calm_s = self.calm_s + duration_s if tick.white and tick.explained else 0.0
        if fresh:
            self._lags_alike = _are_alike(values)
            if "t_lag" in values and self._is_near_start("t_lag"):
                self._rls.follow_lag(values["t_lag"])
            self.excitation.determine(
                self._rls.window.determined(self._roster.names, values, tick.sampling), self._roster.covered
            )
        self.excitation.update(self._ekf.take_information(), duration_s)
        excited, own_std = self.excitation.excited, self._ekf.coordinate_std
        std = own_std / self.excitation.scales
        if fresh:
            self.confirmed = self._confirmed_by_regression(values, tick)
            if tick.open:
                self._rls.window.pass_over()
            else:
                self._measure_mismatch(values, tick)
                self._unjudged = False
        if fresh and not tick.white and "L" in roster.names and self._is_blind("L", values, tick):
            # What happens between two samples is seen by the filter's model alone, and that lacks something.
            self.qualification.qualified[roster.names.index("L")] = False
        if fresh and not tick.explained:
            # The model lacks something: what the filter makes of it is worth nothing without a second opinion.
            self.qualification.qualified &= self.confirmed
        settled = tick.settled or bool(self._trusted.all())
        confirmed = self.confirmed if settled and not self._unjudged else np.zeros_like(self.confirmed)
        whole_std = np.hypot(std, self.mismatch_std)
        self.qualification.update(whole_std, excited, confirmed)
        self.qualification.qualified &= self._claimable(tick)
        self._no_R_without_K()
        self._no_L_without_R(tick.sampling.period_s)
        walk = self.walk(roster.free)
        self._remember(whole_std, own_std, walk * duration_s, tick, duration_s)
        shown = roster.published & excited
        seen = roster.free_without_instrument(self._ekf.coordinates, tick.sampling.period_s)
        self._follow(settled, shown & seen, std)
        self._moves = self._moving(seen, tick), walk * (shown | (std < self._idle_std))
        self.resume()

    def resume(self) -> None:
        """The filter is to go on as after the last tick."""
        self._ekf.set_active(*self._moves)
        self._ekf.use_instrument(self._follows)

    def _follow(self, settled: bool, needed: Mask, std: F64) -> None:
        """Whether derivatives are taken along the instrument from now on: where all that is needed is known."""
        limit = _LED_ASTRAY_STD if self._follows else QUALIFIED
        follows = settled and not np.count_nonzero(needed & ~(std < limit))
        self.begins_to_follow = follows and not self._follows and not self._followed
        self._followed |= follows
        self._follows = follows

    def _claimable(self, tick: Tick) -> Mask:
        """What may be believed at all: where the model lacks something no second opinion is to be had of what no
        regression judges."""
        roster = self._roster
        if self._lags_alike:
            return ~roster.published
        return roster.claimable if tick.white else roster.claimable & (roster.covered | ~roster.published)

    def _no_R_without_K(self) -> None:
        """Where R and K lie on one line the one is as wrong as the other."""
        names, qualified = self._roster.names, self.qualification.qualified
        if "R" in names and "K" in names:
            R, K = names.index("R"), names.index("K")
            qualified[R] &= qualified[K] or abs(self._ekf.correlation(R, K)) < _ONE_LINE

    def _no_L_without_R(self, period_s: float) -> None:
        """Over few samples a current shows L/R: with a wrong R the filter is sure of a wrong L."""
        names, qualified = self._roster.names, self.qualification.qualified
        if coarse("armature", period_s) == 1.0 and "R" in names and "L" in names:
            qualified[names.index("L")] &= qualified[names.index("R")]

    def stepped(self, k: int) -> None:
        """Parameter k is another one: what it was when it was last known it is no more."""
        self.last_known.stepped(k, float(self._ekf.coordinates[k]), float(self._ekf.coordinate_std[k]))

    def _remember(self, relative_std: F64, own_std: F64, drift_var: F64, tick: Tick, duration_s: float) -> None:
        """What is known well enough to qualify.

        Args:
            relative_std: over the scales, shape (n,).
            own_std: the filter's, of the coordinates, shape (n,).
            drift_var: what the tick adds to the coordinates' variances, shape (n,).
        """
        known = self.qualification.qualified & (not tick.open)
        var = np.square(relative_std * self.excitation.scales)
        self.last_known.remember(
            known & (relative_std < QUALIFIED), self._ekf.coordinates, var, np.square(own_std), drift_var
        )
        excited = self.excitation.excited
        self.last_known.count(known & excited, excited, tick.end_s, duration_s)

    def _moving(self, seen: Mask, tick: Tick) -> Mask:
        """Which parameters are not held.

        Args:
            seen: what may be estimated without the instrument.
        """
        roster = self._roster
        free = roster.free if self._follows else seen
        if tick.open:
            return free
        # What no regression can judge is free until it has been seen once: there is nothing to hold yet.
        known = self.qualification.qualified | roster.covered
        moving: Mask = free & ~self.excitation.held(known)
        return moving

    def _measure_mismatch(self, values: Mapping[str, float], tick: Tick) -> None:
        """How far the parameters may be off because the balances do not close, or by the balances' word; kept while a
        parameter is not excited."""
        window, std = self._rls.window, self._ekf.coordinate_std
        window.confront(values, tick.sampling.noise_var)
        found, said = window.mismatch(values, tick.sampling), window.verdicts(values, tick.sampling.period_s)
        coarse, armature = self._left_by_steps(tick), self._by_armature(values, tick)
        for k, name in enumerate(self._roster.names):
            if not self.excitation.excited[k] or not self._roster.logarithmic[k]:
                continue
            error, var = said.get(name, (0.0, 0.0))
            if self._is_blind(name, values, tick):
                error = 0.0
            doubt = closure.doubt_var(error, var + float(std[k]) ** 2) + armature.get(name, 0.0)
            lacking = 0.0 if tick.white else _LACKING_STD
            self.mismatch_std[k] = math.hypot(found.get(name, 0.0), math.sqrt(doubt), float(coarse[k]), lacking)
        self._doubt_effects()
        self._carry_over_torque()

    def _doubt_effects(self) -> None:
        """An effect's parameters have no balance's word against them: they are as uncertain as a balance that is only
        nearly right leaves them."""
        roster, systematic = self._roster, self.excitation.systematic_std
        for k, p in enumerate(roster.parameters):
            judged = p.name in _JUDGED and roster.covered[k]
            if judged or not self.excitation.excited[k] or not (roster.published[k] and _is_relative(p)):
                continue
            own = float(self.mismatch_std[k]) if roster.logarithmic[k] else 0.0
            self.mismatch_std[k] = math.hypot(own, float(systematic[k]) if roster.covered[k] else _ALONE_STD)

    def _by_armature(self, values: Mapping[str, float], tick: Tick) -> dict[str, float]:
        """Variance of the logarithms that the armature's regression leaves where the filter alone is not believed;
        where it is, the regression, which remembers for longer, may be behind a motor that ages.

        - The innovations say that the model lacks something: a torque that is in no model bends the filter, and not
          that balance. By how much they differ, and no better than the regression knows.
        - L was never known: the filter holds it at a value that bends R, the regression has one of its own. (Less so
          where the current has settled by the next sample.)
        """
        L_unknown = "L" in values and self._is_unknown("L", _GUESS_STD if self._is_blind("L", values, tick) else LOST)
        found = None if tick.white and not L_unknown else self._rls.estimate()
        if found is None:
            return {}
        out: dict[str, float] = {}
        for name in ("R", "K"):
            if name not in found.names or name not in values:
                continue
            at, k = found.names.index(name), self._roster.names.index(name)
            value, spread = float(found.value[at]), float(found.std[at])
            if value > 0.0 and spread < KNOWS * value:
                error, own_var = math.log(values[name] / value), (spread / value) ** 2
                blind = blind_std(name, values, tick.sampling.period_s)
                var = own_var + blind**2 + float(self._ekf.coordinate_std[k]) ** 2
                out[name] = own_var + (error**2 if L_unknown else closure.doubt_var(error, var))
        return out

    def _is_near_start(self, name: str) -> bool:
        """Whether the filter knows a parameter better than a guess."""
        return float(self._ekf.coordinate_std[self._roster.names.index(name)]) < LOST

    def _is_unknown(self, name: str, std: float) -> bool:
        """Whether a parameter never qualified, and the filter knows it no better than to this 1 σ of its logarithm."""
        if name not in self._roster.names:
            return False
        k = self._roster.names.index(name)
        return self.last_known.was_never(k) and float(self._ekf.coordinate_std[k]) > std

    def _carry_over_torque(self) -> None:
        """The shaft's balance sees J, B and friction only beside K i: what the armature's leaves open of K, it leaves
        open of them."""
        names = self._roster.names
        if "K" not in names or self.mismatch_std[names.index("K")] == 0.0:
            return
        at = names.index("K")
        carried = coarse_input.along(self._ekf.estimate().covariance, at, float(self.mismatch_std[at]))
        for k, name in enumerate(names):
            if name not in _ARMATURE and self.excitation.excited[k] and self._roster.logarithmic[k]:
                self.mismatch_std[k] = math.hypot(float(self.mismatch_std[k]), float(carried[k]))

    def _left_by_steps(self, tick: Tick) -> F64:
        """What the voltage's steps leave open of each coordinate, 1 σ, shape (n,)."""
        if tick.inductance_std == 0.0 or "L" not in self._roster.names:
            return np.zeros(len(self._roster.parameters))
        covariance = self._ekf.estimate().covariance
        return coarse_input.along(covariance, self._roster.names.index("L"), tick.inductance_std)

    @staticmethod
    def _is_blind(name: str, values: Mapping[str, float], tick: Tick) -> bool:
        """See `settles_between`."""
        return name == "L" and settles_between(values["R"], values["L"], tick.sampling.period_s)

    def _confirmed_by_regression(self, values: Mapping[str, float], tick: Tick) -> Mask:
        """Parameters whose value the regression confirms, or cannot judge at all because it is in none."""
        out: Mask = self._trusted | ~self._roster.covered
        found = self._rls.estimate()
        if found is None:
            return out
        for name, value, std in zip(found.names, found.value.tolist(), found.std.tolist(), strict=True):
            k = self._roster.names.index(name)
            if self._trusted[k] or not self._roster.covered[k]:
                continue
            blind = blind_std(name, values, tick.sampling.period_s)
            if self._roster.logarithmic[k] and not self._is_blind(name, values, tick) and blind < _BLIND:
                spread = math.hypot(std * balances.ALIGNED.get(name, 1.0), blind * value)
                out[k] = confirms(value, spread, values[name]) or self.calm_s > found.span_s
            else:
                out[k] = name != "L" or tick.white
        for name in self._doubtful(found, values, tick):
            k = self._roster.names.index(name)
            out[k] = bool(self._trusted[k])
        return out

    def _doubtful(self, found: RegressionEstimate, values: Mapping[str, float], tick: Tick) -> Collection[str]:
        """Parameters that the regressions must vouch for first; see `Vouching`."""
        if not tick.settled or self._vouching.done:
            return ()
        std = dict(zip(self._roster.names, self._ekf.coordinate_std.tolist(), strict=True))
        blind = {name: blind_std(name, values, tick.sampling.period_s) for name in found.names}
        return self._vouching.doubtful(found, values, std, blind)


def _is_relative(p: Parameter) -> bool:
    """Whether one unit of the coordinate is one whatever the motor: a logarithm, an angle."""
    return p.transform == "log" or p.unit == "rad"


def _are_alike(values: Mapping[str, float]) -> bool:
    """Whether the lags of drive and winding cannot be told apart; see `_ALIKE`."""
    if "t_lag" not in values or "L" not in values:
        return False
    return 1.0 / _ALIKE < values["t_lag"] * values["R"] / values["L"] < _ALIKE
