"""Champion–challenger test of a learned model against the filter, and which of the filter's values the balances refute.

An estimate of one window must close the balances of the *next* one, which it has not seen, as well as the filter's
values of the same moment do. Each balance refutes what is in it: with friction that the filter lacks the shaft's
balance does not close with its J and B, while the armature's says that R, L and K are right. The shaft's holds J/K and
B/K only: where K is refuted, so are they. And a filter is held to what it believes by now, too: one that was wrong a
window ago and has found out is not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servo_daemon.learning.features.balance_features import residual_shares
from servo_daemon.learning.features.window import Window

#: Windows in a row that must be won to be trusted, and lost to be so no longer (chosen; not tried).
_TO_PROVE, _TO_LOSE = 2, 2
#: Won: the model leaves at most this many times what the filter leaves of both balances, or at most this share of them
#: (chosen; not tried).
_WON, _CLOSED = 1.05, 0.02
#: The filter is wrong where it leaves this many times as much of a balance as the model, and more than this share
#: (chosen; not tried).
_FILTER_WRONG, _NOTICEABLE = 2.0, 0.005
#: What the balances of the armature and of the shaft refute.
_REFUTED = (frozenset({"R", "L", "K", "J", "B", "Tc"}), frozenset({"J", "B", "Tc"}))

#: What is left of the armature's and of the shaft's balance.
Left = tuple[float, float]
Values = Mapping[str, float]


class ChampionChallengerTest:
    """Compares both on one window after the other.

    Attributes:
        trusted: the model has proven itself.
        refuted: parameters whose value in the filter the last window refutes.
    """

    def __init__(self) -> None:
        self.trusted = False
        self.refuted: frozenset[str] = frozenset()
        self._won = self._lost = 0
        self._before: tuple[Values, Values | None] | None = None

    def believe(self, model: Values, filtered: Values | None) -> None:
        """What both say at the end of a window, R, L, K, J, B in SI units, to be judged by the next."""
        self._before = model, filtered

    def forget(self) -> None:
        """The next window is of another device, or of other signals."""
        self._before, self.refuted = None, frozenset()

    def judge(self, window: Window, present: Values | None) -> None:
        """Hold both beliefs of the window before against this one.

        Args:
            present: the filter's values by now; None: it has none.
        """
        before, self.refuted = self._before, frozenset()
        if before is None or before[1] is None:
            return
        ours, theirs = residual_shares(window, before[0]), residual_shares(window, before[1])
        if ours is not None and theirs is not None and self._count(ours, theirs) and present is not None:
            self.refuted = _refuted(ours, theirs, residual_shares(window, present))

    def _count(self, ours: Left, theirs: Left) -> bool:
        """Whether the model has won this time."""
        # Together: with all parameters wrong by one factor the shaft's balance closes, the armature's does not.
        won = float(np.hypot(*ours)) <= max(_WON * float(np.hypot(*theirs)), _CLOSED)
        self._won, self._lost = (self._won + 1, 0) if won else (0, self._lost + 1)
        if self._won >= _TO_PROVE:
            self.trusted = True
        if self._lost >= _TO_LOSE:
            self.trusted = False
        return won


def _refuted(ours: Left, theirs: Left, by_now: Left | None) -> frozenset[str]:
    """By the balances that neither the filter's values of then nor those of now close."""
    if by_now is None:
        return frozenset()
    wrong = (
        names
        for names, own, *of_filter in zip(_REFUTED, ours, theirs, by_now, strict=True)
        if min(of_filter) > max(_FILTER_WRONG * own, _NOTICEABLE)
    )
    return frozenset().union(*wrong)
