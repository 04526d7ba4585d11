"""Units that give themselves away: whole numbers where a physical value has none, two columns of the same motion that
differ by a unit's factor, steps of an encoder in degrees or turns, a voltage beyond the supply."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.finding import Finding, column_name, mend
from servo_daemon.captures.meaning.windows import FEWEST, Windows, left, travelled
from servo_daemon.column_names import RPM, TURN
from servo_daemon.samples import F64

#: Whole numbers of fewer different values may be a physical value: steps of 0, 6 and 12 V.
_DIFFERENT = 12
#: Whole amperes, volts and radians a second up to here may be rounded ones; beyond, another unit.
_LARGEST = {"voltage_V": 60.0, "current_A": 60.0, "velocity_rad_s": 0.0}
#: Ends of the ranges of PWM registers and of a duty in percent.
_CODES = (100.0, 255.0, 256.0, 511.0, 512.0, 885.0, 999.0, 1000.0, 1023.0, 1024.0, 2047.0, 2048.0, 4095.0, 32767.0)
#: Middles of converters of 8 to 16 bits; a current's median without a load is so near.
_MIDDLES, _NEAR_MIDDLE = (128.0, 512.0, 2048.0, 8192.0, 32768.0), 0.1
#: Share of the voltage that the winding's balance leaves, where it closes.
_CLOSES = 0.25
#: Whole numbers of a voltage beyond this are millivolts: registers of servo drives' PWM have ten bits or eight.
_MOST_CODE = 1024.0
#: A voltage beyond the limit that the config tells, by more than the margin of a fresh supply.
_BEYOND = 1.3
#: rad (or rad/s) in a unit.
_ANGLES = {"degrees": math.pi / 180, "turns": TURN}
_SPEEDS = {"rpm": RPM, "degrees a second": math.pi / 180, "turns a second": TURN}
#: A ratio of two columns is a unit's factor if it comes so near.
_RATIO = 0.03
#: Fewer samples tell no factor.
_FEW = 50
#: Of no unit, but larger than what a tachometer's scale is off by.
_APART = 1.5
#: Angle and integral of the speed go together if so little (power) stands apart.
_TOGETHER = 0.05
#: An encoder's step is taken for one of 360/2^n degrees or 1/2^n turns if it comes so near.
_STEP = 2e-4


def unit_findings(capture: Capture, limit_V: float | None) -> list[Finding]:
    """What is in another unit than its name says, as far as the data tell.

    Args:
        limit_V: the drive's supply as the config has it; None: not known.
    """
    return [
        *_whole_position(capture),
        *_speed_against_position(capture),
        *_encoder_step(capture),
        *_whole(capture, "velocity_rad_s", RPM, "rpm (or counts a second)"),
        *_voltage(capture, limit_V),
        *(
            _counts_about_a_zero(capture)
            or _whole(capture, "current_A", 1e-3, "milliamperes (or counts of a converter)")
        ),
    ]


def full_scale(top: float) -> float:
    """What a PWM code reads at full scale, by the largest value that is seen: the next end of a range, else itself."""
    return next((code for code in _CODES if code >= top), top)


def _is_whole(values: F64) -> bool:
    return bool(np.all(values == np.round(values))) and len(np.unique(values)) >= _DIFFERENT


def _whole_position(capture: Capture) -> list[Finding]:
    x = capture.position_rad
    if x is None or not _is_whole(x):
        return []
    name = column_name(capture, "position_rad")
    text = f"column {name} holds whole numbers only ({np.min(x):,.0f} … {np.max(x):,.0f}): counts of an encoder"
    if capture.axis == "linear":
        return [Finding("position_rad", f"{text}. {mend(capture, 'position_rad', {'scale': 1e-6})} and your scale")]
    told = mend(capture, "position_rad", {}, target="position_counts")
    return [Finding("position_rad", f"{text}. {told}")]


def _whole(capture: Capture, field: str, scale: float, unit: str) -> list[Finding]:
    values = getattr(capture, field)
    if values is None or not _is_whole(values) or float(np.max(np.abs(values))) <= _LARGEST[field]:
        return []
    name, top = column_name(capture, field), float(np.max(np.abs(values)))
    text = f"column {name} holds whole numbers only, up to {top:,.0f}: {unit}"
    return [Finding(field, f"{text}. {mend(capture, field, {'scale': scale})}")]


def _counts_about_a_zero(capture: Capture) -> list[Finding]:
    """A current that is the reading of a converter, whose zero is in its middle."""
    i = capture.current_A
    if i is None or not _is_whole(i) or float(np.min(i)) <= 0.0 or (zero := _zero_of(capture, i)) is None:
        return []
    text = (
        f"column current_A holds whole numbers only, {np.min(i):,.0f} … {np.max(i):,.0f}: counts of a converter with "
        f"their zero at about {zero:,.0f}; it is left out"
    )
    told = mend(capture, "current_A", {"zero": zero, "scale": 0.01})
    return [Finding("current_A", f"{text}. {told} and for 0.01 your sensor's amperes a count", "column")]


def _zero_of(capture: Capture, i: F64) -> float | None:
    """The reading without a current, by the winding's balance where that closes, else by the middle of a converter's
    range; None: it may be 0."""
    if capture.voltage_V is not None and (travel := travelled(capture)) is not None:
        w = Windows.of(capture.time_s, capture.voltage_V, travel)
        if len(w) >= FEWEST:
            columns = np.column_stack([w.columns(capture.time_s, i - i.mean()), np.ones(len(w))])
            (R, _, _, rest), share = left(columns, w.voltage)
            if R > 0.0 and share < _CLOSES:
                zero = float(np.round(i.mean() - rest / R))
                return zero if zero > 0.5 * np.min(i) else None
    middle = next((m for m in _MIDDLES if abs(np.median(i) / m - 1.0) < _NEAR_MIDDLE), None)
    return middle if middle is not None and np.min(i) < middle < np.max(i) else None


def _voltage(capture: Capture, limit_V: float | None) -> list[Finding]:
    v = capture.voltage_V
    if v is None:
        return []
    top = float(np.max(np.abs(v)))
    whole = _is_whole(v)
    if whole and top in _CODES:
        text = f"column voltage_V holds whole numbers up to {top:g}: a PWM code, not volts"
        return [Finding("voltage_V", f"{text}. {_by_supply(capture, top, limit_V)}")]
    if whole and top > _LARGEST["voltage_V"]:
        code = top <= _MOST_CODE
        text = f"column voltage_V holds whole numbers only, up to {top:,.0f}: {'a PWM code' if code else 'millivolts'}"
        told = mend(capture, "voltage_V", {"scale": 1e-3})
        if code:
            told = _by_supply(capture, full_scale(top), limit_V)
        return [Finding("voltage_V", f"{text}. {told}")]
    if limit_V is not None and top > _BEYOND * limit_V:
        text = f"column voltage_V reaches {top:,.4g}, more than the drive's {limit_V:g} V: a code, or another unit"
        return [Finding("voltage_V", f"{text}. {_by_supply(capture, top, limit_V)}")]
    if top == 1.0 and np.count_nonzero(np.abs(v) == 1.0) > 1:
        text = "column voltage_V ends at 1 exactly: a duty cycle, not volts"
        return [Finding("voltage_V", f"{text}. {_by_supply(capture, 1.0, limit_V)}")]
    return []


def _by_supply(capture: Capture, full: float, limit_V: float | None) -> str:
    supply = limit_V or 12.0
    told = mend(capture, "voltage_V", {"scale": supply / full})
    return told if limit_V else f"{told}  (of a supply of 12 V; yours / {full:g})"


def _speed_against_position(capture: Capture) -> list[Finding]:
    """Both columns of one motion: their ratio is 1, or a unit's factor."""
    x, w = capture.position_rad, capture.velocity_rad_s
    if x is None or w is None or len(x) < _FEW or (ratio := common_factor(x, w, np.diff(capture.time_s))) is None:
        return []
    name_x, name_w = column_name(capture, "position_rad"), column_name(capture, "velocity_rad_s")
    if abs(ratio + 1.0) < _RATIO:
        text = f"columns {name_x} and {name_w} count against each other"
        return [Finding("velocity_rad_s", f"{text}. {mend(capture, 'velocity_rad_s', {'scale': -1.0})}")]
    for sign in (1.0, -1.0):
        for unit, factor in _SPEEDS.items():
            if abs(sign * ratio / factor - 1.0) < _RATIO:
                text = f"column {name_w} is {1 / factor:.4g} times the slope of {name_x}: {unit}, not rad/s"
                told = mend(capture, "velocity_rad_s", {"scale": sign * factor})
                return [Finding("velocity_rad_s", f"{text}. {told}")]
        for unit, factor in _ANGLES.items():
            if abs(sign * ratio * factor - 1.0) < _RATIO:
                text = f"column {name_x} is {1 / factor:.4g} times the integral of {name_w}: {unit}, not rad"
                return [Finding("position_rad", f"{text}. {mend(capture, 'position_rad', {'scale': sign * factor})}")]
    text = f"column {name_x} goes with the integral of {name_w}, but is {ratio:.4g} times as large"
    why = "the unit of one of them, or of both, is another one, or a gear is between"
    return [Finding("position_rad", f"{text}: {why}")] if not 1 / _APART < abs(ratio) < _APART else []


def common_factor(x: F64, w: F64, h: F64) -> float | None:
    """Angle over the speed's integral, if they go together; None: they do not, or nothing moves.

    Args:
        x, w: shape (n,).
        h: shape (n − 1,), s between them.
    """
    way = np.cumsum((w[1:] + w[:-1]) / 2 * h)
    turned = x[1:] - x[0]
    way, turned = way - way.mean(), turned - turned.mean()
    size, whole = float(way @ way), float(turned @ turned)
    if size == 0.0 or whole == 0.0:
        return None
    ratio = float(way @ turned) / size
    return ratio if float(np.sum((turned - ratio * way) ** 2)) < _TOGETHER * whole else None


def _encoder_step(capture: Capture) -> list[Finding]:
    """The smallest step of an encoder of 2^n lines: 2π/2^n in rad, 360/2^n in degrees, 1/2^n in turns."""
    x = capture.position_rad
    if x is None or capture.axis == "linear" or _is_whole(x):
        return []
    step = _smallest_step(x)
    if step is None:
        return []
    for unit, full in (("degrees", 360.0), ("turns", 1.0)):
        n = math.log2(full / step)
        if 6.0 <= round(n) <= 24.0 and abs(2.0 ** (n - round(n)) - 1.0) < _STEP:
            text = f"column position_rad moves in steps of {full:g}/{2 ** round(n)}: {unit}, not rad"
            return [Finding("position_rad", f"{text}. {mend(capture, 'position_rad', {'scale': _ANGLES[unit]})}")]
    return []


def _smallest_step(values: F64) -> float | None:
    """Of a value that has one: all its differences are multiples of it; None: it has none."""
    different = np.unique(values)
    if len(different) < 2 * _DIFFERENT or len(different) > 0.9 * len(values):
        return None
    gaps = np.diff(different)
    small = float(np.min(gaps))
    close = gaps[gaps < 1.5 * small]
    if len(close) < len(gaps) / 4:
        return None
    step = float(np.mean(close))
    counts = np.round((different - different[0]) / step)
    step = float(different[-1] - different[0]) / float(counts[-1])
    off = np.abs((different - different[0]) / step - np.round((different - different[0]) / step))
    return step if float(np.max(off)) < 0.2 else None
