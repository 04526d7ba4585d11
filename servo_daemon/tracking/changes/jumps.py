"""Sudden changes, distinguished from noise, from slow drift and from what no parameter explains.

A tick whose innovations the noise does not explain is not learned from: the parameters go back to what they were before
it. A wrong sample or two, a lost encoder count, a voltage that read zero for a moment end there. If such ticks go on
and no parameter is found to have stepped (`search.py`), it is left to the process noise and the mismatch watch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from servo_daemon.kalman.gaussian import from_coordinate
from servo_daemon.parameters import Parameter, spaced
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.settings import Message

#: Unexplained ticks (others count a quarter against) that are undone, where no search for a step runs: 0.2 s (decision
#: 40).
_MOST_UNDONE = 2.0
#: Share of unexplained ticks, over about so many, from which on they are the rule (see `make calibrate`).
_RULE, _USUAL_TICKS = 0.15, 50
#: After something that no parameter explained the watch rests, ticks: half a minute
#: (`test_what_goes_on_is_learned_from_for_half_a_minute` fails with half or twice as many).
_REST = 300
#: The event that names a parameter which has jumped.
JUMPED = "parameter_jump"

#: What the filter is to do with the tick it has just worked through.
Action = Literal["learn", "undo", "accept"]


class JumpWatch:
    """Decides, tick by tick. It holds no estimate itself.

    Attributes:
        sudden: what is being looked into came suddenly, after samples that the model explained. Where unexplained
            ticks are the rule, or innovations were not white, the model lacks something, and what moves then is no jump
            that could be named.
    """

    def __init__(self) -> None:
        self._usual = self._usual_before = 0.0  # running share of unexplained ticks, and before the last ones
        self.sudden = True
        self.reset()

    def reset(self) -> None:
        self._score, self._rest = 0.0, 0

    def explain(self) -> None:
        """The unexplained ticks have been explained: count anew."""
        self._usual = self._usual_before
        self.reset()

    @property
    def quiet(self) -> bool:
        """Nothing unexplained is being looked into: what is known now is what a restart of the daemon may keep."""
        return self._score == 0.0

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

    def judge(self, unexplained: bool, searched: bool = False) -> Action:
        """Decide after a tick.

        Args:
            unexplained: its innovations are beyond what the noise explains.
            searched: which parameter it was is still being looked for (`search.py`).
        """
        if self._rest > 0:
            self._rest -= 1
            return "learn"
        if not unexplained:
            self._score = max(0.0, self._score - 0.25)
            return "learn"
        self._score += 1.0
        if searched:
            self._score = min(self._score, _MOST_UNDONE)
        if self._score <= _MOST_UNDONE:
            return "undo"
        self._score, self._rest = 0.0, _REST
        return "learn"


@dataclass(frozen=True, slots=True)
class Known:
    """The parameters before something happened: coordinates (n,), covariance (n, n), and when, s of device time."""

    names: tuple[str, ...]
    mean: F64
    covariance: F64
    time_s: float


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
