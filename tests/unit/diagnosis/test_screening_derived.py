"""Screening of effects that bring no formula for it: columns and start values from their terms alone."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.diagnosis.screening.derived import derived, scan
from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.screening import Context, Motion, Trace
from servo_daemon.plant.effects import effects_by_name, parameter_table

N = 500


def context() -> Context:
    t = np.arange(N) * 1e-2
    omega, i = 9 * np.sin(3 * t), 4 * np.cos(7 * t)
    p = {"R": 0.5, "L": 2e-3, "K": 0.3, "J": 0.01, "B": 0.1}
    rest = np.zeros(N, dtype=bool)
    motion = Motion(p, t, np.full(N, 1e-2), 3 * i, i, omega, np.cumsum(omega) * 1e-2, i, omega, {}, rest)
    return Context(motion, {"torque": np.zeros(N)}, np.sign(omega), ("current_A", "position_rad"))


MOTION = context().motion


@pytest.mark.parametrize(
    ("name", "expected", "start"),
    [
        ("quadratic_drag", Trace(torque=MOTION.omega * np.abs(MOTION.omega)), {"c2": 0.3}),
        ("coulomb_friction", Trace(torque=np.sign(MOTION.omega)), {"Tc": 0.3}),
        ("constant_load_torque", Trace(torque=np.ones(N)), {"TL": 0.3}),
        ("brush_voltage_drop", Trace(voltage=np.sign(MOTION.i)), {"Vb": 0.3}),
        ("voltage_sensor_offset", Trace(voltage=np.ones(N)), {"v0": 0.3}),
        ("encoder_eccentricity", None, None),
    ],
)
def test_what_is_linear_is_a_column(name: str, expected: Trace | None, start: dict[str, float] | None) -> None:
    c = context()
    bases = list(derived(name)(c))
    if expected is None:  # an angle beside the size: scanned, and shown by a sensor
        assert {*c.traces[bases[0].columns[0]].shown} == {"position_rad"}
        return
    (found,) = bases
    trace = c.traces[found.columns[0]]
    for values, wanted in ((trace.torque, expected.torque), (trace.voltage, expected.voltage)):
        assert (values is None) == (wanted is None)
        if values is not None and wanted is not None:
            np.testing.assert_array_equal(values, wanted)
    assert found.start(np.array([0.3])) == start
    assert found.parameters == 1


def test_what_is_negative_and_must_not_be_is_no_start() -> None:
    (drag,) = derived("quadratic_drag")(context())
    assert drag.start(np.array([-0.02])) is None


def test_what_is_not_linear_is_scanned_about_its_size() -> None:
    c = context()
    bases = list(derived("gravity_load")(c))
    angles = [float((b.start(np.array([0.5])) or {})["phi_g"]) for b in bases]
    assert min(angles) == -np.pi
    assert len(angles) == 64
    theta = c.motion.theta
    torque = c.traces[bases[10].columns[0]].torque
    assert torque is not None
    np.testing.assert_allclose(torque, np.sin(theta + angles[10]), atol=1e-12)


def test_where_nothing_is_linear_the_whole_is_the_column() -> None:
    c = context()
    bases = list(derived("magnetic_saturation")(c))
    starts = [b.start(np.array([1.2])) for b in bases]
    knees = [float(s["I_sat"]) for s in starts if s is not None]
    usual = 3.0 * np.percentile(np.abs(c.motion.i), 95.0)
    assert min(knees) == pytest.approx(usual / 10)
    assert max(knees) == pytest.approx(usual * 10)
    trace = c.traces[bases[3].columns[0]]
    lost = 1 - 1 / (1 + (c.motion.i / knees[3]) ** 2)
    assert trace.torque is not None
    assert trace.voltage is not None
    np.testing.assert_allclose(trace.torque, 0.3 * c.motion.i * lost, atol=1e-12)
    np.testing.assert_allclose(trace.voltage, -0.3 * c.motion.omega * lost, atol=1e-12)
    assert bases[3].start(np.array([0.1])) is None  # of so much less the knee would be another


@pytest.mark.parametrize("name", ["backlash", "shaft_compliance", "drive_lag", "measurement_delay"])
def test_what_has_no_column(name: str) -> None:
    assert list(derived(name)(context())) == []


def test_a_load_behind_a_gap_goes_on_with_the_motor_where_samples_are_missing() -> None:
    """Its teeth cannot be followed over a pause of 2 s: what was made of it hid all that the rest shows."""
    h = np.full(2 * N, 1e-3)
    h[N] = 2.0
    t = np.cumsum(h) - h
    theta, omega, rate = np.sin(20 * t), 20 * np.cos(20 * t), -400 * np.sin(20 * t)
    at_sample = {"position_rad": theta, "velocity_rad_s": omega}
    motion = Motion(MOTION.p, t, h, omega, omega, omega, theta, omega, rate, at_sample, np.zeros(2 * N, dtype=bool))
    c = Context(motion, {"torque": np.zeros(2 * N)}, np.sign(omega), ("current_A", "position_rad"))
    family = effects_by_name()["backlash"].screening
    assert family is not None
    bases = list(family(c))
    assert len(bases) == 12
    for basis in bases:
        load = c.traces[basis.columns[0]].torque
        assert load is not None
        assert np.abs(load[N + 1 : -1]).max() < 2 * np.abs(load[:N]).max()


def test_scans() -> None:
    m = context().motion
    table = parameter_table()
    assert scan(table["channel"], 0.0, 64, m) == [0.0, 1.0, 2.0]
    assert scan(table["n_cog"], 12.0, 64, m) == [float(n) for n in range(1, 17)]
    instants = scan(table["t_TL"], 0.0, 8, m)
    assert len(instants) == 8
    assert 0.0 < min(instants) < max(instants) < float(m.t[-1])
    signed = Parameter("a", "a", "1", 0.0, -1.5, 3.0, "identity", "", "", scale=Scale(0.5))
    assert min(scan(signed, 0.5, 8, m)) == -0.5
    assert max(scan(signed, 0.5, 8, m)) == 1.5
