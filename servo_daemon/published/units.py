"""Units as the names of state channels tell them, and times as they are told outside."""

from __future__ import annotations

from datetime import UTC, datetime
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


def iso_utc(epoch_s: float) -> str:
    """1763724000.5 is "2025-11-21T11:20:00.500Z"."""
    return datetime.fromtimestamp(epoch_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
