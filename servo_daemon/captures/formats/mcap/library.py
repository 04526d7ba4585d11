"""The library, imported by name, so that nothing else needs it."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from servo_daemon.errors import BadInputError


def require_mcap(path: Path, module: str) -> Any:
    """A module of the library: "writer", "stream_reader", ….

    Raises:
        BadInputError: it is not installed.
    """
    try:
        return importlib.import_module(f"mcap.{module}")
    except ImportError as error:
        raise BadInputError(f"{path}: MCAP needs mcap: pip install 'servo-daemon[mcap]', or use .csv.gz") from error
