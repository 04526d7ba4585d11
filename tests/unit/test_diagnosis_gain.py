"""The share of the removable error: the contract's formula, on the part that was held out."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from servo_daemon.diagnosis.compare import error_removed
from servo_daemon.diagnosis.scored import Scored
from servo_daemon.diagnosis.split import CHOICE, HELD_OUT, TRAIN
from servo_daemon.diagnosis.trial import Trial


def scored(nrmse: float, runs: int = 30) -> Scored:
    """Free runs of 100 samples with this error in each."""
    return Scored(np.full((runs, 1), 100.0 * nrmse**2), np.full((runs, 1), 100.0), np.ones(1))


@pytest.mark.parametrize(
    ("b", "e", "n", "removed"),
    [
        (0.5, 0.1, 0.1, 1.0),
        (0.5, 0.3, 0.1, (0.25 - 0.09) / (0.25 - 0.01)),
        (0.5, 0.1, 0.2, (0.25 - 0.01) / (0.25 - 0.04)),  # the noise was thought larger than it is: above 1
        (0.5, 0.6, 0.1, (0.25 - 0.36) / (0.25 - 0.01)),  # the extended model is the worse one: below 0
        (0.5, 0.1, 0.0, (0.25 - 0.01) / 0.25),
    ],
)
def test_the_share_is_the_contracts_and_not_clipped(b: float, e: float, n: float, removed: float) -> None:
    share, (low, high) = error_removed(scored(b), scored(e), n)
    assert share == pytest.approx(removed)
    assert low == pytest.approx(removed) and high == pytest.approx(removed)


def test_its_interval_is_of_runs_drawn_again() -> None:
    base, extended = scored(0.5), scored(0.1)
    one_is_lost = np.where(np.arange(30)[:, None] == 0, base.squares, extended.squares)
    share, (low, high) = error_removed(base, Scored(one_is_lost, base.counts, base.spread), 0.1)
    assert low < share < high == pytest.approx(1.0)


def test_what_is_held_out_is_neither_fitted_nor_decides() -> None:
    asked: list[int] = []
    trial = SimpleNamespace(scored=asked.append)
    Trial.__dict__["held_out"].func(trial)
    assert asked == [HELD_OUT]
    assert HELD_OUT not in (TRAIN, CHOICE)
