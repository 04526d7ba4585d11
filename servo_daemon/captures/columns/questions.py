"""What has to be known of a file before it is a capture, and the flags, names or lines of a map that would tell."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.captures.capture.layout import NEEDED
from servo_daemon.captures.capture.model import capture_error
from servo_daemon.captures.columns.foreign import Recording
from servo_daemon.captures.columns.held import describe, proposal
from servo_daemon.column_names import UNITS
from servo_daemon.errors import CaptureError

#: Column -> units that a name without one may have, the likeliest first.
UNITS_ASKED: Mapping[str, tuple[str, ...]] = {
    "velocity_rad_s": ("rpm", "rad_s", "deg_s"),
    "position_rad": ("deg", "rad", "turns", "counts"),
    "current_A": ("mA", "A"),
    "voltage_V": ("mV", "V"),
    "time_s": ("ms", "us"),
    "torque_Nm": ("mNm", "Nm"),
}
#: Of a torque that is called effort, as ROS does.
EFFORT_UNITS = ("Nm", "mNm", "A", "mA")
#: A table with more columns is asked about by a map, not by naming them all.
_MOST_NAMED = 16


@dataclass(frozen=True, slots=True)
class Question:
    """What has to be known of a signal.

    Attributes:
        column: that the signal would be.
        text: for the user; names the flag that answers it where there is one.
        units: that its name may lack, the likeliest first; empty: the question is another one.
    """

    column: str
    text: str
    units: tuple[str, ...] = ()

    def left_out(self, signal: str) -> str:
        """For the line of what was understood, where the capture is one without it."""
        return f"not used: {self.text}" + (f" ({signal}_{self.units[0]}?)" if self.units else "")


def not_understood(recording: Recording, lack: str, asked: Mapping[str, Question], *, timed: bool) -> CaptureError:
    """That a file is no capture yet, and what would make it one.

    Args:
        lack: what is missing.
        asked: signal -> what is not known of it.
        timed: no time is needed.
    """
    parts = [f"{lack}; the file holds {describe(recording.held)}", *dict.fromkeys(q.text for q in asked.values())]
    no_time = lack == "no column time_s"
    if no_time and all(q.column != "time_s" for q in asked.values()):
        parts.append("where there is none, --rate HZ says how fast the samples are")
    line = recording.header_line
    units = {signal: q.units for signal, q in asked.items() if q.units}
    if units and line is not None and len(recording.held) <= _MOST_NAMED:
        names = ",".join(f"{s.name}_{units[s.name][0]}" if s.name in units else s.name or "-" for s in recording.held)
        others = "; ".join(f"or {signal}_{', _'.join(u[1:])}" for signal, u in units.items())
        parts.append(f"say so by name: --columns {shlex.quote(names)} ({others})")
    elif not asked or any("--" not in q.text for q in asked.values()):
        parts += [_mapped(signal, q) for signal, q in asked.items() if q.units]
        parts += [proposal(recording.held, timed=timed)] if recording.held else []
        parts.append(f"needed: {NEEDED}")
    return capture_error(recording.path, "; ".join(parts), line=line, column="time_s" if no_time else None)


def _mapped(signal: str, question: Question) -> str:
    unit = question.units[0]
    scale = UNITS[unit.lower()][1]
    return f'if in {unit}: {question.column} = {{ signal = "{signal}", scale = {scale:.7g} }}'
