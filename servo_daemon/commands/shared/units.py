"""Units and column names as they read on the axis of a capture."""

from __future__ import annotations

from servo_daemon.captures.capture.model import LINEAR_COLUMNS
from servo_daemon.identification.inverse_dynamics.estimate import unit_on

_LINEAR_NAMES = {field: column for column, field in LINEAR_COLUMNS.items()}


def shown_unit(unit: str, *, linear: bool) -> str:
    """The unit as it is on this axis."""
    return unit_on("linear" if linear else "rotary", unit)


def shown_column(name: str, *, linear: bool) -> str:
    """The channel's column name on this axis."""
    return _LINEAR_NAMES.get(name, name) if linear else name
