"""A further effect of which the balances show next to nothing, and a first one of which they show nearly all."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from servo_daemon.diagnosis.screening.screen import ScreenedCandidate
from servo_daemon.diagnosis.search import select
from servo_daemon.diagnosis.search.fitting import Candidate, not_alone, seen_enough
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


#: A hoist as it was found: its load is 96 % of what is missing, and gains next to nothing in free runs that drift off.
LOAD = Candidate("constant_load_torque", TRIAL, Advantage(0.082, -0.41, 0.3, -115.0))
STEP = Candidate("load_torque_step", TRIAL, Advantage(0.09, -0.4, 0.3, -103.0))
SEEN = (screened("constant_load_torque", 0.958), screened("load_torque_step", 0.938))


def test_others_are_tried_beside_what_is_most_of_what_is_missing() -> None:
    assert not_alone((STEP, LOAD), None, SEEN) is LOAD
    assert not_alone((STEP, LOAD), None, [screened(s.effect, 0.4) for s in SEEN]) is None
    by_chance = Candidate(LOAD.name, TRIAL, Advantage(0.082, -0.41, 0.3, -5.0))
    assert not_alone((by_chance,), None, SEEN) is None
    assert not_alone((STEP, LOAD), STEP, SEEN) is None
    assert not_alone((), None, SEEN) is None


def test_others_are_tried_beside_what_gains_much_in_the_mean() -> None:
    much = Candidate("gravity_load", TRIAL, Advantage(0.5, -0.2, 0.9, -200.0))
    assert not_alone((much, LOAD), LOAD, SEEN) is much
    convincing = Candidate("gravity_load", TRIAL, Advantage(0.5, 0.3, 0.9, -200.0))
    assert not_alone((convincing, LOAD), LOAD, SEEN) is None


def test_beside_another_no_effect_has_a_name_that_would_be_too_small_for_one_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A friction by direction of 2 µN·m made a friction by load convincing that is not so by itself (an XL330)."""

    def trial(nrmse: float, **values: float) -> Any:
        return SimpleNamespace(
            values=values, free=8, choice=SimpleNamespace(nrmse=nrmse), problem=SimpleNamespace(sample_period_s=5e-3)
        )

    convincing = Advantage(0.62, 0.023, 0.88, -235.0)
    nothing = trial(0.02, Tc=2.2e-6, Tc_neg=2.6e-6, B_neg=1e-6)
    second = [Candidate("asymmetric_friction", nothing, convincing)]
    size: Any = SimpleNamespace(size={"torque": 0.3, "voltage": 3.0})
    monkeypatch.setattr(select, "seen_missing", lambda data, current: size)
    monkeypatch.setattr(select, "screen", lambda current, missing: ())
    monkeypatch.setattr(select, "whatever", lambda *_, **__: ())
    monkeypatch.setattr(select, "fitted", lambda *_: tuple(second))
    monkeypatch.setattr(select, "advantage", lambda simple, rich: convincing)
    data: Any = SimpleNamespace(fixed={})
    search = select._Search(data, trial(0.3))
    first = Candidate("load_dependent_friction", trial(0.023, mu=0.4), Advantage(0.41, -0.23, 0.77, -181.0))
    effort: Any = None
    assert select._beside(search, first, (first,), effort)[2] is None
    second[0] = Candidate("asymmetric_friction", trial(0.02, Tc=0.02, Tc_neg=0.01, B_neg=1e-6), convincing)
    assert select._beside(search, first, (first,), effort)[2] is not None
