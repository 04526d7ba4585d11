"""A further effect of which the balances show next to nothing."""

from __future__ import annotations

from typing import Any

import pytest

from servo_daemon.diagnosis.screening.screen import ScreenedCandidate
from servo_daemon.diagnosis.search.fitting import Candidate, seen_enough
from servo_daemon.diagnosis.trial.compare import Advantage

TRIAL: Any = None


def screened(effect: str, share: float) -> ScreenedCandidate:
    return ScreenedCandidate(effect, share, {}, share, {})


@pytest.mark.parametrize(
    ("name", "share", "delta_bic", "stays"),
    [
        # Beside dry friction on means of 500 Hz, as it was found: a ripple of 2.6 %, of which the balance has 0.9 %.
        ("torque_ripple", 0.021, -49.8, False),
        ("torque_ripple", 0.021, -150.0, True),
        ("torque_ripple", 0.2, -49.8, True),
        ("cogging_torque_2", 0.021, -49.8, False),
        # One shape, not one of many: friction along the screw of the EMPS axis has a thirtieth of what is left.
        ("position_dependent_friction", 0.033, -49.8, True),
        ("a pair of two", 0.021, -49.8, True),
    ],
)
def test_what_only_free_runs_prefer_must_be_far_too_good_for_chance(
    name: str, share: float, delta_bic: float, stays: bool
) -> None:
    candidate = Candidate(name, TRIAL, Advantage(0.41, 0.07, 0.84, delta_bic))
    names = ("torque_ripple", "cogging_torque", "position_dependent_friction")
    found = seen_enough([candidate], [screened(n, share) for n in names])
    assert found == ((candidate,) if stays else ())
