"""Fisher scoring of log-variances."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error.noise.scoring import Axes, fisher_scoring
from servo_daemon.samples import F64


def test_what_is_hardly_seen_leaves_the_others_their_steps() -> None:
    """Noise of variance 1 and a second source of a billionth, whose curvature is nothing and whose step the longest."""
    y = np.random.default_rng(5).normal(0.0, 1.0, 1000)

    def innovations(x: F64) -> tuple[F64, F64]:
        variance = np.full(len(y), np.exp(x[0]) + 1e-9 * np.exp(x[1]))
        return y / np.sqrt(variance), np.log(variance)

    axes = Axes(np.full(2, -20.0), np.full(2, 20.0), np.full(2, 1e-3), np.full(2, 3.0))
    found = fisher_scoring(innovations, np.array([-4.0, 0.0]), range(2), axes, faint=1 / 9)
    assert found.converged
    assert found.at[0] == pytest.approx(np.log(np.mean(y**2)), abs=0.01)
    assert abs(found.at[1]) < 1.0
