"""What the moment of a drive's current means for B (`conditioning/current_moment.py`) and for every torque, live."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from servo_daemon.conditioning.current_moment import moment_std_s, motion_squares
from servo_daemon.pipeline.link.torques import is_torque, motion_std
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
    """What the moment of one drive's current or torque leaves open; fed ticks.

    Args:
        meaning: of its signals.
        torques: of every torque, too. (A `MeasuredLink` has it in theirs.)
    """

    def __init__(self, meaning: SignalMeaning, *, torques: bool) -> None:
        self._std_s, self._torques = moment_std_s(meaning), torques
        self._period_s = 0.0
        self._squares = np.zeros(2)  # of speed and of acceleration, summed

    def take(self, tick: SampleBlock) -> None:
        """Take note of a tick's motion."""
        t = tick.time_s
        if len(t) > 1:
            self._period_s = float(t[-1] - t[0]) / (len(t) - 1)
        at = np.unique(np.linspace(0, len(t) - 1, _PARTS + 1).astype(int))
        found = motion_squares(t, tick.position_rad, tick.velocity_rad_s, at)
        if found is not None:
            self._squares = self._squares * math.exp(-TICK_S / _SPAN_S) + found

    def widened(self, estimate: Estimate) -> Estimate:
        """The record with this in the standard deviations and variances."""
        floors = self._floors(estimate)
        if not floors:
            return estimate
        parameters = tuple(
            replace(p, std=math.hypot(p.std, floors[p.name])) if p.name in floors and p.std is not None else p
            for p in estimate.parameters
        )
        values = {p.name: p.value for p in parameters if p.value}
        return replace(estimate, parameters=parameters, covariance=_widened(estimate.covariance, values, floors))

    def _floors(self, estimate: Estimate) -> dict[str, float]:
        """1 σ beside what the filter says, by name."""
        value = {p.name: p.value for p in estimate.parameters if p.value is not None and p.std is not None}
        share = motion_std(self._period_s) if self._torques else 0.0
        floors = {name: abs(v) * share for name, v in value.items() if share and is_torque(name)}
        J = next((p.value for p in estimate.parameters if p.name == "J"), None)
        if J is not None and "B" in value and self._squares[0] >= _STILL**2:
            turned = J * self._std_s * float(self._squares[1] / self._squares[0])
            floors["B"] = math.hypot(floors.get("B", 0.0), turned)
        return floors


def _widened(
    covariance: Covariance | None, values: Mapping[str, float], floors: Mapping[str, float]
) -> Covariance | None:
    if covariance is None:
        return None
    rows = [list(row) for row in covariance.values]
    for at, name in enumerate(covariance.names):
        if name in floors and name in values:
            rows[at][at] += (floors[name] / (values[name] if parameter_table()[name].transform == "log" else 1.0)) ** 2
    return replace(covariance, values=tuple(map(tuple, rows)))
