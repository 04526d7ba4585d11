"""An effort that counts against the motion: a body with a negative mass, or a friction that drives."""

from __future__ import annotations

import numpy as np

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.currents import lasts_both_ways, never_turns
from servo_daemon.captures.meaning.finding import Finding, column_name, mend
from servo_daemon.captures.meaning.windows import FEWEST, travelled
from servo_daemon.numerics import least_squares
from servo_daemon.samples import F64

#: Windows for a speed and its change, s, and at least so many intervals.
_WINDOW_S, _LEAST = 0.03, 6
#: Parts of a capture that are looked at one by one; a coefficient is negative if all of them say so, and their mean by
#: so many standard errors.
_PARTS, _SIGMA = 6, 4.0
#: Both directions of motion are seen, each in this share of the windows that move.
_EITHER_WAY = 0.15
#: What a sensor shows, or a driver is told, without a direction.
_MODULUS = ("current_A", "voltage_V")


def sign_findings(capture: Capture) -> list[Finding]:
    """The only effort of a capture (a torque, a current without a voltage, a voltage without a current) counts against
    the motion: friction comes out negative, and no inertia speaks against it."""
    field = _effort(capture)
    travel = travelled(capture)
    if field is None or travel is None:
        return []
    rows = _rows(capture, getattr(capture, field), travel)
    if len(rows) < max(FEWEST, 10 * _PARTS):
        return []
    if min(np.mean(rows[:, 2] > 0.0), np.mean(rows[:, 2] < 0.0)) < _EITHER_WAY:
        return []  # a load that is let down drives all the time
    parts = np.array_split(rows, _PARTS)
    found = np.array([least_squares(p[:, 1:], p[:, 0])[0][:2] for p in parts])
    mean, error = found.mean(axis=0), found.std(axis=0, ddof=1) / np.sqrt(_PARTS)
    drives = np.max(found[:, 1]) < 0.0 and mean[1] < -_SIGMA * error[1]
    if not drives or mean[0] > error[0]:
        return []
    name, motion = column_name(capture, field), "position_rad" if capture.position_rad is not None else "velocity_rad_s"
    text = (
        f"column {name} counts against {column_name(capture, motion)}: friction would drive it. "
        f"{mend(capture, field, {'scale': -1.0})}"
    )
    return [Finding(field, text)]


def takes_no_power(capture: Capture, field: str) -> bool:
    """Whether a channel runs against the effort that it answers, on the whole: a motor with a turned current would feed
    its supply, one with a turned angle would drive what pushes it. A load that is let down gives back less than lifting
    it took. Of an effort of one sign nobody knows: it may be a modulus.

    Args:
        field: a channel that answers: a current beside a voltage, or the motion.
    """
    effort = next(v for v in (capture.voltage_V, capture.current_A, capture.torque_Nm) if v is not None)
    if field == "current_A" and capture.voltage_V is not None and capture.current_A is not None:
        return float(capture.voltage_V @ capture.current_A) < 0.0
    travel = travelled(capture)
    if travel is None or shows_no_sign(capture) is not None:
        return False
    return float(((effort[1:] + effort[:-1]) / 2) @ travel) < 0.0


def shows_no_sign(capture: Capture) -> str | None:
    """Which column it is, where all that is measured of the effort is a current or a voltage of one sign, as a load
    makes it that always pulls, or |i|, |v|."""
    field = _effort(capture)
    return field if field in _MODULUS and never_turns(getattr(capture, field)) else None


def no_sign_of_speed(capture: Capture) -> str | None:
    """What is said of a speed that never goes below zero under a voltage that lasts in both directions; None: there is
    none, or an angle beside it."""
    v, w = capture.voltage_V, capture.velocity_rad_s
    if v is None or w is None or capture.position_rad is not None or not lasts_both_ways(v):
        return None
    if not never_turns(w) or w.mean() <= 0.0:
        return None
    return (
        f"{column_name(capture, 'velocity_rad_s')} never goes below zero although voltage_V does: a sensor that shows "
        "|ω|, not its sign. mend: measure the angle, or use a part of the capture in which it turns one way"
    )


def no_sign_of_current(capture: Capture) -> str | None:
    """What is said of a current that never goes below zero under a voltage that lasts in both directions, where the
    balance does not tell its signs; None: it does, or there is none."""
    v, i = capture.voltage_V, capture.current_A
    if v is None or i is None or not lasts_both_ways(v) or not never_turns(i):
        return None
    return (
        "current_A never goes below zero although voltage_V does: a sensor that shows |i|, not its sign. "
        "mend: measure the angle, from which its sign follows, or a sensor for both directions"
    )


def turned_voltage(capture: Capture) -> str | None:
    """What is said where current and motion go together and both against the voltage; None: they do not."""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or i is None or travel is None or float(v @ i) >= 0.0:
        return None
    if never_turns(i) or no_sign_of_speed(capture):
        return None
    if float(((v[1:] + v[:-1]) / 2) @ travel) >= 0.0 or not lasts_both_ways(v):
        return None
    text = "voltage_V counts against current and motion: its sign is turned"
    return f"{text}. {mend(capture, 'voltage_V', {'scale': -1.0})}"


def no_sign_of_voltage(capture: Capture) -> str | None:
    """What is said of a voltage that never goes below zero although current and motion last in both directions; None:
    it does, or they do not. (A drive that brakes one way turns the current alone.)"""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or i is None or travel is None or not never_turns(v) or v.mean() <= 0.0:
        return None
    if not lasts_both_ways(i) or not lasts_both_ways(travel):
        return None
    return (
        "voltage_V never goes below zero although current and motion do: |v|, or a duty without its direction. "
        f"{mend(capture, 'voltage_V', {'direction': 'dir'})}  and for dir your column of the direction (0 or 1)"
    )


def _effort(capture: Capture) -> str | None:
    if capture.torque_Nm is not None:
        return "torque_Nm"
    if capture.voltage_V is not None:
        return "voltage_V" if capture.current_A is None else None
    return "current_A" if capture.current_A is not None else None


def _rows(capture: Capture, effort: F64, travel: F64) -> F64:
    """Effort, acceleration, friction (dry and viscous in one), one and the angle's harmonics, of windows; shape
    (w, 6)."""
    m = max(_LEAST, round(_WINDOW_S / capture.sample_period_s))
    edges = np.arange(0, len(effort), m)
    if len(edges) < 4:
        return np.empty((0, 6))
    h = np.diff(capture.time_s)

    def mean(values: F64) -> F64:
        total = np.concatenate([[0.0], np.cumsum(values * h)])
        return np.asarray(np.diff(total[edges]) / np.diff(capture.time_s[edges]))

    speed, pushed = mean(travel / h), mean((effort[1:] + effort[:-1]) / 2)
    middle = mean((capture.time_s[1:] + capture.time_s[:-1]) / 2)
    angle = np.interp(middle, capture.time_s, np.concatenate([[0.0], np.cumsum(travel)]))
    gained = np.gradient(speed, middle)
    size = float(np.sqrt(np.mean(speed**2))) or 1.0
    friction = np.tanh(speed / (0.1 * size)) + speed / size
    harmonics = (np.sin(angle), np.cos(angle)) if capture.axis == "rotary" else (angle, np.zeros_like(angle))
    table = np.column_stack([pushed, gained, friction, np.ones_like(speed), *harmonics])
    return table[np.abs(speed) > 0.05 * size]
