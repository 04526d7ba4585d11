"""For which of the filter's values the regressions speak, which have no start that could have led them astray."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.regression import balances
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import blind_std
from servo_daemon.tracking.plan.roster import Mask, Roster
from servo_daemon.tracking.validity.fusion import confirms
from servo_daemon.tracking.validity.tick import Tick
from servo_daemon.tracking.validity.vouching import Vouching

#: A regression that may be off by as much (1 σ, relative) because of the sampling alone is no judge.
_BLIND = 0.1


class Confirmation:
    """One filter's, from its start on.

    Args:
        trusted: parameters for which nothing else need speak, shape (n,).

    Attributes:
        parameters: those for which a regression speaks, or which it cannot judge because they are in none, shape (n,).
    """

    def __init__(self, roster: Roster, ekf: Ekf, rls: MotorRls, trusted: Mask) -> None:
        self._roster, self._ekf, self._rls, self._trusted = roster, ekf, rls, trusted
        self.vouching = Vouching()
        self.parameters: Mask = trusted | ~roster.covered

    def update(self, values: Mapping[str, float], tick: Tick, calm_s: float) -> None:
        """With what the regressions say by now.

        Args:
            calm_s: for how long the filter's innovations have been as they should be.
        """
        out: Mask = self._trusted | ~self._roster.covered
        found = self._rls.estimate()
        if found is None:
            self.parameters = out
            return
        for name, value, std in zip(found.names, found.value.tolist(), found.std.tolist(), strict=True):
            k = self._roster.names.index(name)
            if self._trusted[k] or not self._roster.covered[k]:
                continue
            blind = blind_std(name, values, tick.sampling.period_s)
            if self._roster.logarithmic[k] and not tick.is_blind(name, values) and blind < _BLIND:
                spread = math.hypot(std * balances.ALIGNED.get(name, 1.0), blind * value)
                out[k] = confirms(value, spread, values[name]) or calm_s > found.span_s
            else:
                out[k] = name != "L" or tick.white
        for name in self._doubtful(found, values, tick):
            k = self._roster.names.index(name)
            out[k] = bool(self._trusted[k])
        self.parameters = out

    def _doubtful(self, found: RegressionEstimate, values: Mapping[str, float], tick: Tick) -> Collection[str]:
        """Parameters that the regressions must vouch for first; see `Vouching`."""
        if not tick.settled or self.vouching.done:
            return ()
        std = dict(zip(self._roster.names, self._ekf.coordinate_std.tolist(), strict=True))
        blind = {name: blind_std(name, values, tick.sampling.period_s) for name in found.names}
        return self.vouching.doubtful(found, values, std, blind)
