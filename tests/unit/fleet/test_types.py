"""Fleets of one type and of several."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.fleet.types import types_of


def fleet(*types: tuple[int, float], spread: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Values and covariances of so many drives with this mean of their second parameter."""
    rng = np.random.default_rng(3)
    mean = np.concatenate([np.full(n, m) for n, m in types])
    y = np.column_stack([np.zeros(len(mean)), mean]) + spread * rng.normal(size=(len(mean), 2))
    return y, np.broadcast_to(1e-6 * np.eye(2), (len(mean), 2, 2))


@pytest.mark.parametrize(
    ("types", "sizes"),
    [
        (((12, 0.0),), []),
        (((7, 0.0), (5, 1.5)), [7, 5]),
        (((9, 0.0), (4, 1.5), (3, -2.0)), [9, 4, 3]),
        (((30, 0.0), (2, 1.5)), []),
        (((7, 0.0), (5, 0.3)), []),
    ],
    ids=["one", "two", "three", "strangers", "hardly apart"],
)
def test_types_are_told_apart(types: tuple[tuple[int, float], ...], sizes: list[int]) -> None:
    y, S = fleet(*types)
    groups = types_of(y, S, (True, True))
    assert [len(g) for g in groups] == sizes
    assert not groups or sorted(np.concatenate(groups).tolist()) == list(range(len(y)))


def test_a_wide_type_is_one() -> None:
    y, S = fleet((40, 0.0), spread=0.6)
    assert not types_of(y, S, (True, True))
    assert not types_of(y[:, :0], S[:, :0, :0], ())
