"""R and L of a motor whose shaft has never turned: v = R i + L di/dt, without the column of the speed.

A blocked-rotor test is the standard measurement of a winding, and the first thing that a new drive is given. A
regression with a column of zeros says nothing, and a filter whose encoder has no noise would take the standstill for
knowledge of friction and inertia.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.regression.estimate import KNOWS, RegressionEstimate
from servo_daemon.regression.rls_fit import CLOSES, OVERLAP, SYSTEMATIC, Block, fitted
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64

#: The winding's own.
_NAMES = ("R", "L")
#: A shaft, or a channel, that moves by no more (rad, rad/s, A) stands: below any sensor's step, above rounding.
STILL = 1e-9
#: A correlation, in units of 1/√n, and a mean, in its standard deviations, that chance makes once in 16,000 times; and
#: fewest samples that it is asked of.
_BY_CHANCE, _FEWEST = 4.0, 100


class NoiseAlone:
    """Whether a channel shows noise and nothing else: white, and nothing in it follows what could have moved it. From
    sums over its samples and those of its possible causes, as many at a time as there are."""

    def __init__(self) -> None:
        self._gram: F64 | None = None
        self._before: F64 | None = None

    def take(self, values: F64, causes: Sequence[F64]) -> None:
        """The next samples of the channel and of each cause, shapes (n,); values near zero (of an angle those from its
        first place)."""
        now = np.column_stack([values, *causes])
        rows = now if self._before is None else np.vstack([self._before, now])
        self._before = rows[-1:]
        lagged = np.column_stack([np.ones(len(rows) - 1), rows[1:], rows[:-1]])
        gram = lagged.T @ lagged
        self._gram = gram if self._gram is None else self._gram + gram

    @property
    def asked(self) -> bool:
        """Whether there are enough samples to say."""
        return self._gram is not None and bool(self._gram[0, 0] >= _FEWEST)

    def holds(self, *, about_zero: bool) -> bool:
        """Whether the channel is white and follows no cause at the same sample or the one before.

        Args:
            about_zero: its mean is zero, too.
        """
        if self._gram is None or not self.asked:
            return False
        n = self._gram[0, 0]
        mean = self._gram[0, 1:] / n
        C = self._gram[1:, 1:] / n - np.outer(mean, mean)
        then = len(C) // 2
        square = float(C[0, 0])
        if about_zero and abs(mean[0]) > _BY_CHANCE * math.sqrt(max(square, 0.0) / n):
            return False
        if C[0, 0] + C[then, then] - 2.0 * C[0, then] < square:  # of white noise it is twice as much
            return False
        causes = [k for k in range(1, len(C)) if k != then]
        return all(abs(C[0, k]) <= _BY_CHANCE * math.sqrt(max(square * C[k, k], 0.0) / n) for k in causes)


class HeldShaft:
    """Regression of R and L from the first sample until the shaft moves. An encoder that flickers is no motion.

    Args:
        columns: of the armature's regression.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        self._columns = [k for k, name in enumerate(columns) if name != "K" and not name.startswith("rip_")]
        n = len(self._columns)
        self._sums: Block | None = Block(0.0, np.zeros((n + 1, n + 1)), np.zeros(n), 0.0, 0.0, 0.0)
        self._place: float | None = None
        self._begin_s: float | None = None
        self._flicker, self._silent = NoiseAlone(), True

    def watch(self, s: Stretch) -> None:
        """A tick's samples."""
        motion = s.position if s.position is not None else s.velocity
        if self._sums is None or motion is None or not s.usable.any():
            return
        motion = motion[s.usable]
        if self._place is None:
            self._place = float(motion[0]) if s.position is not None else 0.0
        self._silent = self._silent and float(np.max(np.abs(motion - self._place))) <= STILL
        voltage = np.zeros_like(s.time_s) if s.voltage is None else s.voltage
        self._flicker.take(motion - self._place, (voltage[s.usable], s.effort[s.usable]))
        if self._flicker.asked and not self._silent and not self._flicker.holds(about_zero=s.position is None):
            self._sums = None

    @property
    def stands(self) -> bool:
        """Whether the shaft has been watched, and has not moved."""
        return self._sums is not None and self._flicker.asked

    def take(self, s: Stretch, Phi: F64, y: F64) -> None:
        """A tick's rows of the armature's regression, shapes (n, k) and (n,)."""
        if self._sums is None:
            return
        rows = np.column_stack([Phi[:, self._columns], y])
        time_s = float(s.time_s[-1])
        self._begin_s = float(s.time_s[0]) if self._begin_s is None else self._begin_s
        before = self._sums
        self._sums = replace(before, time_s=time_s, gram=before.gram + rows.T @ rows, rows=before.rows + len(y))

    def estimate(self) -> RegressionEstimate | None:
        """R and L (of a current that is constant, or settles within a sample, known to nothing); None where the shaft
        has moved, R is not known, or they do not explain the voltage: then it is the sensor that stands."""
        told = self._silent or self._flicker.asked
        if self._sums is None or self._begin_s is None or self._place is None or not told:
            return None
        span_s = self._sums.time_s - self._begin_s
        fit = fitted(span_s, self._sums)
        if fit is None or fit.left > CLOSES**2 * fit.energy:
            return None
        covariance = fit.inverse[:2, :2] * (fit.residual_var + SYSTEMATIC**2 * fit.energy) * OVERLAP
        known = RegressionEstimate(_NAMES, fit.value[:2], covariance, span_s, True)
        return known if known.std[0] < KNOWS * known.value[0] else None
