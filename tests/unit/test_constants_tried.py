"""The tool that halves and doubles the estimator's constants (`tests/recovery/constants.py`)."""

from __future__ import annotations

import pytest

from servo_daemon.tracking.validity import excitation, gates
from tests.recovery import constants as tool
from tests.recovery.calibration.watched import put

USUAL = {"converged": 12.0, "wrong": 0.0, "ekf error": 0.01, "ekf wrong": 0.0, "ekf delivered": 0.9}


def test_numbers_and_tuples_of_them_may_be_tried_and_are_put_wherever_they_are_held() -> None:
    every = tool.constants()
    name = "tracking.validity.gates._ONE_LINE"
    usual = gates._ONE_LINE
    assert every[name] == usual
    assert isinstance(every["tracking.validity.excitation.ENTER"], float)
    others = [("_ONE_LINE", usual, 0.5), ("ENTER", excitation.ENTER, 1.0)]
    with pytest.raises(RuntimeError), put(others):
        assert (gates._ONE_LINE, excitation.ENTER) == (0.5, 1.0)
        raise RuntimeError
    assert usual == gates._ONE_LINE and every["tracking.validity.excitation.ENTER"] == excitation.ENTER


def test_whole_numbers_stay_whole_and_at_least_one() -> None:
    assert tool.scaled((5, 1, 0.3), 0.5) == (2, 1, 0.15)


def test_of_what_is_nearly_one_the_difference_is_scaled() -> None:
    assert tool.scaled(0.98, 2.0) == pytest.approx(0.96)


@pytest.mark.parametrize(
    ("name", "same", "bad"),
    [
        ("converged", 13.0, 11.0),
        ("wrong", 0.0, 1.0),
        ("ekf error", 0.0104, 0.0106),
        ("ekf error", 0.009, float("nan")),
        ("ekf wrong", 0.0005, 0.002),
        ("ekf delivered", 0.89, 0.88),
    ],
)
def test_what_is_worse_is_told(name: str, same: float, bad: float) -> None:
    assert tool.worse(USUAL | {name: same}, USUAL) == []
    assert [text.split(" (")[0] for text in tool.worse(USUAL | {name: bad}, USUAL)] == [f"{name} {bad:.4g}"]


def test_what_moves_nothing_is_not_told_as_free() -> None:
    assert tool.said({"figures": USUAL}, USUAL) == "no say in these runs"
    assert tool.said({"figures": USUAL | {"ekf error": 0.0101}}, USUAL) == "free"
    assert tool.said({"figures": USUAL | {"converged": 3.0}}, USUAL) == "converged 3 (12)"
    assert tool.said({"failed": "ValueError()"}, USUAL) == "ValueError()"
