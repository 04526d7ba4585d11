"""Packages that not everybody installs: imported by name when they are needed, so that nothing else needs them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from servo_daemon.errors import BadInputError


def require(module: str, package: str, extra: str, needed_by: str, instead: str = "use .csv.gz") -> Any:
    """A module of such a package.

    Args:
        package: as it is called where it is installed from.
        extra: of servo-daemon, which brings it.
        needed_by: what cannot be done without it: "a.xlsx: Excel".
        instead: what can be done without it; empty: nothing.

    Raises:
        BadInputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        text = f"{needed_by} needs {package}: pip install 'servo-daemon[{extra}]'"
        raise BadInputError(f"{text}, or {instead}" if instead else text) from error


def require_pyarrow(path: Path | None = None, instead: str = "use .csv.gz") -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet.

    Args:
        path: of the file that is in Parquet.
        instead: as for `require`.

    Raises:
        BadInputError: they are not installed.
    """
    needed_by = "Parquet" if path is None else f"{path}: Parquet"
    arrow, parquet = (
        require(module, "pyarrow", "parquet", needed_by, instead) for module in ("pyarrow", "pyarrow.parquet")
    )
    return arrow, parquet
