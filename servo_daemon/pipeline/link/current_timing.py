"""What the moment of a drive's current means for B, live (`conditioning/current_moment.py`)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servo_daemon.conditioning.current_moment import moment_std_s, motion_squares
from servo_daemon.plant.effects import parameter_table
from servo_daemon.published.snapshot import Covariance, Estimate
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.tracking.plan.settings import TICK_S

#: Speeds are means over a fifth of a tick, so that an encoder's steps are no acceleration.
_PARTS = 5
#: How far back the motion is looked at, s, and least speed that there is something to divide by, rad/s (as in
#: `measured_link.py`; the second is below any encoder's).
_SPAN_S, _STILL = 20.0, 1e-6


class CurrentTiming:
    """What the moment of one drive's current leaves open of B; fed ticks.

    Args:
        meaning: of its signals.
    """

    def __init__(self, meaning: SignalMeaning) -> None:
        self._std_s = moment_std_s(meaning)
        self._squares = np.zeros(2)  # of speed and of acceleration, summed

    def take(self, tick: SampleBlock) -> None:
        """Take note of a tick's motion."""
        t = tick.time_s
        at = np.unique(np.linspace(0, len(t) - 1, _PARTS + 1).astype(int))
        found = motion_squares(t, tick.position_rad, tick.velocity_rad_s, at)
        if found is not None:
            self._squares = self._squares * math.exp(-TICK_S / _SPAN_S) + found

    def widened(self, estimate: Estimate) -> Estimate:
        """The record with this in B's standard deviation and variance."""
        of = {p.name: p for p in estimate.parameters}
        J, B = of["J"].value if "J" in of else None, of.get("B")
        if J is None or B is None or B.std is None or self._squares[0] < _STILL**2:
            return estimate
        floor = J * self._std_s * float(self._squares[1] / self._squares[0])
        wider = replace(B, std=math.hypot(B.std, floor))
        parameters = tuple(wider if p is B else p for p in estimate.parameters)
        return replace(estimate, parameters=parameters, covariance=_widened(estimate.covariance, B.value, floor))


def _widened(covariance: Covariance | None, B: float | None, floor: float) -> Covariance | None:
    if covariance is None or "B" not in covariance.names or not B:
        return covariance
    at = covariance.names.index("B")
    values = [list(row) for row in covariance.values]
    values[at][at] += (floor / (B if parameter_table()["B"].transform == "log" else 1.0)) ** 2
    return replace(covariance, values=tuple(map(tuple, values)))
