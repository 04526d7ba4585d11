"""Motions that are none by themselves: an electrical frequency, counts since the sample before, counts a second, and
what has a name that nobody knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np

from servo_daemon.captures.capture.layout import MOTION
from servo_daemon.captures.columns.foreign import Recording
from servo_daemon.captures.columns.held import HeldSignal
from servo_daemon.captures.columns.signal_map import COUNTS, MappedColumn, SignalRef
from servo_daemon.captures.columns.signal_values import DIFFERENT, Values
from servo_daemon.captures.columns.understood import Understood
from servo_daemon.column_names import TURN, Meaning, meaning, not_measured
from servo_daemon.errors import CaptureError

#: What they are called, the surest first.
BY_NUMBER = ("turned", "increments", "count_rate", "frequency")

#: Of the largest value: what steps of a row's number or a time differ by in double precision.
_ROUNDING = 1e-12

_ASKED: Mapping[str, str] = {
    "increments": "{0} counts since the sample before: --counts-per-rev N says how often in a turn (after quadrature)",
    "count_rate": "{0} is in counts a second: --counts-per-rev N says how often in a turn (after quadrature)",
    "frequency": "{0} is a frequency: --pole-pairs N makes the shaft's speed of it where it is the electrical one "
    "(of turns a second, --pole-pairs 1; of pulses, --pole-pairs with the pulses of a turn)",
}


def take_by_number(
    recording: Recording,
    found: Understood,
    beside: Mapping[str, tuple[HeldSignal, Meaning]],
    number: Callable[[str], float | None],
) -> None:
    """The motion by the first of them that the file has, where there is none itself; a question where its number is
    not told.

    Args:
        beside: signals of the file by what they are called here.
        number: what the user or the file says of "counts_per_rev" or "pole_pairs".
    """
    for what in BY_NUMBER:
        if what not in beside or MOTION & found.fields:
            continue
        signal, meant = beside[what]
        values = Values(recording.read(SignalRef("value", signal.name)).values)
        if not values.varies:
            continue
        key = {"frequency": "pole_pairs", "turned": ""}.get(what, "counts_per_rev")
        divisor = number(key) if key else 1.0
        if divisor is None:
            column = COUNTS if what == "increments" else "velocity_rad_s"
            found.ask(signal.name, column, _ASKED[what].format(signal.name))
            continue
        if what == "increments":
            found.counts_per_rev = divisor
        _add(found, what, signal.name, meant, divisor)


def ask_about_the_rest(recording: Recording, found: Understood) -> None:
    """Questions about signals that may be the motion of a file that has none, and that no name says anything of."""
    used = {operand.signal for column in found.columns.values() for operand in column.operands}
    for signal in recording.held:
        known = not signal.name or signal.columns or meaning(signal.short, signal.unit) or not_measured(signal.short)
        if signal.name in used or known or not _may_be_a_motion(recording, signal.name):
            continue
        text = f"{signal.name}: is it the motion? If not, '-' in its place in --columns passes it over"
        found.ask(signal.name, "velocity_rad_s", text, ("rpm", "rad_s", "deg", "counts"))


def _may_be_a_motion(recording: Recording, name: str) -> bool:
    """Whether a signal is neither a text nor a mark nor the row's number."""
    with suppress(CaptureError):
        values = recording.read(SignalRef("value", name)).values
        steps = np.diff(values)
        even = np.ptp(steps) <= _ROUNDING * np.max(np.abs(values), initial=0.0)
        return len(np.unique(values[np.isfinite(values)])) >= DIFFERENT and not even
    return False


def _add(found: Understood, what: str, name: str, meant: Meaning, divisor: float) -> None:
    summed = what in ("turned", "increments")
    column = {"turned": "position_rad", "increments": COUNTS}.get(what, "velocity_rad_s")
    in_si = meant.scale if meant.told else TURN
    scale = {"increments": 1.0, "count_rate": TURN / divisor}.get(what, in_si / divisor)
    found.columns[column] = MappedColumn(column, (SignalRef("value", name, scale),), summed=summed)
    how = {"turned": "summed", "increments": f"summed, ÷ {divisor:,.10g} a turn"}.get(what, f"÷ {divisor:,.10g} a turn")
    found.told.append(f"{name} → {'position_rad' if summed else column} ({how})")
