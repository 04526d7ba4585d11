"""Work that a unit does to its worker. A file of its own: a worker begins again without the imports of a test."""

from __future__ import annotations

import os
import resource
import signal
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.fleet.units import Unit


def deadly(unit: Unit, asked: tuple[str, ...]) -> dict[str, Any]:
    """Kills its process the first time, as a machine that goes away does; `always`: every time."""
    mark = Path(asked[0])
    if unit.name == "always" or (unit.name == "once" and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"pid": os.getpid()}


def page_faults(_unit: Unit, _asked: tuple[str, ...]) -> dict[str, Any]:
    """Of a hundred arrays of 8 MB, one after the other."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        np.ones(1_000_000)
    return {"faults": resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before}
