"""How far estimates wander while nothing has changed suddenly.

Where the model lacks something the filter puts it into its parameters, and they move with what the motor is doing: by
more than their standard deviations, and with white innovations if it is little. A step has to stand out of that:
without it `test_a_hidden_brush_drop_makes_values_wander_and_names_no_step` fails.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.tracking.plan.settings import TICK_S

#: So far back, ticks: a minute, several cycles of what a motor usually does
#: (`test_what_was_long_ago_or_before_a_step_says_nothing` fails with twice as many; half are free).
_TICKS = round(60.0 / TICK_S)


class Wander:
    """Estimates of the last minute, tick by tick."""

    def __init__(self) -> None:
        self._passed: deque[F64] = deque(maxlen=_TICKS)

    def clear(self) -> None:
        """Forget the estimates so far."""
        self._passed.clear()

    def add(self, coordinates: F64) -> None:
        """Take the estimates of a tick, shape (n,)."""
        self._passed.append(coordinates)

    def spread(self, size: int) -> F64:
        """Standard deviations about straight lines (ageing is no wandering), shape (size,); 0 if nothing is known."""
        if len(self._passed) < 3:
            return np.zeros(size)
        y = np.array(self._passed)
        t = np.linspace(-1.0, 1.0, len(y))
        lines = np.polynomial.polynomial.polyfit(t, y, 1)
        return np.asarray(np.std(y - np.polynomial.polynomial.polyval(t, lines).T, axis=0))
