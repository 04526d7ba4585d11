"""Excitation flags, qualification and the published status, with their hysteresis."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.estimators import excitation
from servo_daemon.estimators.excitation import Excitation
from servo_daemon.estimators.fusion import Qualification, fuse
from servo_daemon.plant.parameters import J, L


def fed(e: Excitation, std: float, seconds: float = 6.0) -> None:
    """Ticks whose information over the window amounts to this 1 σ."""
    for _ in range(round(10 * seconds)):
        e.update(np.array([1.0 / std**2 * 0.1 / excitation.WINDOW_S]), 0.1)


def test_enters_and_leaves_with_hysteresis() -> None:
    e = Excitation(np.ones(1))
    between = (excitation.ENTER + excitation.LEAVE) / 2
    fed(e, between)
    assert not e.excited[0]
    fed(e, excitation.ENTER * 0.9)
    assert e.excited[0]
    fed(e, between)
    assert e.excited[0]
    fed(e, excitation.LEAVE * 1.1)
    assert not e.excited[0]


def test_old_information_is_forgotten() -> None:
    e = Excitation(np.ones(1))
    fed(e, 0.01)
    assert e.excited[0]
    for _ in range(60):
        e.update(np.zeros(1), 0.1)
    assert not e.excited[0]


def test_qualification_needs_excitation_and_has_hysteresis() -> None:
    q = Qualification(1)
    q.update(np.array([0.01]), np.array([False]))
    assert not q.qualified[0]
    q.update(np.array([0.01]), np.array([True]))
    q.update(np.array([0.10]), np.array([False]))
    assert q.qualified[0]
    q.update(np.array([0.20]), np.array([True]))
    assert not q.qualified[0]


def published(**changes: object) -> tuple[str, float | None, str | None]:
    arguments = {"excited": True, "qualified": True, "nominal": 0.02} | changes
    f = fuse(J, np.log(0.01), 0.02, **arguments)  # type: ignore[arg-type]
    return f.status, f.value, f.reason


def test_status_and_reason() -> None:
    assert published()[0] == "tracking"
    status, value, reason = published(excited=False)
    assert status == "unexcited" and value == pytest.approx(0.01) and reason is not None and "J not visible" in reason
    status, value, reason = published(qualified=False)
    assert status == "estimating" and value == 0.02 and reason is not None
    assert published(qualified=False, nominal=None)[1] is None


def test_not_a_number_is_never_published() -> None:
    f = fuse(J, np.nan, 0.1, True, True, 0.02)
    assert f.status == "invalid" and f.value == 0.02 and f.std is None


def test_at_bound_is_said() -> None:
    f = fuse(J, np.log(J.upper), 0.01, True, True, None)
    assert f.status == "at_bound" and f.reason


def test_skew_floors_the_std_of_L() -> None:
    f = fuse(L, np.log(1e-3), 1e-6, True, True, None, floor_std=2e-5)
    assert f.std == pytest.approx(2e-5, rel=1e-3)
