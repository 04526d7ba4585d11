"""What a capture's numbers say about its units: a motor of 4,000 A is more often one of 4 A in milliamperes.

Downwards less can be told. In kiloamperes a motor is one of a thousandth of its size in every respect that a capture
shows (R, L, 1/J and 1/B all a thousandfold), and there are such motors: only what none can be is remarked upon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servo_daemon.captures.capture.model import Capture, capture_error
from servo_daemon.captures.meaning.finding import has_time, mend
from servo_daemon.captures.meaning.signs import no_sign_of_speed, no_sign_of_voltage, turned_voltage
from servo_daemon.captures.meaning.windows import travelled
from servo_daemon.column_names import RPM
from servo_daemon.numerics import least_squares
from servo_daemon.samples import F64

#: Sampling periods of a servo drive, s: slower shows no motor's dynamics, faster is no drive's log.
_SLOWEST_S, _FASTEST_S = 0.25, 1e-6
#: Means over this time, s, and at least so many samples: the winding has settled within them.
_MEAN_S, _MEAN_SAMPLES = 0.02, 8
#: What the voltages of a lag, of an inductance and of brushes are off by, as a share of the whole.
_STATIC = 0.03
#: A coefficient this many standard deviations below zero has the wrong sign.
_SIGMA = 5.0
#: Below this share of its largest value a channel does not move.
_STILL = 1e-9


@dataclass(frozen=True, slots=True)
class _Range:
    """Of the 99th percentile of the modulus; beyond `largest` (mended by `scale`), or below `smallest`, the hint is
    given."""

    column: str
    largest: float
    hint: str
    scale: float
    smallest: float = 0.0
    hint_small: str = ""


#: The smallest motors (3 mm, 1.5 V) run without load at 0.1 V and, wound for 24 V, at a milliampere.
_RANGES = (
    _Range("voltage_V", 1500.0, "is it in millivolts?", 1e-3, 0.05, "is it in kilovolts, or a duty cycle?"),
    _Range("current_A", 1000.0, "is it in milliamperes?", 1e-3, 3e-4, "is it in kiloamperes?"),
    _Range("velocity_rad_s", 12000.0, "is it in rpm, degrees or counts a second?", RPM),
)
#: Resistances that windings have, Ω, with a factor of three to spare: starter motors 3 mΩ, millimetre motors 1 kΩ.
_LEAST_R, _MOST_R = 1e-3, 3e3
#: Fastest a shaft turns, rad/s (115,000 rpm): an angle that runs faster is in degrees or counts.
_FASTEST_SHAFT = 12000.0

#: Windows in which a speed is looked at for how fast it changes; and what it never gains half of the time, rad/s²: the
#: largest accelerations in makers' catalogues, of small ironless motors at their stall torque, are 5e5.
_SPEEDS, _MOST_ACCELERATION = 40, 1e6


def check_time_unit(capture: Capture) -> None:
    """A servo drive's sampling period must be possible.

    Raises:
        CaptureError: it is not; the message says which unit it probably is.
    """
    period = capture.sample_period_s
    if period > _SLOWEST_S:
        raise capture_error(
            capture.path,
            f"the median distance of two samples is {period:g} s, too slow to show a motor's dynamics: "
            f"{_why_so_slow(capture, period)}",
            column="time_s",
        )
    if period < _FASTEST_S:
        raise capture_error(
            capture.path,
            f"the median distance of two samples is {period:g} s: time_s must be in seconds",
            column="time_s",
        )


def _why_so_slow(capture: Capture, period: float) -> str:
    """What a period beyond a motor's dynamics may be, and what is to be done."""
    record = f"record at {1.0 / _SLOWEST_S:g} Hz or more while the voltage changes"
    if {"voltage_V", "current_A"} <= {*capture.channels} and travelled(capture) is not None:
        record = f"of readings at steady speeds least squares of v = R i + K ω give R and K; for the rest {record}"
    if not has_time(capture):
        return f"--rate is in Hz; {record}"
    unit, scale = ("milliseconds", 1e-3) if period < 100.0 else ("microseconds", 1e-6)
    told = mend(capture, "time_s", {"scale": scale})
    return f"is it in {unit}? time_s must be in seconds; {told}; if it is seconds, {record}"


def plausibility_notes(capture: Capture) -> tuple[str, ...]:
    """What should be checked before the result is believed, one sentence each; empty where nothing is odd."""
    if time := _time(capture):
        return (*time, *_still(capture))  # with such a time no size means anything
    notes = [n for r in _RANGES if (n := _out_of_range(r, capture)) is not None]
    if capture.position_rad is not None and capture.axis == "rotary":
        speed = np.diff(capture.position_rad) / np.diff(capture.time_s)
        fast = float(np.percentile(np.abs(speed), 90.0))
        if fast > _FASTEST_SHAFT:
            told = mend(capture, "position_rad", {"scale": math.pi / 180})
            notes.append(f"column position_rad moves at {fast:,.0f} rad/s: is it in degrees or counts? {told}")
    notes += [*_still(capture), *_balance(capture)]
    return tuple(notes)


def _time(capture: Capture) -> list[str]:
    """A time a thousand times too fast: milliseconds that are called microseconds.

    Speeds say nothing, for a slow shaft turns a thousand times faster in a fast one; accelerations do, whose factor is
    a million.
    """
    n = (len(capture) - 1) // _SPEEDS
    if n == 0 or capture.axis != "rotary" or (travel := travelled(capture)) is None:
        return []
    edges = n * np.arange(_SPEEDS + 1)
    lasting = np.diff(capture.time_s[edges])
    speed = np.add.reduceat(travel, edges[:-1])[:_SPEEDS] / lasting
    gained = float(np.median(np.abs(np.diff(speed)) / lasting[1:]))
    if gained < _MOST_ACCELERATION:
        return []
    told = mend(capture, "time_s", {"scale": 1e3}) if has_time(capture) else "mend: a lower --rate"
    return [f"the shaft gains {gained:,.2g} rad/s in a second: is time_s in milliseconds that are called µs? {told}"]


def _out_of_range(limits: _Range, capture: Capture) -> str | None:
    values: F64 | None = getattr(capture, limits.column)
    if values is None:
        return None
    size = float(np.percentile(np.abs(values), 99.0))
    if size > limits.largest:
        told = mend(capture, limits.column, {"scale": limits.scale})
        return f"column {limits.column} reaches {size:,.0f}: {limits.hint} {told}"
    if 0.0 < size < limits.smallest:
        return f"column {limits.column} reaches no more than {size:.2g}: {limits.hint_small}"
    return None


def _still(capture: Capture) -> list[str]:
    """Channels that never change, and what is left to learn from."""
    still = []
    for name in capture.channels:
        values = getattr(capture, name)
        if name != "temperature_C" and float(np.ptp(values)) <= _STILL * float(np.max(np.abs(values), initial=0.0)):
            still.append(name)
    moving = {*capture.channels} - {*still}
    return [f"column {name} never changes: {_told_all_the_same(name, moving)}" for name in still]


def _told_all_the_same(still: str, moving: set[str]) -> str:
    """What a capture tells although a channel stands.

    Args:
        moving: channels that change.
    """
    motion = bool(moving & {"position_rad", "velocity_rad_s"})
    if still in ("position_rad", "velocity_rad_s") and {"voltage_V", "current_A"} <= moving and not motion:
        return "the shaft is held, from which R and L show, and nothing of K, J and B"
    if still == "voltage_V" and motion:
        return "what shows is the answer to one step, its gain and its time constant"
    if still == "current_A" and motion and "voltage_V" in moving:
        return "it is taken for a sensor that is not there"
    return "it tells nothing about the dynamics"


def _balance(capture: Capture) -> list[str]:
    """Signs and sizes that do not fit together: v = R i + K ω has positive coefficients, and R is that of a winding."""
    v, i, x = capture.voltage_V, capture.current_A, capture.position_rad
    if v is None or i is None or (x is None and capture.velocity_rad_s is None):
        return []
    m = max(_MEAN_SAMPLES, round(_MEAN_S / capture.sample_period_s))
    n = (len(capture) - 1) // m
    if n < 10:
        return []
    mean_v, mean_i = (a[: n * m].reshape(n, m).mean(axis=1) for a in (v, i))
    if x is not None:
        speed = np.diff(x[: n * m + 1 : m]) / np.diff(capture.time_s[: n * m + 1 : m])
    else:
        assert capture.velocity_rad_s is not None
        speed = capture.velocity_rad_s[: n * m].reshape(n, m).mean(axis=1)
    A = np.column_stack([mean_i, speed])
    found, rank = least_squares(A, mean_v)
    if rank < 2:
        return []
    left = float(np.mean((mean_v - A @ found) ** 2))
    # The balance at rest is not quite that of a motion: where current and speed go together, that matters most.
    std = np.sqrt((left + _STATIC**2 * float(mean_v @ mean_v)) * np.diag(np.linalg.inv(A.T @ A)))
    names = ("current_A", "position_rad" if x is not None else "velocity_rad_s")
    unsigned = no_sign_of_speed(capture)
    against = [value < -_SIGMA * s for value, s in zip(found, std, strict=True)]
    of_voltage = no_sign_of_voltage(capture) or (turned_voltage(capture) if all(against) else None)
    if any(against) and of_voltage:
        return [f"column {of_voltage}"]
    notes = [
        f"column {unsigned}"
        if unsigned and symbol == "K"
        else f"column {name} counts against voltage_V (v = R i + K ω has {symbol} = {value:.3g}): is its sign turned? "
        f"{mend(capture, name, {'scale': -1.0})}"
        for name, symbol, value, s in zip(names, ("R", "K"), found, std, strict=True)
        if value < -_SIGMA * s
    ]
    R, spread = float(found[0]), float(std[0])
    if R - _SIGMA * spread > _MOST_R:
        notes.append(f"voltage_V over current_A is {R:,.0f} Ω: is a current in kA, or a voltage in mV?")
    elif 0.0 < R + _SIGMA * spread < _LEAST_R:
        notes.append(f"voltage_V over current_A is {R:.1g} Ω: is a current in mA, or a voltage in kV?")
    return notes
