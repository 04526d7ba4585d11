"""A unit's work that kills its process. A file of its own: a worker begins again without the imports of a test."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

from servo_daemon.fleet.units import Unit


def deadly(unit: Unit, asked: tuple[str, ...]) -> dict[str, Any]:
    """Kills its process the first time, as a machine that goes away does; `always`: every time."""
    mark = Path(asked[0])
    if unit.name == "always" or (unit.name == "once" and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"pid": os.getpid()}
