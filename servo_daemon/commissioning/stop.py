"""Why a run was stopped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Reason = Literal[
    "limit", "data_missing", "bad_data", "voltage_differs", "current_sign", "encoder_sign", "no_current", "no_motion",
    "motion_ended", "encoder_lost", "hard_stop", "innovations", "not_at_rest", "interrupted", "command_lost",
    "port_lost",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Stop:
    """The reason, a line for people, and device time, s."""

    reason: Reason
    text: str
    time_s: float


class StoppedError(Exception):
    """Leaves the run's loop; never leaves `commission`."""

    def __init__(self, stop: Stop) -> None:
        super().__init__(stop.text)
        self.stop = stop
