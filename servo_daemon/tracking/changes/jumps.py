"""Sudden changes, distinguished from noise, from slow drift and from what no parameter explains.

A tick whose innovations the noise does not explain is not learned from: the parameters go back to what they were before
it. A wrong sample or two, a lost encoder count, a voltage that read zero for a moment end there. If such ticks go on,
something has changed: the parameters' covariance is opened for a moment. Either they settle on new values and the
innovations are white again: a jump, reported with its time and size; or they do not: no parameter explains it, what was
known before is put back, and it is left to the process noise and the mismatch watch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.kalman.gaussian import from_coordinate
from servo_daemon.parameters import Parameter, spaced
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.settings import Message

#: Ticks with unexplained innovations (others count a quarter against) until the covariance is opened: 0.3 s.
_TICKS_TO_OPEN = 3.0
#: Ticks the filter has to settle: at least and at most; so many in a row must be explained again.
_OPEN_LEAST, _OPEN_MOST, _SETTLED = 10, 30, 5
#: Share of unexplained ticks, over about so many, from which on they are the rule.
_RULE, _USUAL_TICKS = 0.15, 50
#: After something that no parameter explained the watch rests, ticks.
_REST = 300
#: By how much a coordinate's covariance is opened, 1 σ over its scale: below the loss of qualification.
OPEN_STD = 0.13
#: The same for signed parameters (a load torque), which have no qualification to lose by it.
OPEN_SIGNED_STD = 0.5
#: A parameter has jumped when it moved by this many standard deviations, and by this much of its size. It is named if
#: that is as much more than it wandered before (two invented steps of K under a hidden brush drop: 3.9 times).
SIGNIFICANT, _NOTICEABLE = 6.0, 0.02
#: Beside a large jump of one, others are named only if they are this share as significant: they have been pulled along.
_BESIDE = 0.3

#: The event that names a parameter which has jumped.
JUMPED = "parameter_jump"

#: What the filter is to do with the tick it has just worked through.
Action = Literal["learn", "undo", "open", "settle", "accept", "reject"]


class JumpWatch:
    """Decides, tick by tick. It holds no estimate itself.

    Attributes:
        is_open: the covariance is open.
        sudden: what is being looked into came suddenly, after samples that the model explained. Where unexplained
            ticks are the rule, or innovations were not white, the model lacks something, and what moves then is no jump
            that could be named.
    """

    def __init__(self) -> None:
        self._usual = self._usual_before = 0.0  # running share of unexplained ticks, and before the last ones
        self.sudden = True
        self.reset()

    def reset(self) -> None:
        self._score = 0.0
        self._open_ticks = self._settled = self._rest = 0
        self.is_open = False

    def explain(self) -> None:
        """The unexplained ticks have been explained: count anew."""
        self._usual = self._usual_before
        self.reset()

    @property
    def quiet(self) -> bool:
        """Nothing unexplained is being looked into: what is known now is what a restart of the daemon may keep."""
        return self._score == 0.0 and not self.is_open

    @property
    def idle(self) -> bool:
        """Quiet, unexplained ticks are the exception, and it does not rest."""
        return self.quiet and self.calm and self._rest == 0

    @property
    def calm(self) -> bool:
        """Whether unexplained ticks are the exception."""
        return self._usual < _RULE

    def observe(self, unexplained: bool, explained: bool) -> None:
        """Count a tick, also one that no decision is made on.

        Args:
            unexplained: as for `judge`.
            explained: the model has explained the samples before this tick.
        """
        if self.quiet:
            self.sudden, self._usual_before = self.calm and explained, self._usual
        self._usual += (float(unexplained) - self._usual) / _USUAL_TICKS

    def judge(self, unexplained: bool, settled: bool, searched: bool = False) -> Action:
        """Decide after a tick.

        Args:
            unexplained: its innovations are beyond what the noise explains.
            settled: they are as the noise has them.
            searched: which parameter it was is still being looked for (`jump_search`): nothing is opened meanwhile.
        """
        if self.is_open:
            return self._judge_open(settled)
        if self._rest > 0:
            self._rest -= 1
            return "learn"
        if not unexplained:
            self._score = max(0.0, self._score - 0.25)
            return "learn"
        self._score += 1.0
        if searched:
            self._score = min(self._score, _TICKS_TO_OPEN - 1.0)
        if self._score < _TICKS_TO_OPEN:
            return "undo"
        self.is_open, self._open_ticks, self._settled = True, 0, 0
        return "open"

    def _judge_open(self, settled: bool) -> Action:
        self._open_ticks += 1
        self._settled = self._settled + 1 if settled else 0
        if self._open_ticks >= _OPEN_LEAST and self._settled >= _SETTLED:
            self.reset()
            return "accept"
        if self._open_ticks >= _OPEN_MOST:
            self.reset()
            self._rest = _REST
            return "reject"
        return "settle"


@dataclass(frozen=True, slots=True)
class Known:
    """The parameters before something happened: coordinates (n,), covariance (n, n), and when, s of device time."""

    names: tuple[str, ...]
    mean: F64
    covariance: F64
    time_s: float


def jumped(before: Known, mean: F64, std: F64, scales: F64, candidates: NDArray[np.bool_]) -> list[int]:
    """Indices of the parameters that moved, the most significant first.

    Args:
        mean, std: after it, shape (n,).
        scales: one unit of each coordinate, shape (n,).
        candidates: which may be named, shape (n,).
    """
    moved = np.abs(mean - before.mean)
    z = moved / np.sqrt(np.diag(before.covariance) + std**2)
    possible = candidates & (z > SIGNIFICANT) & (moved > _NOTICEABLE * scales)
    significant = possible & (z > _BESIDE * np.max(z, where=possible, initial=0.0))
    return [int(k) for k in np.argsort(-z) if significant[k]]


def message(parameter: Parameter, before: Known, coordinate: float, time_s: float) -> Message:
    """The event: when, from where, to where, in the parameter's unit."""
    k = before.names.index(parameter.name)
    old, _ = from_coordinate(parameter, float(before.mean[k]), 0.0)
    new, _ = from_coordinate(parameter, coordinate, 0.0)
    unit = spaced(parameter.unit)
    size = f"{100 * (new / old - 1):+.1f} %" if parameter.transform == "log" else f"{new - old:+.3g}{unit}"
    text = f"{parameter.name} stepped from {old:.4g} to {new:.4g}{unit} ({size})"
    data: dict[str, float | int | str | None] = {
        "parameter": parameter.name,
        "unit": parameter.unit,
        "from": old,
        "to": new,
        "time_s": before.time_s,
        "recognised_s": time_s,
    }
    return JUMPED, text, data
