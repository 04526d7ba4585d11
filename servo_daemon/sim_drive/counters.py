"""What a simulated device did, for whoever counts what should have arrived."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class DeviceCounters:
    """Only ever counts up; read by any thread."""

    frames: int = 0  # sample frames (binary), groups of lines (text) or of samples (slcan) made
    samples: int = 0  # samples in them
    descriptions: int = 0
    unheard: int = 0  # frames nobody had the port open for
    overruns: int = 0  # frames (slcan: lines) lost or cut because the reader was too slow
    restarts: int = 0
