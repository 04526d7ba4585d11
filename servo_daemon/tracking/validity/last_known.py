"""Each parameter as it was when it was last known, how long ago that is, and how sure of it one can still be."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.tracking.plan.parameter_masks import Mask
from servo_daemon.tracking.validity.fusion import Trusted


class LastKnown:
    """The last known values of n parameters, coordinates and variances as the filter has them."""

    def __init__(self, n: int) -> None:
        self._coordinate, self._var = np.zeros(n), np.full(n, np.nan)
        self._known_at_s, self._unconfirmed_s = np.full(n, np.nan), np.zeros(n)

    def begin(self, trusted: Mask, time_s: float) -> None:
        """A filter starts with parameters that were known before it, shape (n,): their age counts from here."""
        self._known_at_s = np.where(trusted, time_s, self._known_at_s)

    def stepped(self, k: int, coordinate: float, std: float) -> None:
        """Parameter k is another one: what it was when it was last known it is no more."""
        if not math.isnan(self._var[k]):
            self._coordinate[k], self._var[k] = coordinate, std**2

    def remember(self, well: Mask, coordinate: F64, well_var: F64, own_var: F64, drift_var: F64) -> None:
        """After each tick: what is known well is kept; what was is of a motor that may have drifted since.

        Args:
            well: which are, shape (n,).
            coordinate, well_var: of these, shape (n,).
            own_var: the filter's variances: what is held is no surer than the present estimate has ever been since.
            drift_var: what the tick adds, shape (n,).
        """
        drifted = np.maximum(self._var + drift_var, own_var)
        self._coordinate, self._var = np.where(well, coordinate, self._coordinate), np.where(well, well_var, drifted)

    def count(self, known: Mask, excited: Mask, time_s: float, duration_s: float) -> None:
        """After each tick: the motion shows these, and they are known; or it only shows them. Shapes (n,)."""
        self._known_at_s = np.where(known, time_s, self._known_at_s)
        self._unconfirmed_s = np.where(known, 0.0, self._unconfirmed_s + duration_s * excited)

    def was_never(self, k: int) -> bool:
        """Whether parameter k was never known."""
        return math.isnan(self._var[k])

    def of(self, k: int, now_s: float) -> Trusted | None:
        """The last known value of parameter k; None: it never was known.

        Args:
            now_s: device time.
        """
        if self.was_never(k):
            return None
        age_s = self.ages_s(now_s)[k] or 0.0
        return Trusted(float(self._coordinate[k]), math.sqrt(self._var[k]), age_s, float(self._unconfirmed_s[k]))

    def ages_s(self, now_s: float) -> list[float | None]:
        """Time since each parameter was last shown and known, shape (n,); None: it never was."""
        return [None if math.isnan(at) else max(0.0, now_s - at) for at in self._known_at_s.tolist()]
