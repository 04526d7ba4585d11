"""When a diagnosis is due without being asked for: the model has not explained the data for long enough.

Long enough is half of the ring: so that most of the recording is of the motor as it is now, and what happened suddenly
(a jam, a contact) is still in the middle of it. A diagnosis takes a core for a minute and says the same as long as
nothing changes: after each one the next waits a quarter of an hour, four times as long each time that it finds the
same, a day at most.
"""

from __future__ import annotations

from servo_daemon.published.snapshot import Estimate

#: Of the ring: unexplained for so long, and filled so far (chosen; not tried).
_UNEXPLAINED_SHARE, _FILLED_SHARE = 0.5, 0.9
#: First and longest pause after a diagnosis, s (a quarter of an hour, an hour, … a day; chosen; not tried).
_FIRST_PAUSE_S, _LONGEST_PAUSE_S, _PAUSE_GROWS = 900.0, 86_400.0, 4.0


class MismatchWatch:
    """Decides from one drive's estimates when a diagnosis is due. Pure.

    Args:
        ring_s: length of the ring, s.
    """

    def __init__(self, ring_s: float) -> None:
        self._ring_s = ring_s
        self._last_s: float | None = None
        self._unexplained_s = 0.0
        self._pause_s = _FIRST_PAUSE_S
        self._not_before: float | None = None
        self._finding: tuple[str, ...] | None = None

    def due(self, estimate: Estimate, span_s: float, now_s: float) -> bool:
        """Take an estimate; whether a diagnosis is due.

        Args:
            span_s: how much the ring holds.
            now_s: a clock that never goes back.
        """
        last, self._last_s = self._last_s, estimate.time_s
        white = estimate.health.get("innovation_white")
        step_s = 0.0 if last is None else min(max(estimate.time_s - last, 0.0), 1.0)
        if white is False:  # None: there is no filter yet
            self._unexplained_s = min(self._unexplained_s + step_s, self._ring_s)
        elif white is True:
            self._unexplained_s = max(self._unexplained_s - step_s, 0.0)
        if self._ring_s <= 0 or (self._not_before is not None and now_s < self._not_before):
            return False
        long_enough = self._unexplained_s >= _UNEXPLAINED_SHARE * self._ring_s
        return white is False and long_enough and span_s >= _FILLED_SHARE * self._ring_s

    def ended(self, finding: tuple[str, ...], now_s: float) -> None:
        """A diagnosis has ended.

        Args:
            finding: what it said; equal findings make the pause longer.
        """
        same = finding == self._finding
        self._pause_s = min(self._pause_s * _PAUSE_GROWS, _LONGEST_PAUSE_S) if same else _FIRST_PAUSE_S
        self._finding, self._not_before = finding, now_s + self._pause_s

    def forget(self) -> None:
        """The model is another one, or everything was reset: what was found says nothing any more."""
        self._unexplained_s, self._pause_s = 0.0, _FIRST_PAUSE_S
        self._finding = self._not_before = self._last_s = None
