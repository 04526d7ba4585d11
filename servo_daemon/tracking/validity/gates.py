"""What keeps a parameter from being published: gates, each of which stops some parameters for a reason.

A parameter qualifies once no gate of `ENTRY` stops it, and stays so until one of `LAPSES` or `STAYS` does: what is
known a little worse than it had to be at first is known all the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks

#: A parameter qualifies below this (1 σ, relative) and loses its qualification above the second: hysteresis (see `make
#: calibrate`).
QUALIFIED, LOST = 0.05, 0.15
#: Errors of two parameters go together from this correlation on (chosen; half and twice move no tracking figure).
_ONE_LINE = 0.8


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the gates decide on after a tick.

    Attributes:
        relative_std: 1 σ over the scales, what the balances leave open included, shape (n,).
        excited: shown by the motion, shape (n,).
        confirmed: a regression speaks for it, or cannot judge it, shape (n,).
        settled: the filter has run for long enough to be believed, and the balances have judged it.
        fresh: the regressions have been worked off.
        white, explained: the innovations are, and ticks that the noise does not explain are the exception.
        settles: the winding does between two samples.
        few_samples: a winding's time constant has so few that its current shows L/R alone.
        lags_alike: those of drive and winding are not identifiable apart from each other.
        correlation: of the filter's errors of two parameters, by index.
    """

    masks: ParameterMasks
    relative_std: F64
    excited: Mask
    confirmed: Mask
    settled: bool = True
    fresh: bool = True
    white: bool = True
    explained: bool = True
    settles: bool = False
    few_samples: bool = False
    lags_alike: bool = False
    correlation: Callable[[int, int], float] = lambda _, __: 0.0


@dataclass(frozen=True, slots=True)
class Gate:
    """A named condition on which a parameter is not published.

    Attributes:
        reason: in words.
        stops: which parameters, shape (n,), of those that are qualified so far.
    """

    reason: str
    stops: Callable[[Evidence, Mask], Mask]


def _only(e: Evidence, name: str, stopped: bool) -> Mask:
    return np.array([stopped and name == n for n in e.masks.names])


def blind_to_inductance(e: Evidence, _: Mask) -> Mask:
    """What happens between two samples is seen by the filter's model alone, and that lacks something."""
    return _only(e, "L", e.fresh and not e.white and e.settles)


def unexplained(e: Evidence, _: Mask) -> Mask:
    """The model lacks something: what the filter makes of it is worth nothing without a second opinion."""
    return ~e.confirmed & (e.fresh and not e.explained)


def unexcited(e: Evidence, _: Mask) -> Mask:
    return ~e.excited


def unconfirmed(e: Evidence, _: Mask) -> Mask:
    return ~(e.confirmed & e.settled)


def vague(e: Evidence, _: Mask) -> Mask:
    return ~(e.relative_std < QUALIFIED)


def lost(e: Evidence, _: Mask) -> Mask:
    return ~(e.relative_std < LOST)


def unclaimable(e: Evidence, _: Mask) -> Mask:
    return ~e.masks.claimable


def without_second_opinion(e: Evidence, _: Mask) -> Mask:
    """Where the model lacks something none is to be had of what no regression judges."""
    return e.masks.published & ~e.masks.covered & (not e.white)


def between_two_lags(e: Evidence, _: Mask) -> Mask:
    return e.masks.published & e.lags_alike


def resistance_without_torque_constant(e: Evidence, qualified: Mask) -> Mask:
    """Where R and K lie on one line the one is as wrong as the other."""
    names = e.masks.names
    if "R" not in names or "K" not in names:
        return np.zeros_like(qualified)
    R, K = names.index("R"), names.index("K")
    return _only(e, "R", not qualified[K] and not abs(e.correlation(R, K)) < _ONE_LINE)


def inductance_without_resistance(e: Evidence, qualified: Mask) -> Mask:
    """Over few samples a current shows L/R: with a wrong R the filter is sure of a wrong L."""
    names = e.masks.names
    return _only(e, "L", e.few_samples and "R" in names and not qualified[names.index("R")])


#: What is said where the filter alone is sure (`fusion.fuse`): balances or regressions leave more open.
UNCONFIRMED = "the filter is sure of a value, which nothing confirms yet"
#: What takes the hysteresis away: the parameter has to qualify anew.
LAPSES = (
    Gate("the model lacks something, maybe what happens between two samples", blind_to_inductance),
    Gate("the model lacks something, and no regression confirms the filter", unexplained),
)
#: What keeps a parameter from qualifying.
ENTRY = (
    Gate("the motion does not show it", unexcited),
    Gate(UNCONFIRMED, unconfirmed),
    Gate(UNCONFIRMED, vague),
)
#: What ends a qualification, and allows none.
STAYS = (
    Gate(UNCONFIRMED, lost),
    Gate("it is identifiable only beside a value that [drive.nominal] does not give", unclaimable),
    Gate("the model lacks something, and no regression shows it by itself", without_second_opinion),
    Gate("the lags of winding and drive are not identifiable separately", between_two_lags),
    Gate("it is not identifiable without K, which is not known", resistance_without_torque_constant),
    Gate("only L/R shows, and R is not known", inductance_without_resistance),
)


class Qualification:
    """Which parameters have ever been, and still are, known well enough; flags with hysteresis.

    Attributes:
        qualified: shape (n,).
    """

    def __init__(self, n: int) -> None:
        self.qualified: Mask = np.zeros(n, dtype=bool)
        self._evidence: Evidence | None = None

    def update(self, e: Evidence) -> None:
        """Decide after a tick which parameters are qualified."""
        self.qualified, self._evidence = self.qualified.copy(), e
        _close(LAPSES, e, self.qualified)
        gained = np.ones_like(self.qualified)
        _close(ENTRY, e, gained)
        self.qualified |= gained
        _close(STAYS, e, self.qualified)

    def why_not(self, name: str) -> str | None:
        """What keeps a parameter from being known, in words: what lasts first. None: it is known, or nobody has asked
        yet."""
        k = self._evidence.masks.names.index(name) if self._evidence is not None else 0
        if self._evidence is None or self.qualified[k]:
            return None
        closed = (gate for gate in (*STAYS, *LAPSES, *ENTRY) if gate.stops(self._evidence, self.qualified)[k])
        return next((gate.reason for gate in closed), None)


def _close(gates: tuple[Gate, ...], e: Evidence, mask: Mask) -> None:
    """Take from a mask what the gates stop, one after the other."""
    for gate in gates:
        mask &= ~gate.stops(e, mask)
