"""Currents that are not the motor's: |i|, or what the supply delivers."""

from __future__ import annotations

import numpy as np

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.finding import Finding, mend
from servo_daemon.captures.meaning.restored import signs_of
from servo_daemon.captures.meaning.windows import FEWEST, Windows, left, travelled
from servo_daemon.samples import F64

#: "Never": but for noise of this share of the largest.
_NEVER = 0.02
#: A voltage changes sign where each sign lasts for this share of the samples.
_BOTH = 0.1
#: The other meaning must leave less than this share (rms) of what the column as it stands leaves of the voltage ...
_CLEARLY = 0.5
#: ... and so much of the voltage at the most.
_CLOSES = 0.25
#: As it stands the column leaves at least so much of the voltage: less is what an encoder's step or a delay leave.
_OPEN = 0.01
#: Samples that are looked at.
_MOST = 20_000
#: Windows below this share of the largest voltage are not looked at for the supply's current.
_LEAST_DUTY = 0.15


def current_findings(capture: Capture) -> list[Finding]:
    """|i|, or the supply's current, of captures with voltage and current; empty where it is the motor's."""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or i is None:
        return []
    if travel is None:  # of a blocked rotor, or the balance does not close
        travel = np.zeros(len(v) - 1)
    v, i, time_s, travel = v[:_MOST], i[:_MOST], capture.time_s[:_MOST], travel[: _MOST - 1]
    windows = Windows.of(time_s, v, travel)
    if len(windows) < FEWEST:
        return []
    # A sensor's offset can keep a current on one side, too: as it stands means with one.
    share = left(_with_offset(windows.columns(time_s, i)), windows.voltage)[1]
    if share < _OPEN:
        return []
    supply = _as_supply(windows, time_s, v, i)
    modulus = _as_modulus(time_s, v, i, travel)
    if min(supply[0] / max(supply[1], 1e-12), modulus / share) > _CLEARLY:
        return []
    if modulus / share <= supply[0] / max(supply[1], 1e-12):
        what = "current_A never goes below zero although voltage_V does: a sensor that shows |i|, not its sign"
        keys: dict[str, object] = {"shows": "magnitude"}
    else:
        what = (
            "voltage, current and motion fit together only if current_A is what the supply delivers "
            "(duty × the motor's current)"
        )
        keys = {"shows": "supply", "supply_V": _supply_guess(capture)}
    told = f"{what}; it is left out. {mend(capture, 'current_A', keys)}"
    if keys["shows"] == "supply":
        told += f" and your supply's voltage for {keys['supply_V']:g}"
    return [Finding("current_A", told, "column")]


def _as_modulus(time_s: F64, v: F64, i: F64, travel: F64) -> float:
    """The share of the voltage that stays open with signs for the current; infinite where it has its own."""
    if not lasts_both_ways(v) or not never_turns(i):
        return np.inf
    share = signs_of(time_s, v, np.abs(i), travel)[1]
    return share if share < _CLOSES else np.inf


def lasts_both_ways(values: F64) -> bool:
    """Whether a signal has either sign for a part of the samples that counts."""
    clear = np.abs(values) > _NEVER * float(np.percentile(np.abs(values), 99.0))
    fewer = min(np.count_nonzero(clear & (values < 0.0)), np.count_nonzero(clear & (values > 0.0)))
    return bool(fewer >= _BOTH * len(values))


def never_turns(values: F64) -> bool:
    """Whether a signal has one sign all the time, but for noise."""
    top = float(np.percentile(np.abs(values), 99.0))
    return min(-float(np.percentile(values, 0.1)), float(np.percentile(values, 99.9))) <= _NEVER * top


def _as_supply(windows: Windows, time_s: F64, v: F64, i: F64) -> tuple[float, float]:
    """Shares of the voltage that stay open if the current is the supply's, and as it stands, over the windows in which
    the voltage is never small; infinite and 1 where there are too few of those."""
    least = _LEAST_DUTY * float(np.max(np.abs(v)))
    small = np.add.reduceat(np.abs(v) < least, windows.edges)[: len(windows)] + (np.abs(v[windows.edges[1:]]) < least)
    use = small == 0
    if np.count_nonzero(use) < FEWEST:
        return np.inf, 1.0
    motor = i / np.where(np.abs(v) < least, np.inf, v)
    known = windows.voltage[use]
    as_supply = left(windows.columns(time_s, motor)[use], known)
    if as_supply[1] > _CLOSES or as_supply[0][0] <= 0.0:
        return np.inf, 1.0
    return as_supply[1], left(_with_offset(windows.columns(time_s, i)[use]), known)[1]


def _with_offset(columns: F64) -> F64:
    return np.column_stack([columns, np.ones(len(columns))])


def _supply_guess(capture: Capture) -> float:
    """The largest voltage there is."""
    assert capture.voltage_V is not None
    return float(np.max(np.abs(capture.voltage_V)))
