"""The moment of a drive's current against that of its angle, where the current drives the motion.

A current that is δ late against the angle adds −J δ dα/dt to the balance of torques (α the acceleration). Of motion
about one frequency dα/dt is −Ω² ω, Ω² = ⟨α²⟩/⟨ω²⟩: it is a B that is J Ω² δ too large, and no amount of data tells the
two apart. What is known of δ moves the motion; the rest is in B's standard deviation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64
from servo_daemon.signal_meaning import CONTROL_PERIOD_S, SignalMeaning

#: 1 σ of a filter's delay, share of it: VESC's goes with its control rate, 20 to 30 kHz (foc_f_zv; 25 by default).
_DELAY = 0.15


def moment_std_s(meaning: SignalMeaning) -> float:
    """1 σ of the time between current and angle, s, beside what `current_late_s` says: a control period, for one may be
    of the period's beginning and the other of its end."""
    return math.hypot(CONTROL_PERIOD_S, _DELAY * meaning.current_late_s)


def earlier(time_s: F64, values: F64, by_s: float) -> F64:
    """Values, shape (n,), as they were so long before each sample, on the line from the sample before it; the first
    one stays."""
    return np.asarray(values - by_s * np.concatenate([[0.0], np.diff(values) / np.diff(time_s)]))


def unfiltered(time_s: F64, current: F64, late_s: float) -> F64:
    """The current that a filter of the first order shows so late, both shape (n,)."""
    return np.asarray(current + late_s * np.gradient(current, time_s))


def motion_squares(time_s: F64, position: F64 | None, speed: F64 | None, at: NDArray[np.intp]) -> F64 | None:
    """⟨ω²⟩ and ⟨α²⟩ from the samples `at`, so far apart that an encoder's steps are no acceleration; None: there are
    too few, or one is no number.

    Args:
        position, speed: shape (n,), rad and rad/s; the position is taken where there is one.
    """
    moment = time_s[at]
    if position is not None:
        omega, moment = np.diff(position[at]) / np.diff(moment), 0.5 * (moment[1:] + moment[:-1])
    elif speed is not None:
        omega = speed[at]
    else:
        return None
    if len(omega) < 2:
        return None
    found = np.array([np.mean(omega**2), np.mean((np.diff(omega) / np.diff(moment)) ** 2)])
    return found if np.isfinite(found).all() else None
