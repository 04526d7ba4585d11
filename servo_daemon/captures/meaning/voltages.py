"""A voltage that is none: a duty whose middle stands still, or the current's column; and a winding that is driven from
the shaft."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.currents import lasts_both_ways, never_turns
from servo_daemon.captures.meaning.finding import Finding, column_name, mend
from servo_daemon.captures.meaning.windows import FEWEST, Windows, left, travelled, window_length
from servo_daemon.samples import F64

#: The right meaning leaves less than this share (rms) of what the column as it stands leaves of the voltage ...
_CLEARLY = 0.5
#: ... and so much of the voltage's changes at the most.
_CLOSES = 0.25
#: Windows without a current, s: the winding of a motor has settled in one.
_MOTION_S = 0.05
#: Middles of a duty's ranges (1, 100 %, codes of 8, 10 and 12 bits), and how near one is to the zero that is seen.
_MIDDLES, _NEAR = (0.5, 50.0, 127.5, 511.5, 2047.5), 0.03


def voltage_findings(capture: Capture) -> list[Finding]:
    """What its balance with current and motion, or with the motion alone, says of the voltage; empty where it is
    one."""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or travel is None:
        return []
    m = window_length(capture.time_s) if i is not None else max(1, round(_MOTION_S / capture.sample_period_s))
    windows = Windows.of(capture.time_s, v, travel, m)
    if len(windows) < FEWEST:
        return []
    if i is None:
        gained = np.gradient(windows.speed) / windows.lasting
        return _about_a_middle(capture, windows, np.column_stack([windows.speed, gained]), v)
    columns = windows.columns(capture.time_s, i)
    return _about_a_middle(capture, windows, columns, v) or _swapped(capture, windows, columns, v, i)


def closes_as_it_stands(capture: Capture) -> bool:
    """Whether v = R i + K ω closes with positive R and K, and not without the speed: signs and columns are right,
    whatever drives the shaft."""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or i is None or travel is None:
        return False
    windows = Windows.of(capture.time_s, v, travel)
    if len(windows) < FEWEST:
        return False
    columns = windows.columns(capture.time_s, i)
    (R, _, K), share = left(columns, windows.voltage)
    return R > 0.0 and K > 0.0 and share < _CLOSES and share < _CLEARLY * left(columns[:, :2], windows.voltage)[1]


def may_be_driven(capture: Capture, field: str) -> bool:
    """Whether a channel that counts against its effort may be right, and the shaft driven from outside: unless the
    winding's balance closes with its other sign. (Of a generator on a resistor voltage, current and speed are one
    signal, and it closes with neither.)

    Args:
        field: a channel with the motor's current in its balance, or of it.
    """
    values = getattr(capture, field)
    if capture.current_A is None or values is None:
        return False
    return not closes_as_it_stands(replace(capture, **{field: -values}))


def _about_a_middle(capture: Capture, windows: Windows, columns: F64, v: F64) -> list[Finding]:
    if not never_turns(v) or float(v.mean()) <= 0.0 or not lasts_both_ways(windows.speed):
        return []
    open_share = left(columns, windows.voltage)[1]
    found, share = left(np.column_stack([columns, np.ones(len(columns))]), windows.voltage)
    zero, positive = found[-1], (found[0], found[-2])  # what goes with the current or the speed, speed or acceleration
    changes = float(np.std(windows.voltage) / np.sqrt(np.mean(windows.voltage**2)))
    closes = share < _CLOSES * changes and share < _CLEARLY * open_share and min(positive) > 0.0
    if not closes or not float(v.min()) < zero < float(v.max()):
        return []
    name = column_name(capture, "voltage_V")
    line = capture.as_map.get("signals", {}).get(name, {})
    unit = float(line.get("scale", 1.0)) if isinstance(line, dict) else 1.0
    middle = next((unit * m for m in _MIDDLES if abs(zero / (unit * m) - 1.0) < _NEAR), None)
    if middle is None and capture.current_A is None:
        return []  # a load may do it
    if middle is None:
        what, keys = "a voltage with an offset", {"zero": float(f"{zero:.3g}"), "scale": 1.0}
    else:
        what = "a duty whose middle stands still (locked antiphase: the voltage is supply × (2 duty − 1))"
        keys = {"zero": middle, "scale": 2.0}
    text = (
        f"column {name} never goes below zero although the motion turns round, and the voltage fits "
        f"what else is measured about {zero:.3g}: {what}; it is left out. {mend(capture, 'voltage_V', keys)}"
    )
    return [Finding("voltage_V", text, "column")]


def _swapped(capture: Capture, windows: Windows, columns: F64, v: F64, i: F64) -> list[Finding]:
    """v = R i − K ω though both take power on the shaft is i = v/R + K/R ω."""
    (R, _, K), share = left(columns, windows.voltage)
    if R <= 0.0 or K >= 0.0 or share > _CLEARLY * left(columns[:, :2], windows.voltage)[1]:
        return []
    travel = columns[:, 2] * windows.lasting
    if min(float(windows.voltage @ travel), float(columns[:, 0] @ travel)) <= 0.0:
        return []
    of_current = Windows.of(capture.time_s, i, np.asarray(travelled(capture)))
    (turned_R, _, turned_K), share = left(of_current.columns(capture.time_s, v), of_current.voltage)
    if share > _CLOSES or min(turned_R, turned_K) <= 0.0:
        return []
    text = (
        f"voltage_V = R × current_A + K ω has K = {K:.3g} although both drive the shaft, and the other way round it "
        "fits: their columns are exchanged. mend: give the columns their names in the right order (--columns …, or "
        "--signals MAP.toml, docs/captures.md)"
    )
    return [Finding("voltage_V", text, "capture")]
