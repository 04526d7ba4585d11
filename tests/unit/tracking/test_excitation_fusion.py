"""Excitation flags, qualification and the published status, with their hysteresis."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.parameters import J, L
from servo_daemon.regression.sampling import WINDOW_S
from servo_daemon.tracking.validity import excitation
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.fusion import Trusted, as_last_known, confirms, fuse


def fed(e: Excitation, std: float, seconds: float = 6.0) -> None:
    """Ticks whose information over the window amounts to this 1 σ."""
    for _ in range(round(10 * seconds)):
        e.update(np.array([1.0 / std**2 * 0.1 / WINDOW_S]), 0.1)


def test_enters_and_leaves_with_hysteresis() -> None:
    e = Excitation(1)
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
    e = Excitation(1)
    fed(e, 0.01)
    assert e.excited[0]
    for _ in range(60):
        e.update(np.zeros(1), 0.1)
    assert not e.excited[0]


def test_what_the_balances_do_not_determine_is_not_excited_however_long_one_looks() -> None:
    e = Excitation(1)
    e.determine(np.array([[0.5 * excitation.SYSTEMATIC_ENTER**-2]]), np.array([True]))
    fed(e, 0.001)
    assert not e.excited[0]
    e.determine(np.array([[2.0 * excitation.SYSTEMATIC_ENTER**-2]]), np.array([True]))
    fed(e, 0.001)
    assert e.excited[0]
    e.determine(np.array([[2.0 * excitation.SYSTEMATIC_LEAVE**-2]]), np.array([True]))
    fed(e, 0.001)
    assert e.excited[0]
    e.determine(np.zeros((1, 1)), np.array([True]))
    fed(e, 0.001)
    assert not e.excited[0]


def test_single_parameters_are_held_and_those_seen_together_are_not() -> None:
    """Of three the first two show as their sum only, the third not at all."""
    e = Excitation(3)
    e.determine(1e6 * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), np.ones(3, dtype=bool))
    for _ in range(60):
        e.update(np.full(3, 1e6), 0.1)
    assert not e.excited.any()
    assert e.held(np.ones(3, dtype=bool)).tolist() == [False, False, True]
    assert e.held(np.array([True, True, False])).tolist() == [False, False, False]


def test_a_regression_that_knows_confirms_what_is_near() -> None:
    assert confirms(1.0, 0.05, 1.2) and not confirms(1.0, 0.02, 1.5)
    assert not confirms(1.0, 0.4, 1.0)


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
    assert reason == "the filter is sure of a value, which nothing confirms yet"


def test_what_was_known_is_held_as_uncertain_as_it_is_by_now() -> None:
    last = Trusted(float(np.log(0.01)), 0.03, age_s=7.0, unconfirmed_s=2.0)
    here = last.coordinate
    kept, doubted = as_last_known(J, last, "why"), as_last_known(J, last, "why", (here, 0.5))
    assert kept.value == doubted.value == pytest.approx(0.01)
    assert kept.std == pytest.approx(3e-4) and doubted.std == pytest.approx(5e-3)
    assert kept.status == "unexcited" and kept.reason == "held as last known: why"
    assert kept.age_s == 7.0
    assert as_last_known(J, last, "why", (here, np.nan)).std == pytest.approx(3e-4)
    assert as_last_known(L, last, "why", floor_std=4e-4).std == pytest.approx(5e-4)


def test_what_the_running_filter_excludes_is_not_held() -> None:
    last = Trusted(float(np.log(0.01)), 0.03, age_s=7.0, unconfirmed_s=2.0)
    inside, outside = ((last.coordinate + by, 0.04) for by in (0.19, 0.21))  # 0.05 together
    assert as_last_known(J, last, "why", inside).value is not None
    refuted = as_last_known(J, last, "why", outside)
    assert (refuted.value, refuted.std, refuted.status) == (None, None, "estimating")
    assert refuted.age_s == 7.0 and refuted.reason is not None and "no longer fits" in refuted.reason


def test_nothing_is_held_for_long_on_a_motion_that_should_show_it() -> None:
    last = Trusted(float(np.log(0.01)), 0.03, age_s=90.0, unconfirmed_s=10.5)
    assert as_last_known(J, last, "why", hold_s=11.0).status == "unexcited"
    given_up = as_last_known(J, last, "why", hold_s=10.0)
    assert (given_up.value, given_up.status) == (None, "estimating")
    assert given_up.reason is not None and "hold_s = 10 s" in given_up.reason


def test_not_a_number_is_never_published() -> None:
    f = fuse(J, np.nan, 0.1, True, True, 0.02)
    assert f.status == "invalid" and f.value == 0.02 and f.std is None


def test_at_bound_is_said() -> None:
    f = fuse(J, np.log(J.upper), 0.01, True, True, None)
    assert f.status == "at_bound" and f.reason


def test_skew_floors_the_std_of_L() -> None:
    f = fuse(L, np.log(1e-3), 1e-6, True, True, None, floor_std=2e-5)
    assert f.std == pytest.approx(2e-5, rel=1e-3)
