"""Kinds of files that captures are written as."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal, get_args

from servo_daemon.captures.formats.mcap.library import require_mcap
from servo_daemon.errors import CaptureError
from servo_daemon.extras import require_pyarrow

#: Kinds of files, and the endings of their names.
Kind = Literal["csv", "parquet", "mcap"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
_ENDINGS: Final[Mapping[str, Kind]] = {".csv": "csv", ".csv.gz": "csv", ".parquet": "parquet", ".mcap": "mcap"}


def kind_of(path: Path, kind: Kind | None) -> Kind:
    """What kind of file a capture of this name is.

    Args:
        kind: what is asked for; None: the name says it.

    Raises:
        CaptureError: it says none, or another one than is asked for.
    """
    named = next((k for ending, k in _ENDINGS.items() if path.name.endswith(ending)), None)
    if kind is not None and named not in (None, kind):
        raise CaptureError(f"{path}: this is the name of a {named} file, not of {kind}")
    if (found := kind or named) is not None:
        return found
    with contextlib.suppress(OSError):
        if path.exists() and not path.is_file():  # /dev/stdout, a pipe; a folder is refused when it is opened
            return "csv"
    raise CaptureError(f"{path}: a capture's name ends in .csv, .csv.gz, .parquet or .mcap")


def require_library(path: Path, kind: Kind) -> None:
    """That the library which writes it is there.

    Raises:
        BadInputError: it is not installed.
    """
    if kind == "parquet":
        require_pyarrow(path)
    elif kind == "mcap":
        require_mcap(path, "writer")
