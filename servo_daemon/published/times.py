"""Times as they are told outside: UTC, ISO 8601 with Z, milliseconds."""

from __future__ import annotations

from datetime import UTC, datetime


def iso_utc(epoch_s: float) -> str:
    """1763724000.5 is "2025-11-21T11:20:00.500Z"."""
    return datetime.fromtimestamp(epoch_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
