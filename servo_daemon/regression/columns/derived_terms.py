"""How an effect that has no columns of its own in `terms.py` enters the regressions: by what its terms are linear in.

A balance is closed where what the effect adds to it is linear in all that is free of it, and in nothing else that the
regressions look for. One that is open is begun from, at the start values of what is not linear, and judges nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.contribution import SENSORS, contribution
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64

#: The balances as the regressions call them, and what is added to them.
ADDED_TO = {"armature": "voltage", "shaft": "torque"}


@dataclass(frozen=True, slots=True)
class DerivedTerms:
    """The columns of one effect in both balances.

    Attributes:
        columns: parameters that are the coefficients of columns, by balance.
        open: balances that do not close with these columns.
        by_current_direction: whether what it adds follows that.
    """

    effect: str
    columns: Mapping[str, tuple[str, ...]]
    open: frozenset[str]
    by_current_direction: bool

    def signals(self, which: str, s: Stretch, value: Mapping[str, float]) -> list[F64]:
        """What the columns are the modulated integrals of, N·m or V per unit, shapes (n,).

        Args:
            which: "armature" or "shaft".
            value: where what is not linear is taken, natural units.
        """
        if not self.columns[which]:
            return []
        current = np.zeros_like(s.time_s) if s.current is None else s.current
        motion: dict[str, F64] = {
            "t": s.time_s,
            "i": current,
            "omega": s.speed,
            "h": np.full_like(s.time_s, np.median(np.diff(s.time_s))),
            "sliding": s.sliding,
            "flowing": np.sign(current),
        }
        motion |= {n: x for n, x in (("v", s.voltage), ("theta", s.position), ("torque", s.torque)) if x is not None}
        c = contribution(self.effect)
        added = c.along(motion, value)[ADDED_TO[which]]
        at = [p.name for p in c.linear]
        return [added[:, 1 + at.index(name)] for name in self.columns[which]]


@cache
def derived_terms(effect: str) -> DerivedTerms:
    """Columns of an effect of the library, derived from its terms."""
    c = contribution(effect)
    s, own = c.signals, {p.name for p in c.effect.parameters}
    looked_for = ca.vertcat(s.torque, *(s.p[name] for name in {*MOTOR_NAMES, "Tc"} - own))
    direct = c.is_along_motion and not c.effect.states
    columns: dict[str, tuple[str, ...]] = {}
    for which, balance in ADDED_TO.items():
        slopes = {p.name: ca.gradient(c.adds[balance], s.p[p.name]) for p in c.linear if direct}
        usable = (n for n, slope in slopes.items() if not slope.is_zero() and not ca.depends_on(slope, looked_for))
        columns[which] = tuple(usable)
    # The torque constant comes from the armature's balance: where that is open, the shaft's is, too.
    open_ = {which for which in ADDED_TO if not _closes(effect, which, columns)}
    open_ |= {"shaft"} if "armature" in open_ else set()
    return DerivedTerms(
        effect=effect,
        columns=columns,
        open=frozenset(open_),
        by_current_direction=c.follows(c.direction[1]),
    )


def _closes(effect: str, which: str, columns: Mapping[str, tuple[str, ...]]) -> bool:
    c, balance = contribution(effect), ADDED_TO[which]
    if c.terms.shaft is not None and c.terms.lag_s is None and c.terms.delay is None:
        return which == "armature"  # a torque of a spring that no sensor shows
    if not c.is_along_motion or c.effect.states or any(map(c.touches, SENSORS)):
        return False
    if not c.touches(balance):
        return True
    free = {p.name for p in c.effect.parameters if p.held == "no"}
    elsewhere = set(columns[next(other for other in ADDED_TO if other != which)])
    in_this = {n for n in free if ca.depends_on(c.adds[balance], c.signals.p[n])}
    return bool(columns[which]) and in_this <= set(columns[which]) - elsewhere
