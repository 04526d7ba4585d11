"""A window of operation, prepared once for all features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.conditioning.layout import Stretches
from servo_daemon.errors import BadInputError
from servo_daemon.numerics import upper_median
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64, Quality, SampleBlock

#: Windows may be this long, s: shorter ones hold too little of the shaft, in longer ones the motor changes.
SHORTEST_S, LONGEST_S = 2.0, 10.0
#: Times within this share of the limits still count: a window of 10 s has 9.999 s between its first and last sample.
_SLACK = 0.02
_FEWEST_SAMPLES = 64
#: Of the samples so many must be usable: features of the rest would be of the interpolation.
LEAST_USABLE = 0.5


@dataclass(frozen=True)
class Window:
    """Signals of a window.

    Attributes:
        stretch: as the regressions take it; time from the window's beginning.
        period_s: usual distance of two samples.
        even: voltage, current, speed on an even grid of that period, shape (3, m), interpolated over samples that
            are missing or no measurement; NaN for a signal that is not there at all.
        usable: share of samples that are there and are measurements.
        saturated: share of samples that the drive flags.
        position_lsb: the encoder's step, rad; 0 where none shows.
    """

    stretch: Stretch
    period_s: float
    even: F64
    usable: float
    saturated: float
    position_lsb: float

    @property
    def seconds(self) -> float:
        """Length of the window, s."""
        return float(self.even.shape[1] * self.period_s)


def prepare(block: SampleBlock) -> Window:
    """The window's signals.

    Raises:
        BadInputError: too short, too long, too few usable samples, no motion measured, or time stands still.
    """
    n = len(block)
    seconds = float(block.time_s[-1] - block.time_s[0])
    if n < _FEWEST_SAMPLES or not (1 - _SLACK) * SHORTEST_S <= seconds <= (1 + _SLACK) * LONGEST_S:
        raise BadInputError(
            f"a window of {n} samples over {seconds:.3g} s: {_FEWEST_SAMPLES} samples over "
            f"{SHORTEST_S:g} to {LONGEST_S:g} s are needed"
        )
    if block.position_rad is None and block.velocity_rad_s is None:
        raise BadInputError("a window needs position_rad or velocity_rad_s")
    period = upper_median(np.diff(block.time_s))
    stretch = Stretches().of(block, float(block.time_s[0]), None, period)
    usable = float(np.count_nonzero(stretch.usable)) / max(n, round(seconds / period) + 1)
    if usable < LEAST_USABLE:
        raise BadInputError(f"only {100 * usable:.0f} % of the window's samples are usable")
    lsb = 0.0
    if stretch.position is not None:
        steps = np.abs(np.diff(stretch.position))
        steps = steps[steps > 0]
        lsb = float(steps.min()) if len(steps) else 0.0
    saturated = float(np.count_nonzero(block.quality & int(Quality.SATURATED))) / n
    return Window(stretch, period, _even(stretch, period), usable, saturated, lsb)


def _even(s: Stretch, period: float) -> F64:
    """Voltage, current, speed on an even grid."""
    good: NDArray[np.bool_] | slice = slice(None) if s.usable.all() else s.usable
    time = s.time_s[good]
    grid = np.arange(round((time[-1] - time[0]) / period) + 1) * period + time[0]
    out = np.full((3, len(grid)), np.nan)
    if s.voltage is not None:  # held from sample to sample
        out[0] = s.voltage[good].take(_last_before(time, grid + 0.5 * period))
    at = np.minimum(_last_before(time, grid), len(time) - 2)
    since = np.minimum(grid, time[-1]) - time.take(at)
    step = np.diff(time)
    step[step <= 0.0] = np.inf  # a time stamp told twice: the later sample counts
    for k, values in ((1, s.current), (2, s.speed)):
        if values is not None:
            known = values[good]
            out[k] = known.take(at) + since * (np.diff(known) / step).take(at)
    return out


def _last_before(time: F64, when: F64) -> NDArray[np.intp]:
    """Index of the last sample at or before each moment, shape (len(when),); both increase, none is before the first.

    Nearly even samples are guessed: searching each takes five times as long.
    """
    last = len(time) - 1
    guess = np.minimum(np.arange(len(when)), last)
    guess -= time.take(guess) > when
    right = time.take(guess) <= when
    right &= (time.take(np.minimum(guess + 1, last)) > when) | (guess == last)
    if right.all():
        return guess
    return np.asarray(np.searchsorted(time, when, side="right") - 1)
