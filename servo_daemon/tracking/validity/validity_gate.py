"""The validity gate of each parameter: is it excited, may it move, is it known, and how far the balances let it be
off."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import coarse
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.start.starter import BIAS_SHARE
from servo_daemon.tracking.validity.confirmation import Confirmation
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.gates import LOST, QUALIFIED, Evidence, Qualification
from servo_daemon.tracking.validity.last_known import LastKnown
from servo_daemon.tracking.validity.mismatch import Mismatch
from servo_daemon.tracking.validity.tick import Tick

#: An unexcited parameter's covariance grows with its drift up to this 1 σ (free within a half and twice:
#: tests/recovery/constants.py).
_IDLE_STD = 0.3
#: The lags of winding and drive are identifiable by the speed alone, which acts behind the drive's: alike to this
#: factor one of them may be as much longer as the other is shorter (with 4.0 and 4.6 ms all of R .. B were up to 26 %
#: off).
_ALIKE = 2.0
#: Parameters that are known worse than this would let the instrumental trajectory diverge (chosen; half and twice move
#: no tracking figure).
_LED_ASTRAY_STD = 0.25


class ValidityGate:
    """Decides after each tick which parameters of one filter may move and which may be published.

    Attributes:
        excitation, qualification: per parameter.
        confirmation: for which the regressions speak.
        mismatch: by how much they may be off because the balances do not close.
        begins_to_follow: the filter uses its instrumental trajectory for the first time.
        last_known: each parameter as it was when it was last known.
        calm_s: for how long the filter's innovations have been as they should be.
    """

    def __init__(self, masks: ParameterMasks, ekf: Ekf, rls: MotorRls) -> None:
        self._masks, self._ekf, self._rls = masks, ekf, rls
        n = len(masks.parameters)
        self.excitation, self.qualification = Excitation(n), Qualification(n)
        self._lags_alike = False
        self._unjudged = False  # by the balances, since the first samples were re-linearised
        self._idle_std: F64 = np.where(masks.biases, BIAS_SHARE, _IDLE_STD)
        self.last_known = LastKnown(n)
        self.mismatch = Mismatch(masks, ekf, rls, self.excitation, self.last_known)
        self.calm_s = 0.0
        self._trusted: Mask = np.zeros(n, dtype=bool)
        self.confirmation = Confirmation(masks, ekf, rls, self._trusted)
        self._follows = self._followed = self.begins_to_follow = False
        self._moves: tuple[Mask, F64] = self._trusted, np.zeros(n)  # which may, and their process noise

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
        self.confirmation = Confirmation(self._masks, self._ekf, self._rls, trusted)
        self._follows = self._followed = self.begins_to_follow = False

    def begin_anew(self, follows: bool) -> None:
        """The first samples have been re-linearised: what was seen with the values of then is forgotten.

        Args:
            follows: along the instrumental trajectory.
        """
        self._follows = self._followed = follows
        self._rls.window.pass_over()
        self._rls.window.forget_values()
        self._unjudged = True
        self.excitation.forget()
        self._ekf.use_instrumental_trajectory(follows)

    def doubt(self, std: F64) -> None:
        """Widen what is positive and published to this 1 σ of the coordinates (n,), until the balances judge it."""
        at = self._masks.published & self._masks.logarithmic
        self.mismatch.std = np.where(at, std, self.mismatch.std)

    def waive_cross_check(self) -> None:
        """The filter's values are those of the greatest likelihood: no regression need speak for them."""
        self.confirmation.cross_check.done = True

    def reset(self) -> None:
        self.qualification.qualified[:] = False
        self.excitation.reset()

    def walk(self, walking: Mask) -> F64:
        """Process noise per coordinate, 1/s."""
        return np.asarray(walking * self._masks.drift_square * np.square(self.excitation.scales))

    def update(self, duration_s: float, fresh: bool, tick: Tick) -> None:
        """After each tick: which parameters may move, which are known.

        Args:
            fresh: the regressions have been worked off.
        """
        masks, values = self._masks, self._masks.values(self._ekf.coordinates) if fresh else {}
        self.calm_s = self.calm_s + duration_s if tick.white and tick.explained else 0.0
        if fresh:
            self._lags_alike = _are_alike(values)
            if "t_lag" in values and self._ekf.coordinate_std[masks.names.index("t_lag")] < LOST:
                self._rls.follow_lag(values["t_lag"])
            self.excitation.determine(
                self._rls.window.determined(self._masks.names, values, tick.sampling), self._masks.covered
            )
        self.excitation.update(self._ekf.take_information(), duration_s)
        excited, own_std = self.excitation.excited, self._ekf.coordinate_std
        std = own_std / self.excitation.scales
        if fresh:
            self.confirmation.update(values, tick, self.calm_s)
            if tick.open:
                self._rls.window.pass_over()
            else:
                self.mismatch.measure(values, tick)
                self._unjudged = False
        settled = tick.settled or bool(self._trusted.all())
        whole_std = np.hypot(std, self.mismatch.std)
        evidence = Evidence(
            masks=masks,
            relative_std=whole_std,
            excited=excited,
            confirmed=self.confirmation.parameters,
            settled=settled and not self._unjudged,
            fresh=fresh,
            white=tick.white,
            explained=tick.explained,
            settles="L" in values and tick.is_blind("L", values),
            few_samples=coarse("armature", tick.sampling.period_s) == 1.0,
            lags_alike=self._lags_alike,
            correlation=self._ekf.correlation,
        )
        self.qualification.update(evidence)
        walk = self.walk(masks.free)
        self._remember(whole_std, own_std, walk * duration_s, tick, duration_s)
        shown = masks.published & excited
        seen = masks.free_along_own_states(self._ekf.coordinates, tick.sampling.period_s)
        self._follow(settled, shown & seen, std)
        self._moves = self._moving(seen, tick), walk * (shown | (std < self._idle_std))
        self.resume()

    def resume(self) -> None:
        """Let the filter go on as after the last tick."""
        self._ekf.set_active(*self._moves)
        self._ekf.use_instrumental_trajectory(self._follows)

    def _follow(self, settled: bool, needed: Mask, std: F64) -> None:
        """Whether derivatives are taken along the instrumental trajectory from now on: where all that is needed is
        known."""
        limit = _LED_ASTRAY_STD if self._follows else QUALIFIED
        follows = settled and not np.count_nonzero(needed & ~(std < limit))
        self.begins_to_follow = follows and not self._follows and not self._followed
        self._followed |= follows
        self._follows = follows

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
            seen: what may be estimated without the instrumental trajectory.
        """
        masks = self._masks
        free = masks.free if self._follows else seen
        if tick.open:
            return free
        # What no regression can judge is free until it has been seen once: there is nothing to hold yet.
        known = self.qualification.qualified | masks.covered
        moving: Mask = free & ~self.excitation.held(known)
        return moving


def _are_alike(values: Mapping[str, float]) -> bool:
    """Whether the lags of drive and winding are not identifiable apart from each other; see `_ALIKE`."""
    if "t_lag" not in values or "L" not in values:
        return False
    return 1.0 / _ALIKE < values["t_lag"] * values["R"] / values["L"] < _ALIKE
