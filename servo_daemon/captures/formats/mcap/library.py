"""The library, imported by name, so that nothing else needs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from servo_daemon.extras import require


def require_mcap(path: Path, module: str) -> Any:
    """A module of the library: "writer", "stream_reader", ….

    Raises:
        BadInputError: it is not installed.
    """
    return require(f"mcap.{module}", "mcap", "mcap", f"{path}: MCAP")
