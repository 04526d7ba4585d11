"""How well a parameter is known where the unit of torque is open."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servo_daemon.identification.output_error.precision.information import Information, log_std

NAMES = ("R", "K", "J", "Tc", "TL", "ws")
#: Size of the unit of each coordinate: logarithms, but the load, N·m.
SCALE = np.array([1.0, 1.0, 1.0, 1.0, 20.0, 1.0])
LOAD_NM = 2.5


def without_current() -> Information:
    """Torques are known to 1 % as multiples of K/R, and what c they may all be multiplied with leaves no trace."""
    c = np.array([-1.0, 0.0, 1.0, 1.0, LOAD_NM, 0.0])
    root = np.diag([0.0, 0.0, 0.01, 0.01, 0.01 * LOAD_NM, 0.02])
    exact = (c / SCALE / np.linalg.norm(c / SCALE))[None, :]
    lost = np.array([True, False, True, True, True, False])
    return Information(NAMES, root, lost, (), exact, SCALE)


@pytest.mark.parametrize(("name", "value"), [("Tc", None), ("TL", LOAD_NM), ("TL", -LOAD_NM)])
def test_a_torque_is_known_as_a_multiple_of_the_motors(name: str, value: float | None) -> None:
    info = without_current()
    if value is not None and value < 0.0:  # the same load the other way
        info = Information(NAMES, info.root, info.undetermined, (), info.exact * [1, 1, 1, 1, -1, 1], SCALE)
    assert log_std(info, name, value) == pytest.approx(0.01)


def test_a_torque_that_is_wide_is_wide_as_a_multiple_too() -> None:
    info = without_current()
    wide = Information(NAMES, info.root * 200.0, info.undetermined, (), info.exact, SCALE)
    assert log_std(wide, "Tc") == pytest.approx(2.0)


def test_what_needs_no_unit_is_known_by_itself() -> None:
    assert log_std(without_current(), "ws") == pytest.approx(0.02)


def test_a_direction_of_its_own_leaves_it_open() -> None:
    info = without_current()
    own = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    lost = Information(NAMES, info.root, info.undetermined, (), np.vstack([info.exact, own]), SCALE)
    assert math.isinf(log_std(lost, "Tc"))
