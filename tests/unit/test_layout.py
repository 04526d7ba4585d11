"""How samples are laid out for the filter; what a standing encoder is worth."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.estimators.layout import Layout
from servo_daemon.samples import make_block

LSB = 1e-3


def doubts(counts: list[int], cuts: tuple[int, ...] = ()) -> np.ndarray:
    """Factors on the encoder's variance for these counts, delivered in blocks cut there."""
    layout = Layout("voltage", ("current_A", "position_rad"))
    layout.expect_steps(LSB, 0.0)
    n = len(counts)
    t, zero = np.arange(n) * 1e-3, np.zeros(n)
    block = make_block(t, voltage_V=zero, current_A=zero, position_rad=LSB * np.array(counts))
    parts = [block.slice(a, b) for a, b in zip([0, *cuts], [*cuts, n], strict=True)]
    return np.concatenate([layout.rows(part, 0.0)[:, 9] for part in parts])


def test_a_moving_encoder_is_believed() -> None:
    np.testing.assert_array_equal(doubts([0, 1, 2, 3, 5, 4]), np.ones(6))


def test_a_standing_encoder_says_little_more_than_once() -> None:
    """Weights of all samples on one count together: however long it stands, at most one and a half samples' worth."""
    weights = 1.0 / doubts([0] * 3000)
    assert weights[0] == 1.0
    assert 1.4 < weights.sum() < 1.5 + 1e-6


def test_a_new_count_counts_again() -> None:
    d = doubts([0, 0, 0, 7, 7, 8])
    assert d[3] == 1.0 and d[5] == 1.0 and d[4] == 4.0


@pytest.mark.parametrize("cuts", [(1,), (2, 3), (1, 2, 3, 4, 5, 6, 7)])
def test_blocks_make_no_difference(cuts: tuple[int, ...]) -> None:
    counts = [4, 4, 4, 5, 5, 4, 4, 4, 4]
    np.testing.assert_array_equal(doubts(counts, cuts), doubts(counts))


def test_without_a_known_step_nothing_is_doubted() -> None:
    layout = Layout("voltage", ("current_A", "position_rad"))
    n = np.zeros(20)
    rows = layout.rows(make_block(np.arange(20) * 1e-3, voltage_V=n, current_A=n, position_rad=n), 0.0)
    np.testing.assert_array_equal(rows[:, 9], np.ones(20))
