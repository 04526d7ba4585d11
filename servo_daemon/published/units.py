"""Units as the names of state channels tell them."""

from __future__ import annotations

from typing import Final

#: Longest first, so that `_rad_s` is not taken for `_s`.
_STATE_UNITS: Final = (
    ("_rad_s", "rad/s"),
    ("_m_s", "m/s"),
    ("_rad", "rad"),
    ("_Nm", "N·m"),
    ("_A", "A"),
    ("_V", "V"),
    ("_C", "°C"),
    ("_K", "K"),
    ("_N", "N"),
    ("_m", "m"),
    ("_s", "s"),
)


def split_unit(name: str) -> tuple[str, str | None]:
    """A state channel's name without and its unit with which it ends: "velocity_rad_s" is ("velocity", "rad/s")."""
    for suffix, unit in _STATE_UNITS:
        if name.endswith(suffix):
            return name.removesuffix(suffix), unit
    return name, None
