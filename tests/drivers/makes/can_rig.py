"""CAN frames as a driver gets them, and drives on a simulated adapter."""

from __future__ import annotations

from collections.abc import Sequence

import can

from drivers.can.decode import FrameBatch, batch_of


def batch(
    frames: Sequence[tuple[int, bytes]], *, extended: bool = False, period_s: float = 1e-3, start_s: float = 0.0
) -> FrameBatch:
    """Frames (identifier, data) that arrived one period apart, from `start_s` on."""
    messages = [
        can.Message(
            timestamp=start_s + k * period_s, arbitration_id=i, data=data, is_extended_id=extended, is_fd=len(data) > 8
        )
        for k, (i, data) in enumerate(frames)
    ]
    return batch_of(messages, 100.0 + start_s + len(frames) * period_s, 1e9 + start_s)
