"""The armature's balance over short windows: v = R i + L Δi/T + K Δθ/T, each a mean over a window.

The sum of an angle's differences has the noise of two readings only, however many samples a window holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.capture.model import Capture
from servo_daemon.numerics import least_squares, sample_period
from servo_daemon.samples import F64

#: A window lasts this long, s, and at least so many intervals: the encoder's step is small against its travel.
_WINDOW_S, _LEAST = 0.01, 4
#: Fewer windows tell nothing.
FEWEST = 40


def travel_of(time_s: F64, position_rad: F64 | None, velocity_rad_s: F64 | None) -> F64 | None:
    """Δθ of every interval, shape (n − 1,), by the angle, else by the speed, shapes (n,); None without a motion."""
    if position_rad is not None:
        return np.diff(position_rad)
    if velocity_rad_s is not None:
        return np.asarray((velocity_rad_s[1:] + velocity_rad_s[:-1]) / 2 * np.diff(time_s))
    return None


def travelled(capture: Capture) -> F64 | None:
    """`travel_of` a capture."""
    return travel_of(capture.time_s, capture.position_rad, capture.velocity_rad_s)


def window_length(time_s: F64) -> int:
    """How many sampling intervals a window has."""
    return max(_LEAST, round(_WINDOW_S / sample_period(time_s)))


@dataclass(frozen=True, slots=True)
class Windows:
    """Means over w windows of m intervals each; shapes (w,)."""

    m: int
    edges: NDArray[np.intp]
    lasting: F64
    speed: F64
    voltage: F64

    @classmethod
    def of(cls, time_s: F64, voltage: F64, travel: F64, m: int | None = None) -> Windows:
        """From samples, shape (n,), and the travel of every interval, shape (n − 1,)."""
        m = m or window_length(time_s)
        edges = np.arange(0, len(time_s), m)
        lasting = np.diff(time_s[edges])
        return cls(
            m,
            edges,
            lasting,
            _summed(travel, edges) / lasting,
            _summed(voltage[:-1] * np.diff(time_s), edges) / lasting,
        )

    def __len__(self) -> int:
        return len(self.lasting)

    def columns(self, time_s: F64, current: F64) -> F64:
        """Mean current, its change over the window's time, and speed; shape (w, 3)."""
        mean = _summed((current[1:] + current[:-1]) / 2 * np.diff(time_s), self.edges) / self.lasting
        return np.column_stack([mean, np.diff(current[self.edges]) / self.lasting, self.speed])


def _summed(values: F64, edges: NDArray[np.intp]) -> F64:
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(np.diff(total[edges]))


def left(columns: F64, known: F64) -> tuple[F64, float]:
    """Coefficients, shape (m,), and the rms that a least-squares fit leaves, as a share of what there is."""
    found, _ = least_squares(columns, known)
    size = float(np.sqrt(np.mean(known**2)))
    return found, float(np.sqrt(np.mean((known - columns @ found) ** 2))) / max(size, 1e-300)
