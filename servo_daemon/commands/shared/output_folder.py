"""The folder a command writes its results to."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Any

from servo_daemon.errors import BadInputError
from servo_daemon.files import AtomicFile

if TYPE_CHECKING:
    from servo_daemon.report import Report


class OutputFolder:
    """A folder for results, made if it is not there.

    Raises:
        BadInputError: it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInputError(f"--out {path}: {error.strerror or error}") from error

    def check_writable(self) -> None:
        """That a file can be made there: to be asked before hours of work, not after them.

        Raises:
            BadInputError: it cannot.
        """
        try:
            with NamedTemporaryFile(dir=self.path, prefix=".writable."):
                pass
        except OSError as error:
            raise BadInputError(f"--out {self.path}: cannot be written to: {error.strerror or error}") from error

    def write_json(self, name: str, document: Mapping[str, Any]) -> None:
        """One JSON document; complete or not there."""
        text = json.dumps(document, allow_nan=False, ensure_ascii=False, indent=1)
        with AtomicFile(self.path / name) as output:
            output.write(text.encode() + b"\n")

    def write_report(self, name: str, report: Report) -> None:
        """One HTML file; complete or not there."""
        from servo_daemon.report import write_report

        write_report(self.path / name, report)
