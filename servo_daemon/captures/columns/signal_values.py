"""What the values of a signal say of its unit and of where it wraps, beyond its name."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from servo_daemon.column_names import TURN
from servo_daemon.numerics import sample_period
from servo_daemon.samples import F64

#: Seconds since 1970 between 2001 and 2096: a larger number is the same in ms, µs or ns.
_EPOCH = (1e9, 4e9)
#: Sampling periods of a servo drive, s (see `plausible.py`).
_SLOWEST_S, _FASTEST_S = 0.25, 1e-6
#: A value of whole numbers that reaches this, and has so many different ones, is no longer in volts, amperes, radians.
_WHOLE_FROM = {"voltage_V": 60.0, "current_A": 20.0, "position_rad": 10.0, "velocity_rad_s": 10.0, "torque_Nm": 10.0}
DIFFERENT = 10
#: A supply sags by less than this share under a motor that it can drive.
_SAG = 0.3
#: A step over half of a wrap is a wrap if what is left of all steps is below this share of it.
_CLEAR = 0.3


class Values:
    """A signal's values, shape (n,), with what is asked of them again and again."""

    def __init__(self, values: F64) -> None:
        self.finite = values[np.isfinite(values)]

    @cached_property
    def whole(self) -> bool:
        """Whether all values are whole numbers."""
        return bool(np.all(self.finite == np.rint(self.finite)))

    @property
    def varies(self) -> bool:
        return bool(np.ptp(self.finite) > 0.0) if self.finite.size else False

    @property
    def stands(self) -> bool:
        """Whether it changes by no more than a supply does under its load."""
        return bool(np.ptp(self.finite) < _SAG * abs(np.mean(self.finite))) if self.finite.size else True

    @cached_property
    def largest(self) -> float:
        return float(np.max(np.abs(self.finite), initial=0.0))


def time_scale(values: Values) -> float | None:
    """Factor to seconds of a time without a unit; None: it is not in seconds, and nobody knows in what."""
    if len(values.finite) < 2:
        return 1.0
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        if _EPOCH[0] <= float(values.finite[0]) * scale < _EPOCH[1]:
            return scale
    period = sample_period(values.finite)
    return 1.0 if period <= _SLOWEST_S else None


def unit_is_open(column: str, values: Values) -> bool:
    """Whether a signal without a unit shows by whole numbers that it is not in the SI unit of the column."""
    from_ = _WHOLE_FROM.get(column)
    if from_ is None or not values.whole or values.largest < from_:
        return False
    return len(np.unique(values.finite)) >= DIFFERENT


def exceeds_one(values: Values, scale: float) -> bool:
    """Whether a duty cycle is more than the whole supply: then it has another full scale than 1."""
    return values.largest * scale > 1.0 + 1e-6


def duty_needs_scale(values: Values, scale: float) -> bool:
    """Whether a duty cycle is not plainly one between −1 and 1: then its full scale must be told."""
    return exceeds_one(values, scale) or (scale == 1.0 and values.whole)


def wrap_of(column: str, unit: float, values: Values) -> float | None:
    """Where a signal wraps, in the unit it has as a column (for counts: counts); None: it does not.

    Args:
        column: `time_s`, `position_rad` or `position_counts`.
        unit: factor to the column's unit; of counts, counts in a turn.
    """
    if column == "time_s":
        around = [2.0**32 * unit] + ([86400.0] if unit == 1e-3 else [])  # micros(), millis(); VESC's ms_today
        own = values.finite * unit
    elif column == "position_rad":
        around, own = [TURN], values.finite * unit
    else:
        around, own = [unit, 2.0**16, 2.0**32], values.finite
    return next((wrap for wrap in around if _wraps(own, wrap, rising=column == "time_s")), None)


def _wraps(values: F64, wrap: float, *, rising: bool) -> bool:
    if len(values) < 2 or float(np.ptp(values)) > wrap * (1.0 + 1e-9):
        return False
    steps = np.diff(values)
    jumps = steps < -wrap / 2 if rising else np.abs(steps) > wrap / 2
    if not jumps.any():
        return False
    left = steps - wrap * np.rint(steps / wrap)
    return bool(np.max(np.abs(left)) < _CLEAR * wrap) and (not rising or float(left.min()) >= 0.0)


def jumps(angle_rad: F64) -> bool:
    """Whether an angle goes more than half a turn from one row to the next, shape (n,)."""
    return bool(np.max(np.abs(np.diff(angle_rad)), initial=0.0) > math.pi)


def turns_ratio(time_s: F64, angle_rad: F64, electrical_rad_s: F64) -> float | None:
    """How many electrical turns make one of an angle: pole pairs, where the angle is the shaft's.

    Args:
        time_s, angle_rad, electrical_rad_s: shape (n,); the angle wraps at a turn.

    Returns:
        A whole number above 1; None: the angle stands still or turns as the electrical one.
    """
    steps = np.diff(angle_rad)
    steps -= TURN * np.rint(steps / TURN)
    turned = (electrical_rad_s[1:] + electrical_rad_s[:-1]) / 2.0 * np.diff(time_s)
    clear = np.abs(steps) < math.pi / 2  # faster ones may have gone the other way round
    along = float(steps[clear] @ turned[clear])
    if not clear.any() or along == 0.0:
        return None
    ratio = abs(along) / float(steps[clear] @ steps[clear])
    return float(round(ratio)) if round(ratio) > 1 and abs(ratio / round(ratio) - 1.0) < 0.2 else None
