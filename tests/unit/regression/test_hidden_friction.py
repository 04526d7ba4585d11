"""By how much B and J are off where dry friction is in the balance and not in the model."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.balances import Sums
from servo_daemon.regression.hidden_friction import HiddenFriction

J, B, TC = 0.02, 0.1, 0.3


def moves(friction_Nm: float, speed: np.ndarray) -> dict[str, float] | None:
    """Of a shaft that turns so, with noise of the torque."""
    random = np.random.default_rng(1)
    acceleration = np.gradient(speed, 0.1)
    columns = np.column_stack([acceleration, speed, np.sign(speed)])
    y = columns @ [J, B, friction_Nm] + random.normal(0.0, 0.01, len(speed))
    hidden = HiddenFriction(("J", "B"))
    hidden.add(1.0, Sums.of(columns, y, np.ones(3)))
    return hidden.moves(1.0, {})


def swinging(n: int = 400) -> np.ndarray:
    t = 0.1 * np.arange(n)
    return 10.0 * np.sin(0.7 * t) + 4.0 * np.sin(1.9 * t)


def test_friction_that_is_plain_moves_b_by_what_passes_for_it() -> None:
    found = moves(TC, swinging())
    assert found is not None
    speed = swinging()
    without, *_ = np.linalg.lstsq(
        np.column_stack([np.gradient(speed, 0.1), speed]),
        np.column_stack([np.gradient(speed, 0.1), speed, np.sign(speed)]) @ [J, B, TC],
    )
    assert found["B"] == pytest.approx(np.log(without[1] / B), abs=0.01)
    assert found["B"] > 0.2 > found["J"]


@pytest.mark.parametrize("friction_Nm", [0.0, -TC])
def test_no_friction_or_what_is_none_moves_nothing(friction_Nm: float) -> None:
    assert moves(friction_Nm, swinging()) == {"J": 0.0, "B": 0.0}


def test_one_speed_tells_nothing() -> None:
    assert moves(TC, np.full(400, 5.0)) is None
