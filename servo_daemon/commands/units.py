"""Units and column names of a linear axis, where J is a mass and torques are forces."""

from __future__ import annotations

_LINEAR_UNITS = {
    "kg·m²": "kg",
    "N·m·s/rad": "N·s/m",
    "N·m": "N",
    "N·m/A": "N/A",
    "rad": "m",
    "rad/s": "m/s",
    "A·s²/rad": "A·s²/m",
    "A·s/rad": "A·s/m",
    "rad/(s·V)": "m/(s·V)",
    "N·m/V": "N/V",
    "N·m/rad": "N/m",
    "N·m·s²/rad²": "N·s²/m²",
    "1/rad": "1/m",
    "1/rad²": "1/m²",
}
_LINEAR_COLUMNS = {"position_rad": "position_m", "velocity_rad_s": "velocity_m_s", "torque_Nm": "force_N"}


def shown_unit(unit: str, *, linear: bool) -> str:
    """The unit as it is on this axis."""
    return _LINEAR_UNITS.get(unit, unit) if linear else unit


def shown_column(name: str, *, linear: bool) -> str:
    """The channel's column name on this axis."""
    return _LINEAR_COLUMNS.get(name, name) if linear else name
