"""Which candidate of a round is the best, where the runs that decide do not say it alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from servo_daemon.diagnosis.search import evidence, fitting
from servo_daemon.diagnosis.search.fitting import Candidate, best_of
from servo_daemon.diagnosis.trial.compare import Advantage


def trial(free: int) -> Any:
    return SimpleNamespace(free=free)


#: A faint drop at the brushes on slow reversals without a current, as it was found: dry friction gains more.
FRICTION = Candidate("coulomb_friction", trial(6), Advantage(4.606, 4.32, 4.93, -8912.9))
BRUSHES = Candidate("brush_voltage_drop", trial(6), Advantage(4.53, 4.26, 4.8, -12810.8))


def compared(monkeypatch: pytest.MonkeyPatch, brushes_over_friction: Advantage) -> None:
    a = brushes_over_friction
    there_and_back = {True: a, False: Advantage(-a.gain, -a.high, -a.low, -a.delta_bic)}
    for module in (evidence, fitting):
        monkeypatch.setattr(module, "advantage", lambda _, rich: there_and_back[rich is BRUSHES.trial])


def test_of_two_that_the_deciding_runs_do_not_tell_apart_the_likelier_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    compared(monkeypatch, Advantage(-0.076, -0.396, 0.18, -416.3))
    assert best_of([FRICTION, BRUSHES]) is BRUSHES
    assert fitting.ties(BRUSHES, [FRICTION, BRUSHES]) == ("coulomb_friction",)


@pytest.mark.parametrize(
    "apart",
    [Advantage(-0.076, -0.1, -0.05, -416.3), Advantage(-0.076, -0.396, 0.18, -5.0)],
    ids=["they tell", "as likely"],
)
def test_else_the_one_that_gains_more(monkeypatch: pytest.MonkeyPatch, apart: Advantage) -> None:
    compared(monkeypatch, apart)
    assert best_of([FRICTION, BRUSHES]) is FRICTION


def test_a_likelier_one_of_more_parameters_has_to_earn_them(monkeypatch: pytest.MonkeyPatch) -> None:
    compared(monkeypatch, Advantage(-0.076, -0.396, 0.18, -416.3))
    richer = Candidate("stribeck_friction", trial(8), BRUSHES.against)
    assert best_of([FRICTION, richer]) is FRICTION
