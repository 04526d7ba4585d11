"""A log of VESC Tool's real-time data that no motor can be found in, though all of its columns are there."""

from __future__ import annotations

import numpy as np

from servo_daemon.captures.capture.model import capture_error
from servo_daemon.captures.columns.foreign import Recording
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.samples import F64

#: What the firmware sends as an average over no control cycle, the least 32-bit number, by the steps of a unit: such
#: a row is read right after another program's read.
_NOTHING = {"q_axis_current": -(2.0**31) / 100.0, "q_axis_voltage": -(2.0**31) / 1000.0}
#: So near it is that number however many digits are written (the log has six).
_NEAR = 1e-4


def refuse_mixed(recording: Recording) -> None:
    """
    Raises:
        CaptureError: rows are of several controllers, or another program has read the averages.
    """
    there = {signal.short: signal.name for signal in recording.held}

    def read(short: str) -> F64:
        return recording.read(SignalRef("value", there[short])).values if short in there else np.zeros(0)

    ids = np.unique(read("vesc_id"))
    if len(ids) > 1:
        which = ", ".join(f"{number:g}" for number in ids)
        message = f"rows of several controllers ({which}) in one log: keep those of one of them"
        raise capture_error(recording.path, message, column="vesc_id")
    for name, nothing in _NOTHING.items():
        rows = int(np.count_nonzero(np.abs(read(name) / nothing - 1.0) < _NEAR))
        if rows:
            message = (
                f"{rows} rows have an average over nothing ({nothing:.10g}): another program read this VESC's averages "
                "at the time, and those of the other rows are over a part of the time between rows: log again alone"
            )
            raise capture_error(recording.path, message, column=name)
