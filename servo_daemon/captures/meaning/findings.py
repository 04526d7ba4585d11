"""All findings on a capture, and what they leave of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.captures.capture.layout import lacks
from servo_daemon.captures.capture.model import Capture, capture_error
from servo_daemon.captures.meaning.brakes import brake_findings
from servo_daemon.captures.meaning.currents import current_findings
from servo_daemon.captures.meaning.finding import Finding
from servo_daemon.captures.meaning.jumps import jump_findings
from servo_daemon.captures.meaning.rails import rail_findings
from servo_daemon.captures.meaning.rows import row_findings
from servo_daemon.captures.meaning.signs import sign_findings
from servo_daemon.captures.meaning.units import unit_findings
from servo_daemon.captures.meaning.voltages import voltage_findings
from servo_daemon.signal_meaning import SignalMeaning


def as_meant(
    read: Capture, otherwise: SignalMeaning, *, limit_V: float | None = None
) -> tuple[Capture, tuple[Finding, ...]]:
    """A capture in a DC motor's units, and what is found on it.

    Args:
        otherwise: what its signals are where its own lines are silent.
        limit_V: see `findings`.
    """
    capture = read.as_dc(read.meaning(otherwise))
    return capture, findings(capture, limit_V=limit_V)


def findings(capture: Capture, *, limit_V: float | None = None) -> tuple[Finding, ...]:
    """What its numbers say against the names of its columns, the gravest first; empty for a capture that means what it
    says. With a position that starts again nothing else can be told.

    Args:
        limit_V: the drive's supply where it is known.
    """
    if jumps := jump_findings(capture):
        return tuple(jumps)
    currents = current_findings(capture) or voltage_findings(capture) or rail_findings(capture)
    rows = () if currents else row_findings(capture)
    brakes = brake_findings(capture)
    return (*currents, *rows, *unit_findings(capture, limit_V), *sign_findings(capture), *brakes)


def without_unusable(capture: Capture, found: Sequence[Finding]) -> Capture:
    """The capture without the columns that do not mean what they say.

    Raises:
        CaptureError: it cannot be used with what is found, or nothing is left; the text says the mend.
    """
    rows = np.ones(len(capture), dtype=bool)
    for one in found:
        if one.weight == "capture":
            raise capture_error(capture.path, one.text)
        if one.where is not None and one.weight == "rows":
            rows = rows & ~one.where
        elif one.where is not None:
            known = capture.current_known
            capture = replace(capture, current_known=~one.where if known is None else known & ~one.where)
        if one.weight == "column":
            if lacks([f for f in ("time_s", *capture.channels) if f != one.column]):
                raise capture_error(capture.path, one.text)
            capture = replace(capture, **{one.column: None})  # type: ignore[arg-type]
    return capture if rows.all() else capture.of_rows(rows)
