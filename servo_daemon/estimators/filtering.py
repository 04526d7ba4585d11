"""Runs the filter over samples as they come: gaps, restarts of the device, and which samples were outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.estimators.ekf import Ekf
from servo_daemon.estimators.layout import Layout, breaks, channel, gaps
from servo_daemon.estimators.levels import Levels
from servo_daemon.samples import F64, SampleBlock


class Filtering:
    """One drive's.

    Attributes:
        layout: how samples are laid out.
    """

    def __init__(self, ekf: Ekf, levels: Levels) -> None:
        self._ekf, self._levels = ekf, levels
        self.layout = Layout(ekf.plant.drive, ekf.channels)
        self._gated: list[F64] = []  # of each run of samples since they were last asked for; (n, channels)

    def take(self, block: SampleBlock, last_s: float | None, period_s: float | None) -> None:
        """Samples in order.

        Args:
            last_s: time of the sample before them.
            period_s: usual distance of two samples.
        """
        if not self._ekf.started:
            self.layout.rows(block, 0.0)
            return
        cuts = breaks(block, last_s)
        holes = gaps(block, last_s, period_s)
        if not cuts and not holes:
            self._update(block)
            return
        edges = sorted({*cuts, *holes})
        for a, b in zip([0, *edges], [*edges, len(block)], strict=True):
            if b <= a:
                continue
            part = block.slice(a, b)
            if a in cuts or not holes.get(a, True):
                self.layout.last_s = float(part.time_s[0])  # begins at this sample: no prediction up to it
                forget = self._ekf.forget_state if a in cuts else self._ekf.forget_motion
                forget(self.first_state(part))
            elif a in holes:
                self._ekf.doubt_input(self._levels.input_step_square)
            self._update(part)

    def _update(self, part: SampleBlock) -> None:
        innovations = self._ekf.update(self.layout.rows(part, self._levels.input_square))
        self._gated.append(innovations.gated)

    def first_state(self, block: SampleBlock) -> F64:
        """Plant states at the first sample of a block: what is measured; the last known where that is no measurement
        (looking further would make the result depend on where blocks end); the model's start for the rest."""
        x = np.array([s.initial for s in self._ekf.plant.states])
        first = block.slice(0, 1)
        for k, state in enumerate(self._ekf.plant.states):
            if state.name in self._ekf.channels:
                values, valid = channel(first, state.name)
                x[k] = values[0] if valid is None or valid[0] else self._ekf.x[k]
        return x

    def take_outliers(self) -> NDArray[np.bool_] | None:
        """Which of the samples since the last call were gated in some channel; None: none was."""
        taken, self._gated = self._gated, []
        if not any(np.count_nonzero(gated) for gated in taken):
            return None
        return np.asarray(np.logical_or.reduce(np.concatenate(taken), axis=1))

    def forget_outliers(self) -> None:
        """A filter begins: what was gated before is no longer asked for."""
        self._gated = []
