"""Which of the filter's values the regressions confirm, which have no start that could have misled them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.regression import balances
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import blind_std
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.validity.cross_check import RegressionCrossCheck
from servo_daemon.tracking.validity.fusion import agrees, confirms
from servo_daemon.tracking.validity.tick import Tick

#: A regression that may be off by as much (1 σ, relative) because of the sampling alone is no judge (chosen; half and
#: twice move no tracking figure).
_BLIND = 0.1


class Confirmation:
    """Compares one filter's values with the regressions', from its start on.

    Args:
        trusted: parameters for which nothing else need speak, shape (n,).

    Attributes:
        parameters: those for which a regression speaks, or which it cannot judge because they are in none, shape (n,).
    """

    def __init__(self, masks: ParameterMasks, ekf: Ekf, rls: MotorRls, trusted: Mask) -> None:
        self._masks, self._ekf, self._rls, self._trusted = masks, ekf, rls, trusted
        self.cross_check = RegressionCrossCheck()
        self.parameters: Mask = trusted | ~masks.covered

    def update(self, values: Mapping[str, float], tick: Tick, calm_s: float) -> None:
        """Compare with what the regressions say by now.

        Args:
            calm_s: for how long the filter's innovations have been as they should be.
        """
        out: Mask = self._trusted | ~self._masks.covered
        found = self._rls.estimate()
        if found is None:
            self.parameters = out
            return
        own = {**values, **dict(zip(found.names, found.value.tolist(), strict=True))}
        for name, value, std in zip(found.names, found.value.tolist(), found.std.tolist(), strict=True):
            k = self._masks.names.index(name)
            if self._trusted[k] or not self._masks.covered[k]:
                continue
            blind = blind_std(name, values, tick.sampling.period_s)
            positive = bool(self._masks.logarithmic[k])
            if positive and not tick.is_blind(name, values) and blind < _BLIND:
                spread = math.hypot(std * balances.ALIGNED.get(name, 1.0), blind * value)
                out[k] = confirms(value, spread, values[name]) or calm_s > found.span_s
            else:
                # A wrong value is no reason to be blind to it.
                least = math.hypot(std, value * min(blind, blind_std(name, own, tick.sampling.period_s)))
                known = not positive or agrees(value, least, values[name]) or calm_s > found.span_s
                out[k] = known if name != "L" else tick.white
        for name in self._unconfirmed(found, values, tick):
            k = self._masks.names.index(name)
            out[k] = bool(self._trusted[k])
        self.parameters = out

    def _unconfirmed(self, found: RegressionEstimate, values: Mapping[str, float], tick: Tick) -> Collection[str]:
        """Parameters that have yet to pass the `RegressionCrossCheck`."""
        if not tick.settled or self.cross_check.done:
            return ()
        std = dict(zip(self._masks.names, self._ekf.coordinate_std.tolist(), strict=True))
        blind = {name: blind_std(name, values, tick.sampling.period_s) for name in found.names}
        return self.cross_check.unconfirmed(found, values, std, blind)
