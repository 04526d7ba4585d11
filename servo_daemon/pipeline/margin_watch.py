"""The warning that ageing has eaten the margins of the gains in use.

Every `EVERY_S` of device time the margins of `[drive.controller]` are computed with the estimates of that moment:
0.7 ms of NumPy in the pipeline's thread, 0.015 % of a core. It warns when a margin is below its limit, or has lost more
than half of what it had with the nominal values, and takes the warning back once all are better by `RELIEF`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from servo_daemon.errors import TuningError
from servo_daemon.parameters import KNOWN
from servo_daemon.published.knowledge import LoopFacts, motor_knowledge
from servo_daemon.published.snapshot import Estimate
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tuning.knowledge import NEEDED
from servo_daemon.tuning.margins import Margins

#: Between two computations, device time, s: parameters age over minutes.
EVERY_S: Final = 5.0
#: By this share margins must be better than where the warning began before it ends (hysteresis; chosen; not tried).
RELIEF: Final = 0.1
#: Its name among `health.alarms`.
ALARM: Final = "controller_margin"
_SETTLED: Final = (*KNOWN, "fixed")

Health = Mapping[str, float | int | bool | str | None]


class MarginWatch:
    """Makes warnings of one drive's estimates and the gains in use; without these it does nothing. Pure."""

    def __init__(self, facts: LoopFacts) -> None:
        self._facts = facts
        self._next_s: float | None = None
        self._last_s = 0.0
        self._low = False
        self._now: Margins | None = None
        self._nominal: tuple[float, Margins | None] | None = None  # rate, and the margins at it

    @property
    def low(self) -> bool:
        """Whether the warning stands."""
        return self._low

    @property
    def health(self) -> Health:
        """For the health record; empty without gains in use."""
        if self._facts.in_use is None:
            return {}
        now = self._now
        return {
            "controller_stable": None if now is None else now.stable,
            "controller_phase_margin_deg": None if now is None else now.phase_margin_deg,
            "controller_gain_margin_dB": None if now is None else _gain_margin(now),
            "controller_sensitivity_peak": None if now is None else now.sensitivity_peak,
            "controller_margin_low": None if now is None else self._low,
        }

    def update(self, estimate: Estimate) -> list[Message]:
        """Look at an estimate if it is time to; returns what begins or ends with it."""
        if self._facts.in_use is None or not self._due(estimate.time_s):
            return []
        if not all(p.status in _SETTLED for p in estimate.parameters if p.name in NEEDED):
            return []  # nominal values in the place of estimates would be another motor; the warning stays as it is
        try:
            motor = motor_knowledge(estimate.parameters, estimate.covariance, estimate.model, estimate.state)
            setup = self._facts.setup(estimate.sample_rate_hz)
        except TuningError:
            return []
        from servo_daemon.tuning.assess import margins_of, weaknesses

        self._now = now = margins_of(self._facts.in_use, motor.log_values, setup)
        nominal = self._nominal_at(setup.rate_hz)
        found = weaknesses(now, nominal, setup.limits)
        if not self._low and found:
            self._low = True
            text = "the controller's gains in use no longer suit the motor: " + "; ".join(w.text for w in found)
            return [("margin_low", text, self._data(estimate))]
        if self._low and not weaknesses(now, nominal, setup.limits, RELIEF):
            self._low = False
            return [("margin_restored", "the controller's margins are sufficient again", self._data(estimate))]
        return []

    def forget(self, why: str) -> list[Message]:
        """What it was about is no longer known.

        Args:
            why: in words.
        """
        was_low, self._low, self._now, self._next_s = self._low, False, None, None
        return [("margin_restored", f"the warning of small margins is forgotten: {why}", {})] if was_low else []

    def _due(self, time_s: float) -> bool:
        """Also when the device's clock began anew."""
        if self._next_s is not None and self._last_s <= time_s < self._next_s:
            self._last_s = time_s
            return False
        self._last_s, self._next_s = time_s, time_s + EVERY_S
        return True

    def _nominal_at(self, rate_hz: float) -> Margins | None:
        """Of the nominal motor; measured rates wander by less than matters."""
        values = self._facts.log_nominal
        if values is None or self._facts.in_use is None:
            return None
        if self._nominal is None or abs(self._nominal[0] / rate_hz - 1.0) > 0.01:
            from servo_daemon.tuning.assess import margins_of

            margins = margins_of(self._facts.in_use, values, self._facts.setup(rate_hz))
            self._nominal = rate_hz, margins
        return self._nominal[1]

    def _data(self, estimate: Estimate) -> Mapping[str, float | int | str | None]:
        """Numbers of the event; its age is that of the oldest parameter that went into the margins."""
        now = self._now
        if now is None:
            return {"time_s": estimate.time_s}
        ages_s = [p.age_s for p in estimate.parameters if p.name in NEEDED and p.age_s is not None]
        return {
            "phase_margin_deg": now.phase_margin_deg,
            "gain_margin_dB": _gain_margin(now),
            "sensitivity_peak": now.sensitivity_peak,
            "time_s": estimate.time_s,
            "age_s": max(ages_s, default=None),
        }


def _gain_margin(m: Margins) -> float | None:
    from servo_daemon.tuning.assess import smaller_gain_margin_dB

    return smaller_gain_margin_dB(m)
