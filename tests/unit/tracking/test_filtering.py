"""Samples as the filter takes them (servo_daemon/tracking/samples/filtering.py)."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from servo_daemon.conditioning.layout import Stretches
from servo_daemon.samples import Quality, make_block
from servo_daemon.tracking.samples.filtering import Filtering


@dataclass
class Counting:
    """A filter that only counts what it is given."""

    started: bool = False
    rows: int = 0
    channels: tuple[str, ...] = ("position_rad",)
    plant: Any = field(default_factory=lambda: SimpleNamespace(drive="current", states=()))

    def update(self, rows: np.ndarray, *, again: bool) -> Any:
        self.rows += len(rows)
        return SimpleNamespace(gated=np.ones((len(rows), 1)))


def test_a_gap_just_after_the_start_is_filled_for_filter_and_regressions_alike() -> None:
    """The filter's outliers are left out of the regressions' samples one by one: they have to be as many."""
    period_s, ekf, stretches = 0.01, Counting(), Stretches()
    filtering = Filtering(ekf, _scales())  # type: ignore[arg-type]
    time_s = period_s * np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    block = make_block(
        time_s, current_A=np.sin(time_s), position_rad=np.cos(time_s),
        quality=np.array([0, 0, 0, int(Quality.GAP_BEFORE), 0], np.uint8),
    )  # fmt: skip
    before, after = block.slice(0, 3), block.slice(3, 5)
    filtering.take(before, None, period_s)
    stretches.of(before, 0.0, None, period_s)
    ekf.started = True
    filtering.take(after, float(time_s[2]), period_s)
    outliers = filtering.take_outliers()
    assert outliers is not None
    assert len(outliers) == ekf.rows == 3 == len(stretches.of(after, 0.0, float(time_s[2]), period_s).time_s)


def _scales() -> Any:
    return SimpleNamespace(input_step_square=0.0, spike_limit=np.inf, current_spike_limit=np.inf, input_square=0.0)
