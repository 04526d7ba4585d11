"""Results of drives as files: what is there for the same captures and the same question is not computed again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from servo_daemon.files import AtomicFile
from servo_daemon.fleet.units import Unit


class KeptResults:
    """A folder with one JSON document a drive.

    Raises:
        BadInputError: it cannot be made or written to.
    """

    def __init__(self, folder: Path, asked: str) -> None:
        self._folder, self._asked = folder, asked
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, unit: Unit) -> dict[str, Any] | None:
        """What was found before; None: nothing, or a file that cannot be read (it is computed anew)."""
        try:
            document = json.loads(self._path(unit).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        return document if isinstance(document, dict) else None

    def put(self, unit: Unit, document: dict[str, Any]) -> None:
        """Write a unit's result: after a crash it is complete or not there."""
        with AtomicFile(self._path(unit)) as output:
            output.write(json.dumps(document, allow_nan=False, ensure_ascii=False).encode())

    def _path(self, unit: Unit) -> Path:
        return self._folder / f"{unit.key(self._asked)}.json"
