"""Columns of the regressions that are read off an effect's terms, beside those that their files write by hand."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.regression.columns.derived_terms import derived_terms
from servo_daemon.regression.columns.terms import columns_of, shaft_signals, unseen_in
from servo_daemon.regression.stretch import Stretch

NOMINAL = {name: p.nominal for name, p in parameter_table().items()} | {"f_per": 3.0}


def stretch() -> Stretch:
    rng = np.random.default_rng(5)
    n = 200
    time_s = np.arange(n) * 1e-3
    speed, current = 5 * np.sin(40 * time_s), rng.normal(size=n)
    ones = np.ones(n, dtype=bool)
    return Stretch(time_s, ones, 2 * current, current, None, np.cumsum(speed) * 1e-3, speed)


@pytest.mark.parametrize("name", ["coulomb_friction", "quadratic_drag", "constant_load_torque", "stribeck_friction"])
def test_signals_are_those_by_hand(name: str) -> None:
    s = stretch()
    found = np.array(derived_terms(name).signals("shaft", s, NOMINAL))
    by_hand = np.array(shaft_signals(name, s, NOMINAL))
    if name == "stribeck_friction":  # by hand in Tc and the excess Ts − Tc
        by_hand = np.array([by_hand[0] - by_hand[1], by_hand[1]])
    np.testing.assert_allclose(found, by_hand, rtol=1e-12, atol=1e-12)


def test_signals_of_the_armature() -> None:
    s = stretch()
    assert s.current is not None
    (found,) = derived_terms("brush_voltage_drop").signals("armature", s, NOMINAL)
    np.testing.assert_array_equal(found, np.sign(s.current))
    assert derived_terms("brush_voltage_drop").by_current_direction
    assert derived_terms("brush_voltage_drop").signals("shaft", s, NOMINAL) == []


@pytest.mark.parametrize(
    ("name", "shaft", "armature", "open_"),
    [
        ("quadratic_drag", ("c2",), (), set()),
        ("constant_load_torque", ("TL",), (), set()),
        ("brush_voltage_drop", (), ("Vb",), set()),
        ("voltage_sensor_offset", (), ("v0",), set()),
        ("load_torque_step", ("dTL",), (), set()),  # its instant is held
        ("stribeck_friction", ("Tc", "Ts"), (), {"shaft"}),  # beside ws, which is free
        ("gravity_load", ("Tg",), (), {"shaft"}),
        ("load_dependent_friction", (), (), {"shaft"}),  # a share of K i, and K is looked for
        ("torque_ripple", (), (), {"armature", "shaft"}),
        ("winding_heating", (), (), {"armature", "shaft"}),
        ("current_sensor_offset", (), (), {"armature", "shaft"}),
        ("measurement_delay", (), (), {"armature", "shaft"}),
        ("shaft_compliance", (), (), {"shaft"}),
        ("backlash", (), (), {"shaft"}),
    ],
)
def test_what_closes(name: str, shaft: tuple[str, ...], armature: tuple[str, ...], open_: set[str]) -> None:
    found = derived_terms(name)
    assert found.columns == {"armature": armature, "shaft": shaft}
    assert found.open == open_


def test_what_follows_a_signal_that_is_not_there_has_no_column() -> None:
    with_columns = [e for e in effects_by_name() if columns_of(e, ("coulomb_friction", e))]
    unseen = unseen_in(with_columns, sees_current=False, sees_angle=True)
    assert unseen == {"torque_ripple", "load_dependent_friction"}
    cogging = {f"cogging_torque{e}" for e in ("", "_2", "_3", "_4")}
    unseen = unseen_in(with_columns, sees_current=True, sees_angle=False)
    assert unseen == {"gravity_load", "torque_ripple", "position_dependent_friction", *cogging}
    assert unseen_in(with_columns, sees_current=True, sees_angle=True) == set()
