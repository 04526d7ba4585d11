"""How far estimates wander: about straight lines, over the last minute."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.tracking.changes.wander import Wander


def test_ageing_is_no_wandering_and_a_wave_is() -> None:
    wander = Wander()
    for k in range(600):
        wander.add(np.array([2e-4 * k, 0.02 * np.sin(0.3 * k)]))
    ageing, wave = wander.spread(2)
    assert ageing < 1e-9
    assert wave == pytest.approx(0.02 / np.sqrt(2.0), rel=0.02)


def test_what_was_long_ago_or_before_a_step_says_nothing() -> None:
    wander = Wander()
    assert wander.spread(1).tolist() == [0.0]
    for k in range(1200):
        wander.add(np.array([float(k % 2 if k < 600 else 0)]))
    assert wander.spread(1)[0] < 1e-9
    wander.add(np.array([1.0]))
    wander.clear()
    assert wander.spread(1).tolist() == [0.0]
